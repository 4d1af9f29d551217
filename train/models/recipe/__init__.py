"""The compact networks, the box's default: architectures, training, graphs in float and int8."""

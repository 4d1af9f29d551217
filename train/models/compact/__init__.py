"""The default network family: architecture, training, graphs."""

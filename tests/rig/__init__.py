"""The virtual box: an arm64 Debian with the appliance on it, a skin on its USB, its lines and its serial port outside.

image.py makes it, machine.py runs it; usbredir.py, lines.py and cell.py are the world around it. `make rig` shows it.
"""

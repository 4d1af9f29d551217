"""The virtual box: an arm64 Debian with the appliance on it, a skin on its USB, its lines and its
serial port outside.

image.py builds it, machine.py runs it; usbredir.py, lines.py and cell.py are the devices and the
robot around it. `python -m tests.campaigns rig` shows it.
"""

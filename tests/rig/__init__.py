"""The virtual box: an arm64 Debian that runs the appliance, with a skin on its USB port and a robot
on its GPIO lines and serial port.

image.py builds the box and machine.py runs it; usbredir.py, lines.py and cell.py are the devices
and the robot around it. `python -m tests.campaigns rig` shows it at work.
"""

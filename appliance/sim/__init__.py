"""The simulator. Simulated are tubes, finger and skin (`skin`), what the robot does (`script`),
robot and readout board on one timeline (`rig`), the USB bus (`usb`) and the GPIO lines (`gpio`).
Everything above these is the real code: pyusb, the drivers and all that follows are real.
"""

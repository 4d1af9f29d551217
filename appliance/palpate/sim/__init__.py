"""The simulator: tubes, finger and skin (`skin`), the acts of the robot (`script`), robot and
readout board on one timeline (`rig`), the USB bus (`usb`) and the GPIO lines (`gpio`). Everything
above is real code: pyusb, the drivers and all that follows."""

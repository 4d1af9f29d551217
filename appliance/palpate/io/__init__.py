"""Drivers: the skin on USB, GPIO lines and the serial port."""

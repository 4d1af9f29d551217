"""Drivers: the skin on USB, GPIO lines and the serial port; bytes and levels to frames, edges and
sentences, and back."""

"""Skin, GPIO lines and serial port: bytes and levels to frames, edges and sentences, and back."""

"""Measured on emulated skins: wrong frames of bad cables, load, the way to answers."""

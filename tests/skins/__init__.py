"""Measured on emulated skins: how often a bad cable makes a wrong frame, what each skin costs the
box, the whole way."""

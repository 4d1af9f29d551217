"""Measured on emulated skins: how often a bad cable makes a wrong frame, the load of each skin on
the box, the whole way from recording to answers."""

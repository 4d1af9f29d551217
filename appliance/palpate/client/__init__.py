"""Clients for other programs: the box over its feed and over its serial line. They do not need
numpy."""

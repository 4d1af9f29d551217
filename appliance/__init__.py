"""Palpate: names the material that a robot's tactile skin has just swept over. `python -m appliance --help`."""

__version__ = "0.1.0"

"""Shared by all packages: types, errors, clock, settings, files. Imports nothing of the others."""

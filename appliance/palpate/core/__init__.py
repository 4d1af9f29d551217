"""Shared by all packages: types, errors, clock, settings, files. Imports nothing else of the
appliance."""

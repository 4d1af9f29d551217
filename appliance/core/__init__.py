"""What every package shares: types, errors, clock, settings, files. It imports nothing else of the
appliance."""

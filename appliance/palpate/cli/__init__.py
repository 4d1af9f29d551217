"""The command `palpate`."""

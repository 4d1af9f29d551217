"""The command `palpate-train`."""

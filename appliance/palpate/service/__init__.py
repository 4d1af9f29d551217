"""How a person and systemd see the running box."""

"""The running box for a person: a page and its server, and pictures for a terminal."""

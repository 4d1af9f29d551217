"""What shows the running box to a person: a page and its server."""

"""The model bundle: a folder of files that are checked before any of them is used."""

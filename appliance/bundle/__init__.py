"""The model bundle: a folder of files, checked before anything in it is believed."""

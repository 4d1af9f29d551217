"""Teaching on the box: a fit in closed form, in a process apart from the loop."""

"""Teaching on the box: a fit in closed form, in a process of its own beside the loop."""

"""Functions of the raw counts of a sweep: the paper's features, checks of a window, and the
position of the contact."""

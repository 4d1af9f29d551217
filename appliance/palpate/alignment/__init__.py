"""Shows the position of the contact on the skin, in a terminal and on a page."""

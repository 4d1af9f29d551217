"""Shows where the contact lies on the skin, in a terminal and as a page."""

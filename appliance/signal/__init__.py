"""What is computed from the raw counts of a sweep: features of the paper, and where the contact lies."""

"""What is fitted after training: temperatures, early exit, novelty."""

"""What is fitted after training, on what the trunk gives: temperatures, early exit, novelty."""

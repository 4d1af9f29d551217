"""What a person runs without a robot: demo and bench, both on simulated devices."""

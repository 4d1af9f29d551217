"""What a person runs beside the robot: demo and bench, both on simulated devices."""

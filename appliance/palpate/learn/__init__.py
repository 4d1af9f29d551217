"""Teaching: the box learns materials from sweeps at the robot, without a desktop."""

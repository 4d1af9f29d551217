"""Teaching: the box learns materials from sweeps beside the robot, without a desktop."""

"""Bridges from the box to what cells speak: TCP, Modbus TCP, ROS 2. Each is a process of its own
beside the box."""

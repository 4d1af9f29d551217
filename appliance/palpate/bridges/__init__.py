"""Bridges from the box to the protocols of robot cells: TCP, Modbus TCP, ROS 2. Each is a process
of its own next to the box."""

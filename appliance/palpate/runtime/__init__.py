"""The loop, its assembly from components, the self-test, and replay."""

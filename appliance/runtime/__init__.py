"""The loop, how it is put together, its self-test, and replay."""

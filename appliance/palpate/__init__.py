"""Palpate: tells which material a robot's tactile skin has just swept over. `python -m palpate
--help`."""

import os

# Before anything imports onnxruntime: since 1.29 its Linux builds start a thread that uploads
# telemetry and write a device id to disk, and `disable_telemetry_events()` comes too late for both
# (microsoft/onnxruntime, pull 27379).
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

__version__ = "0.2.0"

"""Runs the Python of docs/robots/ros2.md, which comes on stdin, four times; prints what came of each as a JSON line."""

from __future__ import annotations

import json
import sys
import threading

import rclpy

if __name__ == "__main__":
    names: dict = {}
    exec(sys.stdin.read(), names)
    rclpy.init()
    node = rclpy.create_node("cell")
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    toucher = names["Toucher"](node)
    for _ in range(4):
        try:
            print(json.dumps(toucher.classify(lambda: None, timeout_s=20.0)), flush=True)
        except RuntimeError as e:
            print(json.dumps(f"RuntimeError: {e}"), flush=True)

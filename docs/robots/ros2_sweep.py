"""Classify with the action of `palpate bridge ros`: paste it into a program (ros2.md)."""

import threading

from palpate_msgs.action import Sweep
from rclpy.action import ActionClient


class Sweeper:
    """Classifies the object under the finger. node: any rclpy node that another thread spins."""

    def __init__(self, node):
        self._client = ActionClient(node, Sweep, "/palpate/sweep")

    def classify(self, slide, tries=3, slide_s=3.0, timeout_s=10.0):
        """The label, or None: set the object aside. slide: moves the finger for slide_s. Raises
        RuntimeError at a fault or after a time limit."""
        for number in range(tries):
            result = self._sweep(
                slide, Sweep.Goal(new_object=number == 0, slide_s=slide_s, timeout_s=timeout_s)
            )
            if result.status == "ok":
                return result.label
            if result.status in ("undecided", "unknown"):
                return None
            if result.status != "unsure":
                raise RuntimeError(result.message)
        return None

    def _sweep(self, slide, goal):
        limit_s = goal.timeout_s + 10.0  # the bridge waits for a box that is not ready, too
        if not self._client.wait_for_server(limit_s):
            raise RuntimeError("no action ~/sweep: is the bridge running, with palpate_msgs?")
        sliding = threading.Event()
        handle = self._wait(
            self._client.send_goal_async(goal, lambda feedback: sliding.set()), limit_s
        )
        if not handle.accepted:
            raise RuntimeError("another sweep is under way")
        result = handle.get_result_async()
        result.add_done_callback(lambda _: sliding.set())
        if sliding.wait(limit_s) and not result.done():
            slide()
        try:
            return self._wait(result, limit_s).result
        except RuntimeError:
            handle.cancel_goal_async()
            raise

    def _wait(self, future, limit_s):
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        if not done.wait(limit_s):
            raise RuntimeError(f"the bridge did not answer within {limit_s} s")
        return future.result()

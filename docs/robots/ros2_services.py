"""Classify with the services of `palpate bridge ros`: paste it into a program (ros2.md)."""

import threading

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger


class Toucher:
    """Classifies the object under the finger. node: any rclpy node that another thread spins."""

    def __init__(self, node):
        self._node = node
        self._there, self._verdict = threading.Event(), {}
        node.create_subscription(DiagnosticArray, "/palpate/verdict", self._heard, 10)

    def classify(self, slide, tries=3, timeout_s=5.0):
        """The label, or None: set the object aside. slide: moves the finger. Raises RuntimeError
        at a fault or after a time limit."""
        self._call("new_object", timeout_s)
        for _ in range(tries):
            self._there.clear()
            self._call("start", timeout_s)
            slide()
            self._call("stop", timeout_s)
            if not self._there.wait(timeout_s):
                raise RuntimeError(f"no verdict within {timeout_s} s; see /diagnostics")
            status = self._verdict["status"]
            if status == "ok":
                return self._verdict["label"]
            if status in ("undecided", "unknown"):
                return None
            if status != "unsure":
                raise RuntimeError(self._verdict["message"])
        return None

    def _heard(self, array):
        status = array.status[0]
        values = {pair.key: pair.value for pair in status.values}
        self._verdict = values | {"message": status.message}
        self._there.set()

    def _call(self, name, timeout_s):
        client = self._node.create_client(Trigger, f"/palpate/{name}")
        try:
            if not client.wait_for_service(timeout_s):
                raise RuntimeError(f"no service {name}: is the bridge running?")
            done = threading.Event()
            (answer := client.call_async(Trigger.Request())).add_done_callback(lambda _: done.set())
            if not done.wait(timeout_s):
                raise RuntimeError(f"{name} was not answered within {timeout_s} s")
            if not answer.result().success:
                raise RuntimeError(answer.result().message)
        finally:
            self._node.destroy_client(client)

"""Another ROS 2 node, in a process of its own: prints what it hears as JSON lines, calls what it is told on stdin.

Runs with a Python that has rclpy; imports nothing of the project.
"""

from __future__ import annotations

import json
import sys
import threading
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE, "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE, "cleanup": Transition.TRANSITION_CLEANUP,
}  # fmt: skip


def tell(**fields: object) -> None:
    """Print a line."""
    print(json.dumps(fields), flush=True)


def status(topic: str, array: DiagnosticArray) -> None:
    """Print the one status of an array."""
    (one,) = array.status
    values = {pair.key: pair.value for pair in one.values}
    stamp = array.header.stamp.sec + array.header.stamp.nanosec / 1e9
    tell(
        topic=topic, level=one.level[0], name=one.name, message=one.message, values=values, stamp=stamp,
        frame_id=array.header.frame_id, monotonic_ns=time.monotonic_ns(),
    )  # fmt: skip


def listen(node: Node) -> None:
    """Subscribe to all that the box publishes."""
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(DiagnosticArray, "/palpate/verdict", lambda m: status("verdict", m), 50)
    node.create_subscription(DiagnosticArray, "/palpate/state", lambda m: status("state", m), late)
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: status("diagnostics", m), 10)
    node.create_subscription(
        Image, "/palpate/frames",
        lambda m: tell(
            topic="frames", shape=[m.height, m.width], encoding=m.encoding, step=m.step, data=m.data.tolist(),
            frame_id=m.header.frame_id,
        ),
        qos_profile_sensor_data,
    )  # fmt: skip


def obey(node: Node) -> None:
    """Call the services that stdin names, one after the other."""
    for line in sys.stdin:
        name = line.strip()
        if name in TRANSITIONS:
            client = node.create_client(ChangeState, "/palpate/change_state")
            request = ChangeState.Request(transition=Transition(id=TRANSITIONS[name]))
        else:
            client, request = node.create_client(Trigger, f"/palpate/{name}"), Trigger.Request()
        if not client.wait_for_service(20):
            tell(service=name, success=False, message="no such service")
            continue
        client.call_async(request).add_done_callback(
            lambda done, name=name: tell(
                service=name, success=done.result().success, message=getattr(done.result(), "message", "")
            )
        )


if __name__ == "__main__":
    rclpy.init()
    peer = rclpy.create_node("peer")
    listen(peer)
    threading.Thread(target=obey, args=(peer,), daemon=True).start()
    tell(topic="ready")
    rclpy.spin(peer)

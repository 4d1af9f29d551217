"""A second ROS 2 node: messages as JSON lines, calls from stdin; nothing of the project."""

from __future__ import annotations

import json
import sys
import threading
import time
from importlib.util import find_spec

import rclpy
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.task import Future
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}
STATES = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_CANCELED: "canceled",
    GoalStatus.STATUS_ABORTED: "aborted",
}


ONE_LINE = threading.Lock()
"""Two threads print."""


def tell(**fields: object) -> None:
    with ONE_LINE:
        print(json.dumps(fields), flush=True)


def content(one: DiagnosticStatus) -> dict:
    """A status as printed."""
    return {
        "level": one.level[0],
        "name": one.name,
        "message": one.message,
        "values": {pair.key: pair.value for pair in one.values},
    }


def status(topic: str, array: DiagnosticArray) -> None:
    """Print the first status of an array, and those of the fingers after it."""
    one, *others = map(content, array.status)
    stamp = array.header.stamp.sec + array.header.stamp.nanosec / 1e9
    tell(
        topic=topic,
        **one,
        fingers=others,
        stamp=stamp,
        frame_id=array.header.frame_id,
        monotonic_ns=time.monotonic_ns(),
    )


def listen(node: Node) -> None:
    """Subscribe to all topics of the box."""
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(
        DiagnosticArray, "/palpate/verdict", lambda m: status("verdict", m), 50
    )
    node.create_subscription(DiagnosticArray, "/palpate/state", lambda m: status("state", m), late)
    node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: status("diagnostics", m), 10
    )
    node.create_subscription(
        Image,
        "/palpate/frames",
        lambda m: tell(
            topic="frames",
            shape=[m.height, m.width],
            encoding=m.encoding,
            step=m.step,
            data=m.data.tolist(),
            frame_id=m.header.frame_id,
        ),
        qos_profile_sensor_data,
    )


def fields(message: object) -> dict:
    """The fields of a message, without nested messages."""
    return {name: getattr(message, name) for name in message.get_fields_and_field_types()}


class Sweeper:
    """Sends goals to the action, and cancels the goal that was accepted last.

    It reads feedback from its topic. rclpy's client drops feedback after the result, and may see
    the result first.
    """

    def __init__(self, node: Node) -> None:
        from palpate_msgs.action import Sweep

        self._goal = Sweep.Goal
        self._client = ActionClient(node, Sweep, "/palpate/sweep")
        self._accepted = None
        node.create_subscription(
            Sweep.Impl.FeedbackMessage,
            "/palpate/sweep/_action/feedback",
            lambda m: tell(topic="feedback", **fields(m.feedback)),
            10,
        )

    def send(self, **terms: float | bool) -> None:
        """Send a goal and print its result."""
        if not self._client.wait_for_server(20):
            tell(topic="result", state="no such action")
            return
        self._client.send_goal_async(self._goal(**terms)).add_done_callback(self._answered)

    def cancel(self) -> None:
        self._accepted.cancel_goal_async()

    def _answered(self, sent: Future) -> None:
        goal = sent.result()
        if not goal.accepted:
            tell(topic="result", state="rejected")
            return
        self._accepted = goal
        goal.get_result_async().add_done_callback(
            lambda done: tell(
                topic="result", state=STATES[done.result().status], **fields(done.result().result)
            )
        )


def allow_writes(node: Node) -> None:
    """Try to set the parameter allow_writes of the bridge."""
    client = node.create_client(SetParameters, "/palpate/set_parameters")
    wanted = Parameter("allow_writes", value=True).to_parameter_msg()
    client.wait_for_service(20)
    client.call_async(SetParameters.Request(parameters=[wanted])).add_done_callback(
        lambda done: tell(
            service="allow_writes",
            success=done.result().results[0].successful,
            message=done.result().results[0].reason,
        )
    )


def obey(node: Node, sweeper: Sweeper | None) -> None:
    """Call the services that stdin names, in turn. A JSON object is a goal of the action."""
    for line in sys.stdin:
        name = line.strip()
        if name.startswith("{"):
            sweeper.send(**json.loads(name))
            continue
        if name == "cancel":
            sweeper.cancel()
            continue
        if name == "allow_writes":
            allow_writes(node)
            continue
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
                service=name,
                success=done.result().success,
                message=getattr(done.result(), "message", ""),
            )
        )


if __name__ == "__main__":
    rclpy.init()
    peer = rclpy.create_node("peer")
    listen(peer)
    # It subscribes long before the first goal, because feedback is not sent again.
    sweeps = Sweeper(peer) if find_spec("palpate_msgs") else None
    threading.Thread(target=obey, args=(peer, sweeps), daemon=True).start()
    tell(topic="ready")
    rclpy.spin(peer)

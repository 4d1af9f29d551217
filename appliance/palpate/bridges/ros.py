"""The box as a ROS 2 node with a lifecycle, over its serial line or its feed. Publishes verdicts,
state, frames and diagnostics in standard messages and the messages of ros_optional.py, and offers
services and the action of palpate_msgs (docs/robots/ros2.md)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from struct import pack
from typing import TYPE_CHECKING, Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from palpate.bridges.ros_optional import OptionalTopics
from palpate.bridges.source import BoxView, FeedSource, LineSource, Source
from palpate.client.answers import Answer
from palpate.client.box import BAUD, Heard
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError, CommandRefused

if TYPE_CHECKING:
    from palpate.bridges.ros_action import SweepAction

SERVICES = {"start": "START", "stop": "STOP", "new_object": "NEW", "tare": "TARE", "abort": "ABORT"}
ENCODINGS = {
    "uint8": ("8UC", "B", 1),
    "int16": ("16SC", "h", 2),
    "uint16": ("16UC", "H", 2),
    "float32": ("32FC", "f", 4),
}
"""For sensor_msgs/Image: encoding, type of struct and bytes of a raw count, by data type."""
PARAMETERS: Mapping[str, Any] = {
    "port": "",
    "feed": "",
    "baud": BAUD,
    "frame_id": "palpate",
    "frames_hz": 0.0,
    "autostart": True,
    "allow_writes": False,
}
FIXED = frozenset({"allow_writes"})
"""Parameters that no other node may set."""
LOOK_S = 0.5
"""Longest time between two checks whether the node has to end."""
RELIABLE = QoSProfile(depth=50)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A later subscriber also gets the last state."""


def values(fields: Mapping[str, Any]) -> list[KeyValue]:
    """Fields as texts: true and false in lower case, numbers as Python writes them, "" for None."""
    texts = {name: str(v).lower() if isinstance(v, bool) else str(v) for name, v in fields.items()}
    return [KeyValue(key=k, value="" if fields[k] is None else text) for k, text in texts.items()]


def verdict_status(answer: Answer, code: int) -> DiagnosticStatus:
    """An answer of the box or of a finger: OK with the label, WARN if the label cannot be used,
    ERROR if nothing was learned about the object."""
    level = DiagnosticStatus.ERROR if answer.faulty else DiagnosticStatus.WARN
    fields = {name: v for name, v in asdict(answer).items() if name not in ("finger", "fingers")}
    fields |= {"early": answer.early, "known": answer.known, "unsure": answer.unsure, "code": code}
    return DiagnosticStatus(
        level=DiagnosticStatus.OK if answer.known else level,
        name=f"palpate: verdict {answer.finger}".rstrip(),
        hardware_id=answer.bundle,
        message=answer.label if answer.known else f"{answer.status}: {answer.what_to_do}",
        values=values(fields),
    )


def box_status(view: BoxView, before: BoxView, *, alive: bool) -> DiagnosticStatus:
    """The state of the box: STALE if it is not heard, ERROR if its skin does not stream, WARN if
    anything was lost since `before`."""
    state = view.state
    counts = {
        "answers did not arrive": view.missed - before.missed,
        "sentences were damaged": view.damaged - before.damaged,
    }
    if state and before.state:
        counts["frames were lost"] = state.lost_frames - before.state.lost_frames
    hurt = ", ".join(f"{count} {what}" for what, count in counts.items() if count > 0)
    if not alive or state is None:
        level, text = DiagnosticStatus.STALE, view.trouble or "nothing is heard of the box"
    elif state.skin != "streaming":
        level, text = DiagnosticStatus.ERROR, f"the skin is {state.skin}"
    elif hurt:
        level, text = DiagnosticStatus.WARN, hurt
    else:
        level, text = DiagnosticStatus.OK, "streaming"
    fields = (asdict(state) | {"ready": state.ready}) if state else {}
    fields |= {"missed": view.missed, "damaged": view.damaged, "trouble": view.trouble}
    return DiagnosticStatus(
        level=level,
        name="palpate: box",
        message=text,
        hardware_id=state.bundle if state else "",
        values=values(fields),
    )


def image(taxels: Sequence[Any], dtype: str) -> Image:
    """A frame of raw counts, rows along the direction of sliding, one channel for each axis. A
    count that is not a number becomes NaN."""
    kind, letter, size = ENCODINGS[dtype]
    rows = [[cell if isinstance(cell, list) else [cell] for cell in row] for row in taxels]
    counts = [
        float("nan") if count is None else count for row in rows for cell in row for count in cell
    ]
    channels = len(rows[0][0])
    step = len(rows[0]) * channels * size
    return Image(
        height=len(rows),
        width=len(rows[0]),
        encoding=f"{kind}{channels}",
        step=step,
        data=pack(f"<{len(counts)}{letter}", *counts),
    )


class PalpateNode(LifecycleNode):  # type: ignore[misc]
    """The node `palpate`. News of the box arrives in another thread and is published by the
    executor."""

    def __init__(self) -> None:
        super().__init__("palpate")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default, ParameterDescriptor(read_only=name in FIXED))
        self._monotonic = SystemClock()
        self._source: Source | None = None
        self._news: deque[Heard | Mapping[str, Any]] = deque(maxlen=256)
        self._before = BoxView()
        self._shown: tuple[Any, ...] = ()
        self._made: list[tuple[Callable[[Any], object], Any]] = []
        self._sweeps = self._sweep_action()
        self._optional = OptionalTopics(self)
        for topic, why in self._optional.missing.items():
            self.get_logger().info(f"~/{topic} is not published ({why})")
        if self.setting("autostart"):
            self.trigger_configure()
            self.trigger_activate()

    def setting(self, name: str) -> Any:
        return self.get_parameter(name).value

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the serial line or the feed, and offer diagnostics and services."""
        if bool(self.setting("port")) == bool(self.setting("feed")):
            self.get_logger().error("name the box with one of the parameters port and feed")
            return TransitionCallbackReturn.FAILURE
        guard = self.create_guard_condition(self._publish_news)

        def heard(news: Heard | Mapping[str, Any]) -> None:
            self._news.append(news)
            guard.trigger()

        if self.setting("feed"):
            frames_hz = float(self.setting("frames_hz"))
            self._source = FeedSource(
                self.setting("feed"), heard=heard, frame=heard, frames_hz=frames_hz
            )
        else:
            self._source = LineSource(self.setting("port"), baud=self.setting("baud"), heard=heard)
        self._verdicts = self.create_lifecycle_publisher(DiagnosticArray, "~/verdict", RELIABLE)
        self._states = self.create_lifecycle_publisher(DiagnosticArray, "~/state", LATCHED)
        self._frames = self.create_lifecycle_publisher(Image, "~/frames", qos_profile_sensor_data)
        self._optional.open({"tactile": qos_profile_sensor_data, "classification": RELIABLE})
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # a command may take seconds, and verdicts must not wait for it
        asking = MutuallyExclusiveCallbackGroup()
        self._made = [
            (self.destroy_guard_condition, guard),
            (self.destroy_publisher, self._diagnostics),
            (self.destroy_timer, self.create_timer(1.0, self._report)),
        ]
        for name, command in SERVICES.items():
            service = self.create_service(
                Trigger, f"~/{name}", self._service(command), callback_group=asking
            )
            self._made.append((self.destroy_service, service))
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState | None = None) -> TransitionCallbackReturn:
        """Close the box's serial line or feed, and end everything that `on_configure` has begun."""
        if self._sweeps:
            self._sweeps.interrupt()
        if self._source:
            self._source.close()
            self._source = None
        for destroy, thing in self._made:
            destroy(thing)
        for publisher in (self._verdicts, self._states, self._frames) if self._made else ():
            self.destroy_lifecycle_publisher(publisher)
        self._optional.close()
        self._made, self._shown = [], ()
        self._news.clear()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

    def _sweep_action(self) -> SweepAction | None:
        """The action, if its messages are installed."""
        try:
            from palpate.bridges.ros_action import SweepAction
        except ImportError as e:
            self.get_logger().info(
                f"~/sweep is not offered ({e}); build palpate_msgs, see docs/robots/ros2.md"
            )
            return None
        return SweepAction(self, self._box)

    def _box(self) -> Source:
        """The box, for a command. Raises ApplianceError if commands are refused."""
        if self._source is None:
            raise ApplianceError("the node is not configured; send it the transition `configure`")
        if not self.setting("allow_writes"):
            raise CommandRefused(
                "commands are refused; start the bridge with -p allow_writes:=true"
            )
        return self._source

    def _service(self, command: str) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, self._box().send(command)
            except ApplianceError as e:
                response.success, response.message = False, str(e)
            return response

        return answer

    def _array(self, *statuses: DiagnosticStatus) -> DiagnosticArray:
        array = DiagnosticArray(status=[*statuses])
        array.header.stamp = self.get_clock().now().to_msg()
        array.header.frame_id = self.setting("frame_id")
        return array

    def _publish_news(self) -> None:
        while self._news and self._source:
            news = self._news.popleft()
            if isinstance(news, Answer):
                code = self._source.view().code
                each = (verdict_status(of, code(of.label)) for of in (news, *news.fingers))
                array = self._array(*each)
                self._verdicts.publish(array)
                self._optional.answered(news, array.header)
            elif isinstance(news, Mapping):
                self._publish_frame(news)
            else:
                self._show(self._source.view())

    def _publish_frame(self, line: Mapping[str, Any]) -> None:
        source: FeedSource = self._source  # type: ignore[assignment]
        message = image(line["taxels"], source.format["dtype"])
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.setting("frame_id")
        self._frames.publish(message)
        self._optional.frame(line["taxels"], message.header)

    def _show(self, view: BoxView) -> None:
        """Publish the state if it has changed."""
        alive = view.alive(self._monotonic.now_ns())
        state = view.state
        now = (alive, state.skin, state.sweeping, state.bundle) if state else (alive,)
        if now != self._shown and self._states.is_activated:
            self._shown = now
            self._states.publish(self._array(box_status(view, view, alive=alive)))

    def _report(self) -> None:
        """Publish diagnostics, once a second, and the state of a box that has fallen silent."""
        if self._source:
            view = self._source.view()
            alive = view.alive(self._monotonic.now_ns())
            self._diagnostics.publish(self._array(box_status(view, self._before, alive=alive)))
            self._before = view
            self._show(view)


def run(arguments: Sequence[str]) -> None:
    """Serve until SIGINT or SIGTERM. arguments: of ROS."""
    rclpy.init(args=["palpate", "--ros-args", *arguments] if arguments else ["palpate"])
    node = PalpateNode()
    # news; a command; a sweep; goals and cancelling meanwhile
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    try:
        # a signal wakes the executor before it ends the context, so a wait without end might go on
        while rclpy.ok():
            executor.spin_once(timeout_sec=LOOK_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.on_cleanup()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()

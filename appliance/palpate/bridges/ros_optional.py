"""Topics in messages that an installation of ROS 2 may lack: tactile_msgs for frames, vision_msgs
for answers. Without their packages they are left out.

Sources: TactileState.msg and the README of urdf_tactile (github.com/ubi-agni/tactile_toolbox),
Classification.msg (github.com/ros-perception/vision_msgs, 4.0 and later).
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from palpate.client.answers import Answer

TOPICS = {
    "tactile": ("tactile_msgs", "TactileState"),
    "classification": ("vision_msgs", "Classification"),
}
"""Package and message of each topic."""


class OptionalTopics:
    """The topics of a lifecycle node whose packages are installed.

    missing: the topics that are left out, with the reason.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._types: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self.missing: dict[str, str] = {}
        for topic, (package, name) in TOPICS.items():
            try:
                self._types[topic] = getattr(import_module(f"{package}.msg"), name)
            except (ImportError, AttributeError) as e:
                self.missing[topic] = str(e)

    def open(self, qualities: dict[str, Any]) -> None:
        """Begin to publish. qualities: the quality of service by topic."""
        for topic, kind in self._types.items():
            self._publishers[topic] = self._node.create_lifecycle_publisher(
                kind, f"~/{topic}", qualities[topic]
            )

    def close(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers = {}

    def frame(self, taxels: Sequence[Any], header: Any) -> None:
        """Publish the raw counts of a frame.

        A sensor is named after the frame of the header, and its values are row by row, as
        urdf_tactile describes an array. TactileState is for normal forces: of several axes the last
        has that name, and each other a sensor NAME_AXIS of its own, from 1 on.
        """
        if "tactile" not in self._publishers:
            return
        cells = [cell if isinstance(cell, list) else [cell] for row in taxels for cell in row]
        axes, name = len(cells[0]), header.frame_id
        channel = import_module("sensor_msgs.msg").ChannelFloat32
        sensors = [
            channel(
                name=name if axis == axes - 1 else f"{name}_{axis + 1}",
                values=[float("nan") if c[axis] is None else float(c[axis]) for c in cells],
            )
            for axis in (axes - 1, *range(axes - 1))
        ]
        self._publish("tactile", header, sensors=sensors)

    def answered(self, answer: Answer, header: Any) -> None:
        """Publish the label of an answer with its probability; nothing in `results` without one."""
        if "classification" not in self._publishers:
            return
        hypothesis = import_module("vision_msgs.msg").ObjectHypothesis
        found = [hypothesis(class_id=answer.label, score=answer.probability)]
        self._publish("classification", header, results=found if answer.label else [])

    def _publish(self, topic: str, header: Any, **fields: Any) -> None:
        self._publishers[topic].publish(self._types[topic](header=header, **fields))

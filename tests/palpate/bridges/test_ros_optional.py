"""Topics in messages of packages that ROS 2 may lack, with stand-ins for their classes."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from palpate.bridges.ros_optional import OptionalTopics
from palpate.client.answers import Answer
from tests.factories.speaking_box import result

HEADER = SimpleNamespace(frame_id="fingertip")


@dataclass(kw_only=True)
class ChannelFloat32:
    """As in sensor_msgs: rclpy's classes refuse other names, and values that are not floats."""

    name: str
    values: list[float]

    def __post_init__(self) -> None:
        assert all(type(value) is float for value in self.values)


@dataclass(kw_only=True)
class TactileState:
    """As in tactile_msgs."""

    header: Any
    sensors: list[ChannelFloat32]


@dataclass(kw_only=True)
class ObjectHypothesis:
    """As in vision_msgs 4.0."""

    class_id: str = ""
    score: float = 0.0


@dataclass(kw_only=True)
class Classification:
    """As in vision_msgs 4.0."""

    header: Any
    results: list[ObjectHypothesis]


@dataclass
class PublishingNode:
    """A node that keeps its messages by topic."""

    heard: dict[str, list[Any]] = field(default_factory=dict)
    qualities: dict[str, Any] = field(default_factory=dict)

    def create_lifecycle_publisher(self, kind: type, topic: str, quality: Any) -> Any:
        self.qualities[topic] = quality
        kept = self.heard.setdefault(topic, [])

        def publish(message: Any) -> None:
            assert type(message) is kind
            kept.append(message)

        return SimpleNamespace(publish=publish, topic=topic)

    def destroy_lifecycle_publisher(self, publisher: Any) -> None:
        del self.qualities[publisher.topic]


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The packages are installed."""
    for package, kinds in (
        ("sensor_msgs", (ChannelFloat32,)),
        ("tactile_msgs", (TactileState,)),
        ("vision_msgs", (Classification, ObjectHypothesis)),
    ):
        module = ModuleType(f"{package}.msg")
        vars(module).update({kind.__name__: kind for kind in kinds})
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)


def topics(node: PublishingNode) -> OptionalTopics:
    made = OptionalTopics(node)
    made.open({"tactile": 1, "classification": 2})
    return made


def answer(line: bytes) -> Answer:
    found = Answer.read(line.decode())
    assert found
    return found


@pytest.mark.usefixtures("packages")
def test_an_answer_is_a_classification():
    """The label with its probability; an answer without a label has no result."""
    node = PublishingNode()
    made = topics(node)
    assert node.qualities == {"~/tactile": 1, "~/classification": 2}
    made.answered(answer(result(1, label="paper")), HEADER)
    made.answered(answer(result(2, "unknown", "")), HEADER)
    known, unknown = node.heard["~/classification"]
    assert known == Classification(
        header=HEADER, results=[ObjectHypothesis(class_id="paper", score=0.9)]
    )
    assert unknown.results == []
    made.close()
    assert node.qualities == {}
    made.answered(answer(result(3)), HEADER)
    assert len(node.heard["~/classification"]) == 2


@pytest.mark.usefixtures("packages")
def test_a_frame_is_a_tactile_state():
    """Row by row, under the name of the frame; of three axes the last has that name."""
    node = PublishingNode()
    made = topics(node)
    made.frame([[1, 2], [3, None]], HEADER)
    made.frame([[[1, 2, 3]], [[4, 5, 6]]], HEADER)
    flat, sheared = node.heard["~/tactile"]
    assert (flat.header, flat.sensors[0].name) == (HEADER, "fingertip")
    assert flat.sensors[0].values[:3] == [1.0, 2.0, 3.0]
    assert str(flat.sensors[0].values[3]) == "nan"
    assert {s.name: s.values for s in sheared.sensors} == {
        "fingertip": [3.0, 6.0],
        "fingertip_1": [1.0, 4.0],
        "fingertip_2": [2.0, 5.0],
    }
    assert sheared.sensors[0].name == "fingertip"


def test_without_the_packages_nothing_is_published(packages, monkeypatch):
    """The reason is kept for the log: a package that is missing, or too old."""
    monkeypatch.setitem(sys.modules, "tactile_msgs.msg", None)
    monkeypatch.delattr(sys.modules["vision_msgs.msg"], "Classification")
    node = PublishingNode()
    made = topics(node)
    made.frame([[1]], HEADER)
    made.answered(answer(result(1)), HEADER)
    assert (node.heard, node.qualities) == ({}, {})
    assert made.missing["tactile"].startswith("import of tactile_msgs.msg halted")
    assert "Classification" in made.missing["classification"]
    made.close()

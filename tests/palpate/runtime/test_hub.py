"""Several fingers in one stream: parts of the frames of a hub."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.config import Config
from palpate.core.errors import ConfigError
from palpate.core.types import Frames, SweepFormat, Verdict
from palpate.io import skins
from palpate.io.hand_sensor import HandSensor, HandSkin
from palpate.io.robot_link import StdoutPort
from palpate.io.sensor import SensorCounters
from palpate.runtime import assembly, hand
from palpate.sim import rig, skin
from tests.factories import hands, toy_bundle
from tests.factories.settings import load
from tests.factories.simulated_box import SECOND
from tests.factories.skins import devices as played

ROWS = ["skins.left.part=1/2 rows", "skins.right.part=2/2 rows"]
TSF = SweepFormat(7, 4, 50.0, 50, "uint16")


def side_by_side(act: rig.Act, axis: int) -> rig.Act:
    """The act as a hub sends it: the frames of the second finger beside or below the first's."""
    return replace(act, frames=np.concatenate([act.frames, *act.others], 1 + axis), others=())


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Closes what a test has opened."""
    with ExitStack() as opened:
        yield opened


@pytest.mark.parametrize(
    ("axis", "parts", "format"),
    [
        (0, "rows", replace(skin.FORMAT, rows=8)),
        (1, "columns", replace(skin.FORMAT, cols=8)),
    ],
)
def test_one_board_with_two_sensors_counts_as_two(
    stack: ExitStack, axis: int, parts: str, format: SweepFormat
):
    """Each finger gets its part of every frame, and is answered by the bundle for one sensor."""
    acts = hands.acts(11, 2)
    acts[1] = hands.lifted(acts[1], 1)
    settings = load([f"skins.left.part=1/2 {parts}", f"skins.right.part=2/2 {parts}"])
    hub = [side_by_side(act, axis) for act in acts]
    box = hands.build(stack, hub, settings=settings, formats={"left": format})
    verdicts = box.until(lambda: box.box.answered == 2)
    assert [[str(v.status) for v in verdict.fingers] for verdict in verdicts] == [
        ["ok", "ok"],
        ["ok", "no-contact"],
    ]
    assert [v.label for v in verdicts] == [act.label for act in acts]
    assert box.box.counters.enumerations == 1
    assert box.box.counters.lost_frames == 0
    middle = (acts[0].start + acts[0].stop) // 2
    for own, frames in zip(box.kept[0].fingers, (acts[0].frames, *acts[0].others), strict=True):
        assert any(
            (frames[middle - 750 + k : middle + 750 + k] == own.frames.taxels).all()
            for k in (-1, 0, 1)
        )


def test_a_hub_that_is_unplugged_takes_all_its_fingers(stack: ExitStack):
    """The sweep is `sensor-lost`, once for each finger."""
    hub = [side_by_side(act, 0) for act in hands.acts(12, 1)]
    format = replace(skin.FORMAT, rows=8)
    box = hands.build(stack, hub, settings=load(ROWS), formats={"left": format})
    bus = box.simulated.buses["left"]
    bus.at(3 * SECOND, bus.unplug)
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert [str(v.status) for v in (*verdict.fingers, verdict)] == ["sensor-lost"] * 3
    assert box.box.health.degraded.count(",") == 1


def test_two_fingertips_of_a_gripper_on_one_serial_port(stack: ExitStack, tmp_path: Path):
    """Robotiq's TSF-85 sends both fingers in one stream, 14x4. Bundles are for one of 7x4."""
    settings = load(["skin.profile=robotiq-tsf", *ROWS])
    one = toy_bundle.load(tmp_path / "toy", format=TSF)
    a, c = toy_bundle.window(0, 0, TSF), toy_bundle.window(0, 6, TSF)
    frames = np.tile(np.concatenate([a, c], axis=1), (3, 1, 1))
    act = rig.Act(frames, 10, 140, "")
    whole = replace(TSF, rows=14)
    profile = skins.profile(settings)
    simulated = played.build("robotiq-tsf", profile, whole, [act], rig.VirtualClock(), "sim")
    box = assembly.box(
        settings,
        one,
        simulated,
        StdoutPort("sim"),
        stack,
        bundles=assembly.of_fingers(settings, one, answers=False),
    )
    found: list[Verdict] = []
    while not found:
        found += box.step()
    assert [(v.finger, v.label) for v in found[0].fingers] == [("left", "a"), ("right", "c")]


class OneRead:
    """A sensor that gives the same frames at each read."""

    state, trouble, identity, clock, loss_known = "streaming", None, None, None, True
    waits = True

    def __init__(self, frames: Frames) -> None:
        self.frames, self.reads = frames, 0
        self.counters = SensorCounters(frames=5)

    def read(self) -> Frames:
        """The frames."""
        self.reads += 1
        return self.frames


def test_a_hub_is_read_once_for_all_its_fingers():
    """Its fingers come one after the other, then the next skin; an empty read has one turn."""
    n = np.arange(2)
    hub = OneRead(Frames(n, n, np.arange(2 * 6 * 2).reshape(2, 6, 2)))
    own = OneRead(Frames(n, n, np.zeros((2, 2, 2))))
    sensor = HandSensor([HandSkin(hub, ("a", "b", "c")), HandSkin(own, ("d",))])
    turns = [sensor.read() for _ in range(8)]
    assert [f.finger for f in turns] == [*"abcd"] * 2
    assert (hub.reads, own.reads) == (2, 2)
    assert (turns[1].taxels == hub.frames.taxels[:, 2:4]).all()
    assert sensor.counters.frames == 10
    hub.frames = Frames(n[:0], n[:0], np.zeros((0, 6, 2)))
    assert [sensor.read().finger for _ in range(4)] == ["a", "d", "a", "d"]


def of(*parts: str) -> Config:
    """Settings of a hub with these parts."""
    return load([f"skins.f{i}.part={part}" for i, part in enumerate(parts)])


@pytest.mark.parametrize(
    "parts", [("1/2 rows", "2/2 columns"), ("1/3 rows", "2/3 rows"), ("1/2 rows", "2/3 rows")]
)
def test_parts_that_are_not_one_whole_are_refused(parts: tuple[str, ...]):
    """The message has the parts, and shows how to give them."""
    model = bundle.load(bundle.DEFAULT)
    settings = of(*parts)
    given = dict.fromkeys(settings.skins, model)
    with pytest.raises(ConfigError, match=r'are "1/.*, not one whole; give them "1/2 rows" and'):
        hand.assembled(settings, given, hands.idle(settings))


def test_parts_of_different_forms_are_refused(tmp_path: Path):
    """A hub is cut into equal parts, so its bundles are for one form of skin."""
    model, other = bundle.load(bundle.DEFAULT), toy_bundle.load(tmp_path / "toy")
    settings = of("1/2 rows", "2/2 rows")
    with pytest.raises(ConfigError, match=r"skins.f0, skins.f1 are parts of one hub, but"):
        hand.assembled(settings, {"f0": model, "f1": other}, hands.idle(settings))

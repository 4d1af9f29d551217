"""A box with several fingers on simulated devices: a trigger in, an answer of each finger and one
of the hand out, and what happens when a finger is unplugged or does not touch."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pynmea2
import pytest

from palpate.core.errors import ConfigError
from palpate.core.types import Status, Verdict
from palpate.inference.objects import fuse
from palpate.sim import devices, rig, skin
from tests.factories import hands
from tests.factories.simulated_box import SECOND, Rigged


@pytest.fixture
def hand() -> Iterator[Callable[..., Rigged]]:
    """Builds hands; closes them after the test."""
    with ExitStack() as stack:
        yield lambda *args, **more: hands.build(stack, *args, **more)


def kinds(box: Rigged) -> list[str]:
    """Kind and finger of each sentence with an answer."""
    found = [line.split(",") for line in box.heard]
    return [f[2] if f[1] == "FIN" else f[1] for f in found if f[1] in ("FIN", "RES")]


def statuses(verdict: Verdict) -> list[str]:
    """The statuses of the fingers, then of the hand."""
    return [str(v.status) for v in (*(verdict.fingers or ()), verdict)]


@pytest.mark.parametrize("fingers", [hands.TWO, ("a", "b", "c", "d")])
def test_each_sweep_has_an_answer_of_each_finger_and_of_the_hand(
    hand: Callable[..., Rigged], fingers: tuple[str, ...]
):
    """FIN of each finger in the order of the settings, then RES, whose probabilities are the
    product of theirs. No frame is lost, and each finger has its own window."""
    acts = hands.acts(2, 3, len(fingers))
    box = hand(acts, fingers)
    verdicts = box.until(lambda: box.box.answered == 3)
    box.seconds(0.1)
    assert kinds(box) == [*fingers, "RES"] * 3
    for line in box.heard:
        pynmea2.parse(line, check=True)
    assert box.box.counters.lost_frames == 0
    for verdict, act, sweep in zip(verdicts, acts, box.kept, strict=True):
        assert (verdict.status, verdict.label) == ("ok", act.label)
        assert [v.finger for v in verdict.fingers] == [*fingers]
        product = fuse([v.own for v in verdict.fingers], "product")
        assert verdict.scores.tobytes() == product.tobytes()
        middle = (act.start + act.stop) // 2
        for own, frames in zip(sweep.fingers, (act.frames, *act.others), strict=True):
            assert any(
                (frames[middle - 750 + k : middle + 750 + k] == own.frames.taxels).all()
                for k in (-1, 0, 1)
            )


def test_a_finger_without_contact_is_left_out(hand: Callable[..., Rigged]):
    """The hand has the answer of the finger that touches; without any contact it has
    `no-contact`."""
    one, two, three = hands.acts(2, 3)
    both = hands.lifted(hands.lifted(three, 0), 1)
    box = hand([hands.lifted(one, 0), hands.lifted(two, 1), both])
    verdicts = box.until(lambda: box.box.answered == 3)
    assert [statuses(v) for v in verdicts] == [
        ["no-contact", "ok", "ok"],
        ["ok", "no-contact", "ok"],
        ["no-contact", "no-contact", "no-contact"],
    ]
    for verdict, finger, act in ((verdicts[0], 1, one), (verdicts[1], 0, two)):
        assert verdict.label == act.label
        assert verdict.scores.tobytes() == verdict.fingers[finger].scores.tobytes()
        assert verdict.degraded == ""
    assert verdicts[0].detail == "left no-contact"


def test_a_finger_that_is_unplugged_in_a_sweep_leaves_the_other(hand: Callable[..., Rigged]):
    """The sweep goes on with the other finger. READY stays, STA and the state name the finger until
    it is back."""
    acts = hands.acts(3, 4)
    box = hand(acts)
    box.until(lambda: box.box.answered == 1)
    begin, bus = box.simulated.clock.now_ns(), box.simulated.buses["left"]
    bus.at(begin + 2 * SECOND, bus.unplug)
    (lost,) = box.until(lambda: box.box.answered == 2)
    assert statuses(lost) == ["sensor-lost", "ok", "ok"]
    assert (lost.label, lost.detail) == (acts[1].label, "left sensor-lost")
    assert lost.degraded == "left sensor-lost"
    health = box.box.health
    assert (health.degraded, health.skin, health.streams) == ("left absent", "streaming", True)
    assert health.trouble.startswith("left: ")
    (absent,) = box.until(lambda: box.box.answered == 3)
    assert statuses(absent) == ["sensor-lost", "ok", "ok"]
    assert any(line.split("*")[0].endswith(",left absent") for line in box.heard)
    bus.plug()
    (back,) = box.until(lambda: box.box.answered == 4)
    assert statuses(back) == ["ok", "ok", "ok"]
    assert box.box.health.degraded == ""
    written = box.simulated.gpio.written
    assert [level for t, n, level in written if n == devices.FAULT and t > begin] == []


def test_a_finger_with_a_skin_of_another_form_leaves_the_other(hand: Callable[..., Rigged]):
    """As when one finger has taught a bundle for all: it is in service with the finger that it
    fits, and the state names the other, with both forms and what to do."""
    wide = replace(skin.FORMAT, rows=8)
    (act,) = hands.acts(3, 1)
    act = replace(act, others=(np.tile(act.frames, (1, 2, 1)),))
    box = hand([act], formats={"left": skin.FORMAT, "right": wide})
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert statuses(verdict) == ["ok", "sensor-lost", "ok"]
    assert verdict.label == act.label
    health = box.box.health
    assert (health.degraded, health.streams) == ("right mismatch", True)
    assert health.trouble.startswith("right: the skin sends 8x4 uint8 at 750 Hz, wanted is 4x4")


def test_without_any_finger_the_box_is_not_ready(hand: Callable[..., Rigged]):
    """With both skins gone the sweep is `sensor-lost` at once, and FAULT rises; with one of them
    back the box is ready again."""
    box = hand(hands.acts(3, 2))
    box.seconds(0.5)
    for bus in box.simulated.buses.values():
        bus.at(2 * SECOND, bus.unplug)
    (lost,) = box.until(lambda: box.box.answered == 1, limit_s=1.6)
    assert statuses(lost) == ["sensor-lost"] * 3
    box.seconds(0.5)
    assert (box.box.health.skin, box.box.health.ready) == ("absent", False)
    assert box.box.health.degraded == "left absent, right absent"
    box.simulated.buses["right"].plug()
    box.seconds(0.5)
    assert (box.box.health.skin, box.box.health.degraded) == ("streaming", "left absent")
    levels = [level for _, n, level in box.simulated.gpio.written if n == devices.FAULT]
    assert levels == [True, False]


def test_a_finger_that_is_away_is_not_waited_for(hand: Callable[..., Rigged]):
    """Turns of the other finger come as often as its packets, 6 frames at 750 Hz."""
    box = hand(hands.acts(4, 1))
    box.simulated.buses["left"].unplug()
    box.seconds(1)
    times = []
    for _ in range(200):
        box.box.step()
        times.append(box.simulated.clock.now_ns())
    assert max(b - a for a, b in itertools.pairwise(times)) < 9_000_000


def test_a_finger_that_falls_silent_leaves_the_other(hand: Callable[..., Rigged]):
    """A board that is there and sends nothing is `silent`; the other loses no frame."""
    acts = hands.acts(5, 2)
    box = hand(acts)
    box.seconds(1)
    box.simulated.buses["right"].board.request = lambda request: None
    box.simulated.buses["right"].board.running = False
    verdicts = box.until(lambda: box.box.answered == 2)
    assert [statuses(v) for v in verdicts] == [["ok", "sensor-lost", "ok"]] * 2
    assert [v.label for v in verdicts] == [a.label for a in acts]
    assert box.box.counters.lost_frames == 0


def test_sweeps_of_one_object_are_fused_over_all_fingers(hand: Callable[..., Rigged]):
    """Each finger answers a sweep alone, the hand with the earlier sweeps of the object, also if
    one finger did not touch in one of them."""
    first, second = hands.acts(6, 2, only="wood")
    box = hand([replace(first, new_object=True), hands.lifted(second, 1)])
    one, two = box.until(lambda: box.box.answered == 2)
    assert (one.fused, two.fused, two.after) == (1, 2, 1)
    assert [v.fused for v in (*one.fingers, *two.fingers)] == [1, 1, 1, 0]
    product = fuse([one.own, two.own], "product")
    np.testing.assert_allclose(two.scores, product, rtol=1e-12)


def test_commands(hand: Callable[..., Rigged]):
    """ID and TEST name all; TARE takes each finger's own frames, and none while one is away; ABORT
    answers each finger."""
    box = hand(hands.acts(7, 2))
    box.seconds(0.1)
    assert ",TARE,error,tare needs 0.5 s" in box.ask("$PPLP,TARE")
    assert "palpate-sim SIM0001+SIM0002 1.0.0" in box.ask("$PPLP,ID")
    assert box.ask("$PPLP,TEST").count("golden sweeps differ by") == 2
    box.seconds(0.6)
    box.pulse(devices.START, 0.1)
    box.seconds(0.3)
    box.ask("$PPLP,ABORT")
    assert kinds(box) == ["left", "right", "RES"]
    assert ",TARE,ok,left largest" in box.ask("$PPLP,TARE")
    box.simulated.buses["left"].unplug()
    box.seconds(0.6)
    assert ",TARE,error,tare needs 0.5 s" in box.ask("$PPLP,TARE")


def test_the_tare_of_a_finger_is_of_its_own_frames(hand: Callable[..., Rigged]):
    """The two skins have different counts, and so different tares."""
    act = hands.acts(8, 1)[0]
    frames, other = np.full_like(act.frames, 3), np.full_like(act.frames, 5)
    still = replace(act, frames=frames, others=(other,), start=10**7, stop=10**7 + 1)
    box = hand([still])
    box.seconds(1)
    assert ",TARE,ok,left largest 3.0 raw counts and right largest 5.0" in box.ask("$PPLP,TARE")


def test_the_simulated_fingers_follow_commands_together():
    """Lifted, sliding twice and lifted again, the second finger has its own frames of the same
    moments."""
    act = hands.acts(10, 1)[0]
    act = replace(act, others=(255 - act.frames,))
    robot = rig.Robot(iter([act, act]), [], start="", stop="", follows=True)
    film = rig.Film(robot, skin.FORMAT, skin.FORMAT)
    for first, command in ((0, None), (30, True), (3000, False), (3060, True), (3400, False)):
        if command is not None:
            robot.obey(first * 1000, start=command)
        one, two = (film.frames(first, 30, lambda i: i * 1000, finger) for finger in (0, 1))
        assert len(one) == len(two) == 30
        assert (two == 255 - one).all()
    assert robot.acts == 2


def test_a_box_with_one_skin_loads_nothing_of_hands():
    """Each import takes memory."""
    program = """
import sys
from palpate.cli.main import main
main(["run", "--sim", "skin", "--virtual", "--sweeps", "1"])
assert not [name for name in sys.modules if "hand_" in name or name.endswith("runtime.hand")]
print("clean")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert done.stdout.endswith("clean\n"), done.stderr


@pytest.mark.parametrize(
    ("sets", "what"),
    [(["classifier.early=true"], "classifier.early works with one skin only")],
)
def test_what_does_not_work_with_several_skins_is_refused(
    hand: Callable[..., Rigged], sets: list[str], what: str
):
    """With the names of the fingers, and what to do."""
    with pytest.raises(ConfigError, match=f"{what}, and .skins. has left, right; leave it out"):
        hand(hands.acts(1, 1), sets=sets)


def test_a_stopping_box_answers_each_finger(hand: Callable[..., Rigged]):
    """`aborted`, for the fingers and the hand."""
    box = hand(hands.acts(9, 1))
    box.seconds(1)
    box.box.run(lambda: True)
    box.listen(0.1)
    assert kinds(box) == ["left", "right", "RES"]
    assert sum(f",{Status.ABORTED}," in line for line in box.heard) == 3

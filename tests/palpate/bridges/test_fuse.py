"""Several units as one hand: the lines of their feeds in, FIN of each finger, RES and STA out."""

from __future__ import annotations

import math
from typing import Any

import pynmea2
import pytest

from palpate.bridges import command
from palpate.bridges.fuse import GRACE_NS, STATE_NS, FingerFusion, common
from palpate.client.answers import Answer, BoxState
from palpate.core import sentences
from palpate.core.errors import ConfigError
from palpate.sim.rig import VirtualClock
from tests.factories import feed_lines

LABELS = feed_lines.LABELS
FAULT = {"scores": [], "label": "", "probability": 0.0, "fused": 0}


class Fused:
    """A hand on a virtual clock. said: the sentences so far, without STA."""

    def __init__(self, *names: str) -> None:
        self.clock, self.lines = VirtualClock(), []
        self.hand = FingerFusion(
            names, 0.5, self.clock, lambda line: self.lines.append(line) is None
        )
        for name in names:
            self.take(name, feed_lines.hello())
            self.take(name, feed_lines.health(0))

    def take(self, *lines: Any) -> None:
        """A finger's name and its lines, then a turn."""
        for line in lines[1:]:
            self.hand.take(lines[0], line)
        self.hand.turn()

    def wait(self, ns: int) -> None:
        """Let time pass, then take a turn."""
        self.clock.sleep_until(self.clock.now_ns() + ns)
        self.hand.turn()

    @property
    def said(self) -> list[Answer]:
        """The answers in the sentences, each checked by another parser of NMEA 0183."""
        for line in self.lines:
            pynmea2.parse(line.decode(), check=True)
        found = [sentences.read(line) for line in self.lines]
        kinds = {"FIN": Answer.of_finger, "RES": Answer.of}
        return [kinds[one.kind](one.fields) for one in found if one.kind in kinds]


@pytest.fixture
def two() -> Fused:
    """A hand with two fingers."""
    return Fused("left", "right")


def scored(p: dict[str, float], sweep: int = 1, **other: Any) -> dict[str, Any]:
    """A verdict with these probabilities, and equal ones for the other labels."""
    rest = (1 - sum(p.values())) / (len(LABELS) - len(p))
    scores = [p.get(name, rest) for name in LABELS]
    label = LABELS[scores.index(max(scores))]
    given = {"scores": scores, "probability": max(scores), **other}
    return feed_lines.verdict(sweep, 1.0, label, **given)


@pytest.mark.parametrize("fingers", [("left", "right"), ("a", "b", "c", "d")])
def test_each_finger_answers_then_the_hand(fingers):
    """FIN in the order of the names, then RES with the product and the hand's number."""
    fused = Fused(*fingers)
    p = {"wood": 0.6, "metal": 0.3}
    for number in (1, 2):
        for name in reversed(fingers):
            assert len(fused.said) == (number - 1) * (len(fingers) + 1)
            fused.take(name, scored(p, 40 + number))
        *own, hand = fused.said[-len(fingers) - 1 :]
        assert [of.finger for of in own] == [*fingers]
        assert {of.sweep for of in (*own, hand)} == {number}
        powers = [p ** len(fingers) for p in (0.6, 0.3, *[0.1 / 4] * 4)]
        assert hand.probability == pytest.approx(powers[0] / math.fsum(powers), abs=6e-4)
        assert hand.margin == pytest.approx((powers[0] - powers[1]) / sum(powers), abs=6e-4)
        assert (hand.label, hand.status, own[0].probability) == ("wood", "ok", 0.6)


def test_bundles_are_compared_by_label_and_id(two):
    """In another order of labels; one id together, which changes with each."""
    turned = [*reversed(LABELS)]
    two.take("right", feed_lines.hello(labels=turned), feed_lines.health(0))
    verdict = scored({"wood": 0.8})
    two.take("left", verdict)
    two.take("right", verdict | {"scores": verdict["scores"][::-1]})
    assert two.said[-1].label == "wood"
    assert two.said[-1].probability > 0.9
    assert common(["aa", "aa"]) == "aa"
    assert common([]) == ""
    assert len({common(ids) for ids in (["aa", "bb"], ["aa", "bc"], ["ab", "bb"])}) == 3


UNKNOWN = {**FAULT, "status": "unknown"}
NO_CONTACT = {**FAULT, "status": "no-contact"}


@pytest.mark.parametrize(
    ("left", "right", "status", "label", "detail"),
    [
        ({}, NO_CONTACT, "ok", "wood", "right no-contact"),
        ({}, UNKNOWN, "unknown", "", "right unknown"),
        (NO_CONTACT, {**FAULT, "status": "gap"}, "gap", "", "left no-contact, right gap"),
        (NO_CONTACT, NO_CONTACT, "no-contact", "", "left no-contact, right no-contact"),
        ({}, {"share": 0.4}, "ok", "wood", "right early"),
        ({"moved": "moved 2 mm"}, {}, "ok", "wood", "left moved 2 mm"),
        ({"degraded": "silent taxel 1.1"}, {}, "ok", "wood", "degraded: left silent taxel 1.1"),
    ],
)
def test_what_becomes_of_a_finger_that_differs(two, left, right, status, label, detail):
    """A finger without probabilities is left out and named; an unknown material is the hand's."""
    for name, other in (("left", left), ("right", right)):
        two.take(name, scored({"wood": 0.8}) | other)
    hand = two.said[-1]
    assert (hand.status, hand.label) == (status, label)
    assert hand.detail == detail.replace(",", " ")  # a comma separates fields
    assert hand.fused == bool(label)


@pytest.mark.parametrize(
    ("p", "status", "wanted"),
    [(0.45, "unsure", "ok"), (0.2, "unsure", "unsure"), (0.2, "undecided", "undecided")],
)
def test_two_fingers_may_be_sure_together(two, p, status, wanted):
    """The least probability is asked of the product; final where a finger takes no more sweeps."""
    for name in ("left", "right"):
        two.take(name, scored({"wood": p}, status=status, fused=3))
    assert (two.said[-1].status, two.said[-1].fused) == (wanted, 3)


def test_other_labels_are_not_fused(two):
    """A material was taught to one finger only: `failed`, with the reason."""
    two.take("right", feed_lines.hello(labels=[*LABELS[1:], "cork"]), feed_lines.health(0))
    two.take("left", scored({"wood": 0.9}))
    two.take("right", scored({"wood": 0.9}))
    assert (two.said[-1].status, two.said[-1].label) == ("failed", "")
    assert "labels" in two.said[-1].detail


def test_a_finger_that_sweeps_is_waited_for(two):
    """The left skin is away: `not-ready` at the start; the right answers seconds later."""
    two.take("right", feed_lines.state(sweeping=True))
    two.take("left", feed_lines.verdict(1, 1.0, status="not-ready"))
    two.wait(20 * GRACE_NS)
    assert two.said == []
    two.take("right", scored({"wood": 0.8}))
    assert [of.status for of in two.said] == ["not-ready", "ok", "ok"]


@pytest.mark.parametrize("how", ["idle", "gone", "next"])
def test_a_finger_without_an_answer_is_not_waited_for(two, how):
    """It heard no edge, its unit has ended, or the other finger answers the next sweep already."""
    if how == "gone":
        two.take("right", feed_lines.state(sweeping=True))
        two.hand.away("right")
    two.take("left", scored({"wood": 0.8}))
    if how == "idle":
        assert two.said == []
        two.wait(GRACE_NS)
    elif how == "next":
        two.take("left", scored({"wood": 0.8}, 2))
    assert [of.finger for of in two.said] == ["left", ""]


def test_state(two):
    """Once a second; sums over the skins, and the fingers that are away or have broken taxels."""
    del two.lines[:]
    two.take("left", feed_lines.state("absent", "no skin"))
    two.take("right", {**feed_lines.health(1, lost_frames=3), "degraded": "silent taxel 2.3"})
    two.take("left", scored({"wood": 0.8}))
    two.take("right", scored({"wood": 0.8}))
    for _ in range(30):
        two.wait(STATE_NS // 10)
    told = [sentences.read(line) for line in two.lines]
    told = [BoxState.of(one.fields) for one in told if one.kind == "STA"]
    assert len(told) == 3
    assert (told[-1].skin, told[-1].sweeping, told[-1].answered) == ("streaming", False, 1)
    assert (told[-1].lost_frames, told[-1].enumerations, told[-1].bundle) == (3, 2, "9f3c2a1b")
    assert told[-1].degraded.split("  ") == ["left absent", "right silent taxel 2.3"]
    two.hand.away("right")
    assert BoxState.of([str(field) for field in two.hand.state()]).skin == "absent"


def test_commands(two):
    """STATE and LABEL are answered here, all others by the units."""

    def asked(text: str) -> list[str]:
        return sentences.read(two.hand.reply(sentences.read(text.encode()))).fields

    assert asked("$PPLP,LABEL,2") == ["LABEL", "ok", "2", LABELS[1], str(len(LABELS))]
    assert asked("$PPLP,LABEL,9")[:2] == ["LABEL", "error"]
    assert asked("$PPLP,STATE")[:2] == ["STATE", "ok"]
    assert asked("$PPLP,TARE")[:2] == ["TARE", "error"]


@pytest.mark.parametrize(
    "given", ["left", "left left", "a b c d e", "left RIGHT", "left toolongname"]
)
def test_which_fingers_is_checked(given):
    """2 to 4 names of units, which fit into a sentence."""
    with pytest.raises(ConfigError):
        command.feeds(given.split())
    assert str(command.feeds(["a", "b=/x"])["a"].path) == "/run/palpate-a/feed.sock"

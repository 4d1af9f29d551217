"""Several fingers as one hand: reads the feed of each finger's unit, and sends FIN for each finger,
then the fused RES, and STA once a second (PROTOCOL.md, part 2)."""

from __future__ import annotations

import math
import select
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

from palpate.client.feed import Feed
from palpate.core import sentences
from palpate.core.clock import Clock
from palpate.core.log import log
from palpate.core.sentences import Sentence, sentence
from palpate.core.status import LEAST_PROBABILITY, Status

GRACE_NS = 250_000_000
"""How long a finger that does not sweep may answer after another; the feed may be 30 ms late."""
STATE_NS = 1_000_000_000
"""Time between two STA."""
STEP_S = 0.05
"""Longest wait for lines of the feeds; commands of the robot wait as long."""
COUNTS = ("frames", "lost_frames", "garbage_bytes", "enumerations")
MORE_COUNTS = ("stale_frames", "overflows", "fifo_overflows", "glitches", "lost_edges", "storms")
FeedLine = Mapping[str, Any]


@dataclass(slots=True)
class Finger:
    """One finger. labels, health: of its feed. answer: to the sweep that the hand has not answered,
    None before. there: whether its unit runs."""

    labels: tuple[str, ...] = ()
    health: dict[str, Any] = field(default_factory=dict)
    answer: FeedLine | None = None
    there: bool = False

    @property
    def state(self) -> str:
        """State of its skin; `absent` without its unit."""
        return str(self.health["skin"]) if self.there and self.health else "absent"

    @property
    def sweeping(self) -> bool:
        """Whether an answer is to come."""
        return self.there and bool(self.health.get("sweeping"))


def listen(feeds: Mapping[str, Feed], hand: FingerFusion) -> None:
    """Take the lines that have come in the feeds, or come within STEP_S, and answer."""
    select.select([feed for feed in feeds.values() if feed.connected], [], [], STEP_S)
    for name, feed in feeds.items():
        trouble = feed.trouble
        while (line := feed.read(0)) is not None:
            try:
                hand.take(name, line)
            except (KeyError, TypeError, ValueError) as e:  # of a later version
                log.warning(f"{name}: a line of its feed is left out ({e}); update this bridge")
        if not feed.connected:
            hand.away(name)
        if feed.trouble != trouble:
            log.warning(f"{name}: {feed.trouble or 'its feed is read'}")
    hand.turn()


class FingerFusion:
    """The answers of several fingers. fingers: their names, in the order of FIN. least: least
    probability for status ok. send: called with each sentence; returns whether it was sent."""

    def __init__(
        self, fingers: Iterable[str], least: float, clock: Clock, send: Callable[[bytes], bool]
    ) -> None:
        self.fingers = {name: Finger() for name in fingers}
        self._least, self._clock, self._send = least, clock, send
        self._answered = self._dropped = 0
        self._last_ns = 0  # when the newest answer of a finger came
        self._state_ns = clock.now_ns()

    def take(self, name: str, line: FeedLine) -> None:
        """A line of a finger's feed. Raises KeyError, TypeError or ValueError if it is invalid."""
        finger = self.fingers[name]
        if line["type"] == "hello":
            finger.labels, finger.health = tuple(line["labels"]), {}
            finger.there = True
        elif line["type"] in ("health", "state"):
            finger.health |= line
        elif line["type"] == "verdict":
            Status(line["status"])
            if finger.answer is not None:  # it begins another sweep, so the others missed this one
                self._answer()
            finger.answer, self._last_ns = line, self._clock.now_ns()

    def away(self, name: str) -> None:
        """The feed of a finger has ended."""
        self.fingers[name].there = False

    def turn(self) -> None:
        """Answer a sweep that every finger has answered, or will not answer any more; send STA."""
        now_ns = self._clock.now_ns()
        missing = [f for f in self.fingers.values() if f.there and f.answer is None]
        late = now_ns >= self._last_ns + GRACE_NS and not any(f.sweeping for f in missing)
        if any(f.answer for f in self.fingers.values()) and (late or not missing):
            self._answer()
        if now_ns >= self._state_ns:
            self._state_ns = now_ns + STATE_NS
            self._say(sentence("STA", *self.state()))

    def state(self) -> list[object]:
        """The fields of STA; counts are sums over the skins."""
        known = [f.health for f in self.fingers.values() if f.health.get("bundle") is not None]
        states = [f.state for f in self.fingers.values()]
        broken = [
            f"{name} {f.state if f.state != 'streaming' else f.health['degraded']}"
            for name, f in self.fingers.items()
            if f.state != "streaming" or f.health.get("degraded")
        ]
        unseen = not all(h["loss_known"] for h in known)
        return [
            f"{self._clock.now_ns() / 1e9:.3f}",
            "streaming" if "streaming" in states else states[0],
            int(any(f.sweeping for f in self.fingers.values())),
            self._answered,
            *(sum(h[name] for h in known) for name in COUNTS),
            self._dropped,
            common(h["bundle"] for h in known),
            self._source(),
            *(sum(h[name] for h in known) for name in MORE_COUNTS),
            *([1 if unseen else "", ", ".join(broken)] if broken else [1] if unseen else []),
        ]

    def reply(self, command: Sentence) -> bytes:
        """The ANS to a command: STATE and LABEL; all others are for the units."""
        labels = self._labels()
        number = "".join(command.fields)
        if command.kind == "STATE":
            return sentence("ANS", "STATE", "ok", *self.state())
        if command.kind != "LABEL":
            why = "the bridge fuses answers; send it to the unit of each finger"
        elif number.isdecimal() and 1 <= int(number) <= len(labels):
            return sentence("ANS", "LABEL", "ok", number, labels[int(number) - 1], len(labels))
        else:
            why = f"label {number} is not there; use 1 to {len(labels)}"
        return sentence("ANS", command.kind, "error", command.error or why)

    def _say(self, line: bytes) -> None:
        self._dropped += not self._send(line)

    def _labels(self) -> tuple[str, ...]:
        return next((f.labels for f in self.fingers.values() if f.labels), ())

    def _source(self) -> str:
        return next((f.health["source"] for f in self.fingers.values() if "source" in f.health), "")

    def _answer(self) -> None:
        """Send FIN for each finger that has answered, then RES."""
        found = {name: f.answer for name, f in self.fingers.items() if f.answer is not None}
        for finger in self.fingers.values():
            finger.answer = None
        self._answered += 1
        labels = {name: self.fingers[name].labels for name in found}
        answer = fused(found, labels, self._least, self._clock.now_ns())
        for name, own in {**found, "": answer}.items():
            seen = all(
                f.health.get("loss_known", True)
                for finger, f in self.fingers.items()
                if name in ("", finger)
            )
            kind, head = "FIN" if name else "RES", [*([name] if name else []), self._answered]
            self._say(sentences.answer(kind, head, own, self._source(), loss_known=seen))


def fused(
    found: Mapping[str, FeedLine], labels: Mapping[str, tuple[str, ...]], least: float, now_ns: int
) -> dict[str, Any]:
    """The answer of the hand, as a verdict of the feed, to the answers of the fingers.

    The probabilities of all fingers that have any are multiplied. A finger without them, or with an
    early answer, is left out; if one is `unknown`, the hand is. labels: of each finger.
    """
    touching = {name: v for name, v in found.items() if v["scores"] and v["share"] == 1}
    status, scores = _judged(found, touching, labels, least)
    label, best = max(scores.items(), key=lambda of: of[1], default=("", 0.0))
    second = max((p for name, p in scores.items() if name != label), default=0.0)
    slid = next((v for v in touching.values() if v.get("measured_mm_s") is not None), {})
    return {
        **slid,
        "time_ns": now_ns,
        "status": status,
        "label": label,
        "probability": best,
        "margin": best - second,
        "fused": max((v["fused"] for v in touching.values()), default=0) if label else 0,
        "lost": sum(v["lost"] for v in found.values()),
        "latency_ns": now_ns - max(v["time_ns"] - v["latency_ns"] for v in found.values()),
        "bundle": common(v["bundle"] for v in found.values()),
        "share": 1.0,
        "detail": "the fingers have other labels"
        if status is Status.FAILED and touching
        else _detail(found, touching),
    }


def _judged(
    found: Mapping[str, FeedLine],
    touching: Mapping[str, FeedLine],
    labels: Mapping[str, tuple[str, ...]],
    least: float,
) -> tuple[Status, dict[str, float]]:
    """Status and probabilities of the hand, {} without. touching: fingers with probabilities."""
    statuses = [Status(v["status"]) for v in found.values()]
    if Status.UNKNOWN in statuses:
        return Status.UNKNOWN, {}
    if not touching:
        faults = (s for s in statuses if s is not Status.NO_CONTACT)
        return next(faults, Status.NO_CONTACT), {}
    order = {*labels[next(iter(touching))]}
    if any({*labels[name]} != order for name in touching):
        return Status.FAILED, {}
    scores = product(
        [dict(zip(labels[name], v["scores"], strict=True)) for name, v in touching.items()]
    )
    if max(scores.values()) >= least:
        return Status.OK, scores
    final = any(v["status"] == Status.UNDECIDED for v in touching.values())
    return Status.UNDECIDED if final else Status.UNSURE, scores


def product(each: list[dict[str, float]]) -> dict[str, float]:
    """The product of probabilities by label, normed; a single one stays as it is."""
    if len(each) == 1:
        return each[0]
    sums = {
        label: sum(math.log(max(p[label], LEAST_PROBABILITY)) for p in each) for label in each[0]
    }
    most = max(sums.values())
    parts = {label: math.exp(s - most) for label, s in sums.items()}
    whole = sum(parts.values())
    return {label: part / whole for label, part in parts.items()}


def common(bundles: Iterable[str]) -> str:
    """The id of the bundle; of different bundles the CRC-32 of their ids."""
    ids = list(dict.fromkeys(bundles))
    return ids[0] if len(ids) == 1 else f"{crc32(' '.join(ids).encode()):08x}" if ids else ""


def _detail(found: Mapping[str, FeedLine], touching: Mapping[str, FeedLine]) -> str:
    """Displacements, fingers that were left out, and bridged taxels of the others."""
    moved = [f"{name} {v['moved']}" for name, v in found.items() if v.get("moved")]
    without = [
        f"{name} {v['status'] if v['share'] == 1 else 'early'}"
        for name, v in found.items()
        if name not in touching
    ]
    bridged = [f"{name} {v['degraded']}" for name, v in touching.items() if v.get("degraded")]
    texts = ", ".join(moved), ", ".join(without), bridged and f"degraded: {', '.join(bridged)}"
    return "; ".join(text for text in texts if text)

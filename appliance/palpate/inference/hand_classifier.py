"""The answer of several fingers to one sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import ConfigError
from palpate.core.observer import Observer
from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict
from palpate.inference.classifier import Classifier, enrolled_labels
from palpate.inference.objects import (
    EnrolledLabels,
    ObjectAnswer,
    ObjectRule,
    ObjectSweeps,
    fuse,
)

if TYPE_CHECKING:
    from palpate.core.clock import Clock

_NONE = np.empty(0)


class HandClassifier(Observer):
    """Answers each finger by itself, then the hand: the product of the fingers' probabilities,
    fused with the other sweeps of the object.

    A finger without probabilities is left out. An exception is an unknown material, which the hand
    then has as well: the label of another finger would be a guess. fingers: the classifier of each,
    which does not fuse sweeps. fusion, rule: of the sweeps of one object, as in Classifier. away:
    names the fingers whose skins do not stream. Raises ConfigError if the bundles have different
    labels.
    """

    def __init__(
        self,
        fingers: Mapping[str, Classifier],
        clock: Clock,
        away: Callable[[], str],
        fusion: str,
        rule: ObjectRule,
    ) -> None:
        self._fingers, self._clock, self._away = fingers, clock, away
        self.labels = next(iter(fingers.values())).bundle.manifest.labels
        self._order = {name: self._places(name) for name in fingers}
        self._objects = ObjectSweeps(self.labels, fusion, rule, self._enrolled())
        ids = dict.fromkeys(c.model for c in fingers.values())
        self._model = next(iter(ids)) if len(ids) == 1 else f"{crc32(' '.join(ids).encode()):08x}"
        self._longest = max(
            (c.format for c in fingers.values()), key=lambda f: f.window / f.rate_hz
        )

    def _places(self, name: str) -> NDArray[np.int64]:
        """Where the finger's probabilities have the labels of the hand, int64 [K]."""
        own = self._fingers[name].bundle.manifest.labels
        if {*own} != {*self.labels}:
            other = sorted({*own} ^ {*self.labels})
            raise ConfigError(
                f"the bundle of skins.{name} has other labels than that of the first finger "
                f"({', '.join(other[:5])}); fingers are fused by label, so train the bundles on "
                "the same materials"
            )
        return np.array([own.index(label) for label in self.labels])

    def _enrolled(self) -> EnrolledLabels:
        """The labels that some finger has enrolled, with the strictest rule."""
        own = [enrolled_labels(c.bundle) for c in self._fingers.values()]
        which = [of.which[places] for of, places in zip(own, self._order.values(), strict=True)]
        return EnrolledLabels(np.any(which, axis=0), max(of.least for of in own))

    @property
    def format(self) -> SweepFormat:
        """The format with the longest window."""
        return self._longest

    @property
    def model(self) -> str:
        """The id of the bundle; of different bundles the CRC-32 of their ids, which changes with
        each of them and is as short as one."""
        return self._model

    @property
    def degraded(self) -> str:
        """Fingers that are away, and broken taxels of the others."""
        broken = [f"{name} {c.degraded}" for name, c in self._fingers.items() if c.degraded]
        return ", ".join(filter(None, [self._away(), *broken]))

    def frames(self, frames: Frames) -> None:
        """Search the frames of the finger for broken taxels."""
        self._fingers[frames.finger].frames(frames)

    def about(self) -> dict[str, Any]:
        """The entries of each finger's classifier, for sidecars."""
        fingers = {name: c.about() for name, c in self._fingers.items()}
        return {"bundle": self.model, "fingers": fingers}

    def describe(self) -> list[object]:
        """Name and version of the first bundle, `model`, and the formats."""
        name, version, *_ = next(iter(self._fingers.values())).describe()
        formats = dict.fromkeys(str(c.format).replace(",", "") for c in self._fingers.values())
        return [name, version, self.model, " and ".join(formats)]

    def test(self) -> str:
        """The self-test of each finger."""
        return " and ".join(f"{name} {c.test()}" for name, c in self._fingers.items())

    def self_test(self) -> None:
        """Run the golden sweeps of each bundle. Raises BundleError."""
        for c in self._fingers.values():
            c.self_test()

    def set_tare(self, taxels: NDArray[Any]) -> str:
        """Take frames [n, counts of all fingers] as the unloaded skins (`HandCutter.latest`)."""
        texts, at = [], 0
        for name, c in self._fingers.items():
            own = taxels[:, at : at + c.format.channels]
            at += c.format.channels
            texts.append(f"{name} {c.set_tare(own.reshape(-1, *c.format.shape))}")
        return " and ".join(texts)

    def __call__(self, sweep: Sweep) -> Verdict:
        """The verdict on a sweep of the hand, with those on each finger."""
        assert sweep.fingers
        found = {own.finger or "": self._fingers[own.finger or ""](own) for own in sweep.fingers}
        scores = [v.own[self._order[name]] for name, v in found.items() if len(v.own)]
        unknown = any(v.status is Status.UNKNOWN for v in found.values())
        if sweep.status is not Status.OK or unknown or not scores:
            status = _reason(found) if sweep.status is Status.OK else sweep.status
            return self._verdict(sweep, found, status)
        own = fuse(scores, "product")
        fused = self._objects.put(sweep, own)
        if fused.refused:
            status = Status.CONFLICT
        elif fused.scores.max() >= self._least(found):
            status = Status.OK
        else:
            status = Status.UNDECIDED if fused.final else Status.UNSURE
        return self._verdict(sweep, found, status, fused, own)

    def _least(self, found: Mapping[str, Verdict]) -> float:
        """Least probability for status ok: the largest of the fingers that have probabilities."""
        return max(
            self._fingers[name].least(displaced=bool(v.displacement))
            for name, v in found.items()
            if len(v.own)
        )

    def _verdict(
        self,
        sweep: Sweep,
        found: Mapping[str, Verdict],
        status: Status,
        fused: ObjectAnswer | None = None,
        own: NDArray[np.float64] = _NONE,
    ) -> Verdict:
        label, best, second = "", 0.0, 0.0
        scores = fused.scores if fused and not fused.refused else _NONE
        if len(scores):
            order = np.argsort(-scores, kind="stable")  # as in Classifier
            label = self.labels[order[0]]
            best, second = scores[order[:2]]
        touching = [v for v in found.values() if len(v.own)]
        slid = next((v for v in touching if v.measured_mm_s is not None), None)
        now = self._clock.now_ns()
        return Verdict(
            sweep=sweep.id,
            time_ns=now,
            status=status,
            label=label,
            probability=float(best),
            margin=float(best - second),
            scores=scores,
            fused=fused.fused if fused else 0,
            lost=sweep.lost,
            latency_ns=now - sweep.complete_ns,
            bundle=self.model,
            detail=_detail(found, fused.conflict if fused else ""),
            share=sweep.share,
            own=own,
            displacement=_moved(found),
            degraded=_degraded(found),
            after=fused.after if fused else 0,
            speed_mm_s=sweep.speed_mm_s,
            force_n=sweep.force_n,
            measured_mm_s=slid.measured_mm_s if slid else None,
            direction=slid.direction if slid else None,
            fingers=tuple(found.values()),
        )


def _reason(found: Mapping[str, Verdict]) -> Status:
    """The status of a sweep without label: `unknown` if a finger has it, else of the first finger
    whose status is not `no-contact`."""
    statuses = [v.status for v in found.values()]
    if Status.UNKNOWN in statuses:
        return Status.UNKNOWN
    return next((s for s in statuses if s is not Status.NO_CONTACT), Status.NO_CONTACT)


def _moved(found: Mapping[str, Verdict]) -> str:
    """The displacements of the fingers' contacts, "" for none."""
    return ", ".join(f"{name} {v.displacement}" for name, v in found.items() if v.displacement)


def _detail(found: Mapping[str, Verdict], conflict: str) -> str:
    """Displacements; the fingers that were left out, with their statuses; bridged taxels of the
    others."""
    without = [f"{name} {v.status}" for name, v in found.items() if not len(v.own)]
    bridged = [f"{name} {v.degraded}" for name, v in found.items() if len(v.own) and v.degraded]
    texts = (
        _moved(found),
        conflict,
        ", ".join(without),
        bridged and f"degraded: {', '.join(bridged)}",
    )
    return "; ".join(text for text in texts if text)


def _degraded(found: Mapping[str, Verdict]) -> str:
    """Fingers with a fault, which were left out, and bridged taxels of the others; "" for none."""
    faults = {
        name: v.degraded if len(v.own) else str(v.status)
        for name, v in found.items()
        if v.status not in (Status.NO_CONTACT, Status.UNKNOWN)
    }
    return ", ".join(f"{name} {fault}" for name, fault in faults.items() if fault)

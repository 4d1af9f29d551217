"""Answers sweeps in recordings without a bundle, by verdicts without a label.

The status is `recorded`, or a fault that the raw counts show: no contact, saturation, stuck and
dead taxels, no slide.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.slide_check import MANY, RESTS, Slid, SlideFinding, SlidesAmong, only_taxel
from palpate.answer.unloaded import UnloadedTracker
from palpate.answer.window import Finding, Window, inspect_bare, inspect_readings
from palpate.core.clock import Clock
from palpate.core.errors import ApplianceError, FormatError
from palpate.core.observer import Observer
from palpate.core.status import Reason, Remark
from palpate.core.types import EPOCH_BITS, Frames, Status, Sweep, SweepFormat, Verdict, normal
from palpate.sweeps.recording import RecordingSession
from palpate.sweeps.sweep_folder import RecordedSweep

MEASURED = "level", "noise"
"""The entry `unloaded` of a sidecar: level and noise of the unloaded skin."""
NO_CONTACT_YET = "contact not checked: the skin was not both touched and let go so far"
UNCHECKED = Finding(Status.RECORDED, Remark(Reason.UNCHECKED, {"what": NO_CONTACT_YET}))
PEERS = 8
"""Most sweeps of each material that are read of earlier runs."""
STILL = Finding(Status.STUCK_TAXEL, Remark(Reason.STILL))


class SweepCheck(Observer):
    """Checks each window against the unloaded skin, which it finds by itself or takes from a TARE.
    slides: judges whether a sweep is a slide; None accepts all. teaching: whether a doubt, or a
    single loaded taxel, refuses a sweep. model: "", since there is no bundle. degraded: "", since
    nothing is bridged."""

    model = degraded = ""

    def __init__(
        self,
        format: SweepFormat,
        clock: Clock,
        slides: Callable[[Sweep], SlideFinding] | None = None,
        *,
        teaching: bool = False,
    ) -> None:
        self.format, self._clock, self._slides = format, clock, slides
        self._teaching = teaching
        self._unloaded = UnloadedTracker(format)
        self._epoch = -1

    def frames(self, frames: Frames) -> None:
        """Search the frames for the unloaded skin."""
        epoch = int(frames.seq[-1]) >> EPOCH_BITS
        if epoch != self._epoch:
            self._epoch = epoch
            self._unloaded.restart()
        self._unloaded.put(frames.taxels)

    def __call__(self, sweep: Sweep) -> Verdict:
        """The verdict on one sweep. A sweep with another status than ok keeps it."""
        finding = Finding(sweep.status)
        if sweep.status is Status.OK:
            finding = self._checked(sweep.frames.taxels)
            if self._slides and not finding.status.faulty:
                finding = self._slid(sweep, finding.detail)
        now_ns = self._clock.now_ns()
        return Verdict.of(sweep, finding.status, now_ns, self.model, detail=finding.detail)

    def rehearse(self) -> None:
        """Nothing: no robot waits for these answers."""

    def _slid(self, sweep: Sweep, unchecked: str) -> Finding:
        """The finding on a sweep without a fault. unchecked: checks left out so far, in words."""
        assert self._slides
        if self._teaching and (alone := self._alone(sweep.frames.taxels)) is not None:
            return Finding(Status.NO_SLIDE, Remark(Reason.NOT_A_SLIDE, {"why": alone}))
        found = self._slides(sweep)
        if found.why is not None and (found.certain or self._teaching):
            return Finding(Status.NO_SLIDE, Remark(Reason.NOT_A_SLIDE, {"why": found.why}))
        what = "; ".join(filter(None, [unchecked, found.why, found.unchecked]))
        return Finding(Status.RECORDED, Remark(Reason.UNCHECKED, {"what": what}) if what else None)

    def _alone(self, taxels: NDArray[Any]) -> str | None:
        """The reason if a single taxel is loaded."""
        bare = self._unloaded.skin
        if not (bare and self._unloaded.certain):
            return None
        load = np.abs(normal(taxels.mean(axis=0, dtype=np.float64) - bare.level, 0))
        return only_taxel(load, bare.contact)

    def _checked(self, taxels: NDArray[Any]) -> Finding:
        if not (self._unloaded.skin and self._unloaded.certain):
            readings = inspect_readings(taxels)
            if readings.status is not Status.OK:
                return readings
            return STILL if len(taxels) > 1 and Window(taxels).still.all() else UNCHECKED
        finding = inspect_bare(taxels, self._unloaded.skin)
        return Finding(Status.RECORDED) if finding.status is Status.OK else finding

    def about(self) -> dict[str, Any]:
        """Entries for sidecars: MEASURED in raw counts, None while it is not certain."""
        found = self._unloaded.skin if self._unloaded.certain else None
        return {"unloaded": found and {name: getattr(found, name).tolist() for name in MEASURED}}

    def describe(self) -> list[object]:
        """The fields of the answer to ID: no bundle, and the format."""
        return ["recording", "", self.model, self.format]

    def test(self) -> str:
        """Raises ApplianceError: there is nothing to test."""
        raise ApplianceError("no bundle is used while palpate record runs; palpate check tests one")

    def set_tare(self, taxels: NDArray[Any]) -> str:
        """Take frames [n, R, C] as the unloaded skin."""
        self._unloaded.set(taxels)
        return f"largest {taxels.mean(axis=0, dtype=np.float64).max():.1f} raw counts"


class SlidesBefore:
    """Judges whether each sweep of a recording is a slide, by the counted sweeps before it. Of
    earlier runs it reads the last PEERS sweeps of each material."""

    def __init__(self, format: SweepFormat, recording: RecordingSession) -> None:
        self._judge, self._recording = SlidesAmong(format), recording
        self._slid: dict[int, Slid] = {}  # by the number of the file
        of: dict[str, list[int]] = {}
        for number, material in sorted(recording.counted().items()):
            of.setdefault(material, []).append(number)
        for number in (n for numbers in of.values() for n in numbers[-PEERS:]):
            with suppress(FormatError):  # damaged: training reports it
                sweep = RecordedSweep.load(recording.sweeps.path(number)).sweep
                self._slid[number] = self._judge.measured(sweep.frames.taxels)

    def __call__(self, sweep: Sweep) -> SlideFinding:
        """The judgement of a sweep that is not counted so far."""
        number, material = self._recording.awaited(sweep)
        counted = self._recording.counted()
        before = {n: self._slid[n] for n in counted if n in self._slid}
        own = {n: slid for n, slid in before.items() if counted[n] == material}
        self._slid[number] = one = self._judge.measured(sweep.frames.taxels)
        if not material:
            return SlideFinding()
        found = self._judge(one, [*own.values(), one], [*before.values(), one])
        if len(own) + 1 == MANY and found == SlideFinding():  # the first sweep that can tell
            group = [*own.values(), one]
            rest = [f"{n}" for n, slid in own.items() if self._judge(slid, group, []).why]
            if rest:
                return SlideFinding(unchecked=f"sweep {', '.join(rest)} of the folder: {RESTS}")
        return found

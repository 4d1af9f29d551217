"""Answers sweeps in recordings without a bundle, by verdicts without a label.

The status is `recorded`, or a fault that the raw counts show: no contact, saturation, stuck and
dead taxels; and while the box is taught, no slide.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.slide_check import only_taxel
from palpate.answer.unloaded import UnloadedTracker
from palpate.answer.window import Window
from palpate.answer.window_check import Finding, inspect_bare, inspect_readings
from palpate.core.clock import Clock
from palpate.core.errors import ApplianceError
from palpate.core.observer import Observer
from palpate.core.status import Reason, Remark
from palpate.core.types import EPOCH_BITS, Frames, Status, Sweep, SweepFormat, Verdict, normal

MEASURED = "level", "noise"
"""The entry `unloaded` of a sidecar: level and noise of the unloaded skin."""
UNCHECKED = Finding(Status.RECORDED, Remark(Reason.UNCHECKED))
STILL = Finding(Status.STUCK_TAXEL, Remark(Reason.STILL))


class SweepCheck(Observer):
    """Checks each window against the unloaded skin, which it finds by itself or takes from a TARE.
    slides: the reason why a window is not a slide, None if it is one; None accepts all. model: "",
    since there is no bundle. degraded: "", since nothing is bridged."""

    model = degraded = ""

    def __init__(
        self,
        format: SweepFormat,
        clock: Clock,
        slides: Callable[[NDArray[Any]], str | None] | None = None,
    ) -> None:
        self.format, self._clock, self._slides = format, clock, slides
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
                finding = self._slid(sweep.frames.taxels) or finding
        now_ns = self._clock.now_ns()
        return Verdict.of(sweep, finding.status, now_ns, self.model, detail=finding.detail)

    def _slid(self, taxels: NDArray[Any]) -> Finding | None:
        """Why a window is not a slide, None if it is one."""
        assert self._slides
        why, bare = None, self._unloaded.skin
        if bare and self._unloaded.certain:
            load = np.abs(normal(taxels.mean(axis=0, dtype=np.float64) - bare.level, 0))
            why = only_taxel(load, bare.contact)
        why = self._slides(taxels) if why is None else why
        if why is None:
            return None
        return Finding(Status.NO_SLIDE, Remark(Reason.NOT_A_SLIDE, {"why": why}))

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

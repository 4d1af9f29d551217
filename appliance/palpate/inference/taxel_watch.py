"""Watches the taxels over the stream, and bridges broken taxels in the window of a sweep.

A taxel that was broken in several stretches of the stream is bridged in every sweep, until it has
been sound for a while. A taxel that is broken in a window is bridged there at once. Beyond the
number that the bundle tolerates, silent taxels make the window faulty.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.manifest import Manifest
from palpate.core.types import EPOCH_BITS, Frames, Status, normal
from palpate.signal.broken_taxels import BrokenTaxels, Comparison, bridged, find, places
from palpate.signal.taxel_statistics import TRIPLES, TaxelStatistics
from palpate.signal.window_check import Finding, WindowLimits, ceiling, inspect

STRETCH = 3 * TRIPLES
"""Frames of a stretch of the stream, if a window has as many: its noise is then measured as
precisely as that of a window."""
CERTAIN = 5
"""A taxel is broken over the stream after this many more broken than sound stretches."""
SOUND = 150
"""A taxel is sound again after this many sound stretches in a row."""


class TaxelWatch:
    """Finds the broken taxels of a skin by the limits of a bundle; none if the bundle has no
    `bridging`.

    broken: over the stream; None if there are none.
    """

    def __init__(self, manifest: Manifest) -> None:
        self._manifest = manifest
        self._size = min(manifest.format.window, STRETCH)
        self._restart()

    def _restart(self) -> None:
        """Forget everything: this may be another skin."""
        format = self._manifest.format
        self._epoch = -1
        self._waiting: list[NDArray[Any]] = []
        self._frames = 0
        # [2, R, C] each: silent, noisy
        self._against = np.zeros((2, format.rows, format.cols), np.int64)
        self._sound = np.zeros_like(self._against)
        self.broken: BrokenTaxels | None = None

    def put(self, frames: Frames, tare: NDArray[np.float64]) -> None:
        """Add frames of the stream, at least one. tare: raw counts [R, C] or [R, C, A]."""
        if self._manifest.bridging is None:
            return
        epoch = int(frames.seq[-1]) >> EPOCH_BITS
        if epoch != self._epoch:
            self._restart()
            self._epoch = epoch
        self._waiting.append(frames.taxels)
        self._frames += len(frames)
        if self._frames >= self._size:
            self._judge(np.concatenate(self._waiting), tare)
            self._waiting, self._frames = [], 0

    def _judge(self, taxels: NDArray[Any], tare: NDArray[np.float64]) -> None:
        """Count one stretch [n, R, C] or [n, R, C, A] for or against each taxel. While its
        neighbours are still, a taxel counts neither as silent nor as sound."""
        m, measured = self._manifest, TaxelStatistics.of(taxels)
        assert m.bridging
        compared = Comparison.of(measured, m.format.shape[:2])
        found = find(measured, compared, tare, self._clipping(measured), m.bridging)
        bad = found.kinds if found else np.zeros(self._sound.shape, bool)
        lively = compared.lively(m.bridging.quietest).any(axis=1).reshape(bad.shape[1:])
        good = ~bad & np.stack([lively, np.ones_like(lively)])
        self._against = np.clip(self._against + bad - good.astype(np.int64), 0, CERTAIN)
        self._sound = np.where(bad, 0, self._sound + good)
        was = self.broken.kinds if self.broken else np.zeros_like(bad)
        now = (was & (self._sound < SOUND)) | (self._against == CERTAIN)
        self.broken = BrokenTaxels.of(now)

    def repaired(
        self, taxels: NDArray[Any], tare: NDArray[np.float64]
    ) -> tuple[NDArray[Any], Finding]:
        """Raw counts [T, R, C] or [T, R, C, A] of a window with its broken taxels bridged, and the
        result of its check. tare: raw counts [R, C] or [R, C, A]."""
        m, measured = self._manifest, TaxelStatistics.of(taxels)
        limits: WindowLimits = m.thresholds
        broken = self._in_window(measured, tare, limits)
        if self._beyond(broken):
            limits = self._clipping(measured)
            broken = self._in_window(measured, tare, limits)
        if broken and self._beyond(broken):
            broken = BrokenTaxels.of(broken.kinds & [[[True]], [[False]]])  # silent alone
        if not (broken and m.bridging):
            return taxels, inspect(taxels, tare, limits, measured=measured)
        if self._beyond(broken):
            return taxels, self._too_many(broken, measured, tare)
        taxels = bridged(taxels, broken.mask, m.tare, m.bridging.loads)
        return taxels, replace(inspect(taxels, tare, limits), degraded=broken.text)

    def _beyond(self, broken: BrokenTaxels | None) -> bool:
        """Whether more taxels are broken than the bundle tolerates."""
        rule = self._manifest.bridging
        return bool(broken and rule and not rule.allows(broken.mask))

    def _clipping(self, measured: TaxelStatistics) -> WindowLimits:
        """The limits, with the count at which the amplifier clips as full scale: taxels that stay
        there are saturated, not stuck."""
        limits = self._manifest.thresholds
        return replace(limits, full_scale=ceiling(measured, limits.full_scale))

    def _in_window(
        self, measured: TaxelStatistics, tare: NDArray[np.float64], limits: WindowLimits
    ) -> BrokenTaxels | None:
        """The broken taxels of a window and of the stream."""
        m = self._manifest
        if m.bridging is None:
            return None
        compared = Comparison.of(measured, m.format.shape[:2])
        found = find(measured, compared, tare, limits, m.bridging)
        return found | self.broken if found and self.broken else found or self.broken

    def _too_many(
        self, broken: BrokenTaxels, measured: TaxelStatistics, tare: NDArray[np.float64]
    ) -> Finding:
        """The finding for silent taxels beyond the number that the bundle tolerates."""
        load = normal(measured.mean.reshape(tare.shape) - tare, 0)
        contact = self._manifest.thresholds.contact
        stuck = contact is None or (load[broken.silent] >= contact).any()
        status = Status.STUCK_TAXEL if stuck else Status.DEAD_TAXEL
        return Finding(status, places(broken.silent))

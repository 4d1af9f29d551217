"""Broken taxels: finds silent and noisy ones, and bridges them by their neighbours.

A silent taxel does not change although its neighbours do, or gives no number: it is dead or stuck.
A noisy taxel is far noisier than its neighbours. A few modes, such as more force or a contact
further along, describe the loads of all taxels in training, so that sound taxels tell the load of a
broken one: probabilistic principal components (Tipping and Bishop, Journal of the Royal Statistical
Society B, 1999). All limits were learned from the training sweeps of the bundle
(train/palpate_train/answer/fit_taxels).

Without taxels: 625 instead of 747 of 816 altered slides right, 177 instead of 177 of 192 displaced
ones, 52 instead of 52 of 480 junk windows named; 33 us less of 646 (`python -m palpate_studies
rules`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, Refusal
from palpate.answer.window import (
    TRIPLES,
    Counts,
    Finding,
    Window,
    WindowLimits,
    ceiling,
    enclosed,
    inspect,
)
from palpate.core.errors import BundleError
from palpate.core.schema import LEAST, MOST, Positive, Within, check
from palpate.core.status import Reason, Remark
from palpate.core.types import EPOCH_BITS, Frames, Status, SweepFormat, digitized, normal

REACH = 2
"""A taxel is compared with the taxels up to this many rows and columns away."""
LIVELY = 0.5
"""Neighbours with at least this share of the noise of the quietest training sweep show that the
finger slides."""
LEAST_FRAMES = 75
"""Fewer frames do not show whether a taxel is noisy: their noise depends too much on chance."""
STRETCH = 3 * TRIPLES
"""Frames of a stretch of the stream, if a window has as many: its noise is then measured as
precisely as that of a window."""
CERTAIN = 5
"""A taxel is broken over the stream after this many more broken than sound stretches."""
SOUND = 150
"""A taxel is sound again after this many sound stretches in a row."""

Mask = NDArray[np.bool_]
_MOST = MOST**0.25  # products of four stay finite
_Row = tuple[Annotated[float, Within(-_MOST, _MOST)], ...]


@dataclass(frozen=True, slots=True)
class LoadModes:
    """Loads are mean + amounts @ modes + noise.

    mean: raw counts of each value of a frame, [V]. modes: [M, V], for amounts with variance 1.
    rest: variance of the noise. Raises BundleError for a value out of range.
    """

    mean: _Row
    modes: Annotated[tuple[_Row, ...], Within(1, 8)]
    rest: Annotated[float, Within(LEAST, _MOST**2)]

    def __post_init__(self) -> None:
        check(self, "bridging.loads")
        if {len(mode) for mode in self.modes} != {len(self.mean)}:
            raise BundleError(
                "bridging.loads: each mode must have as many values as the mean; "
                "export the bundle again"
            )

    def expected(self, frames: NDArray[Any], broken: NDArray[np.bool_]) -> NDArray[np.float32]:
        """The most probable broken values [T, B], given the sound ones of frames [T, V].

        broken: mask [V].
        """
        weights, offset = _load_weights(self, broken.tobytes())
        told: NDArray[np.float32] = frames[:, ~broken].astype(np.float32) @ weights + offset
        return told


@lru_cache(maxsize=4)
def _load_weights(loads: LoadModes, mask: bytes) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weights [S, B] and offset [B] that give broken values as a sum of sound ones."""
    broken = np.frombuffer(mask, bool)
    mean, modes = np.array(loads.mean), np.array(loads.modes)
    sound = modes[:, ~broken]
    amounts = np.linalg.solve(sound @ sound.T + loads.rest * np.eye(len(modes)), sound)  # [M, S]
    weights = amounts.T @ modes[:, broken]
    offset = mean[broken] - mean[~broken] @ weights
    return weights.astype(np.float32), offset.astype(np.float32)


@dataclass(frozen=True, slots=True)
class Bridging:
    """Broken taxels that a model tolerates if they are bridged. Raises BundleError for a value out
    of range.

    taxels: largest number of broken taxels at any places. row, column: whether all broken taxels
    may also lie in one row, or in one column. noise: a taxel is noisy from this many times the
    noise of its neighbours. quietest: noise in counts of the quietest neighbours in training.
    still: whether sound taxels were constant in training. loads: tell the load of a broken taxel;
    without them its direct neighbours do.
    """

    taxels: Annotated[int, Within(0, 1000)]
    row: bool
    column: bool
    noise: Positive
    quietest: Positive
    still: bool
    loads: LoadModes | None = None

    def __post_init__(self) -> None:
        check(self, "bridging")

    def allows(self, broken: Mask) -> bool:
        """Whether the taxels of the mask `broken` [R, C] may be bridged together."""
        rows, columns = broken.any(axis=1).sum(), broken.any(axis=0).sum()
        return bool(
            broken.sum() <= self.taxels
            or (self.row and rows == 1 < len(broken))
            or (self.column and columns == 1 < broken.shape[1])
        )

    @property
    def text(self) -> str:
        """The broken taxels that may be bridged, in words."""
        lines = " or ".join(["one row"] * self.row + ["one column"] * self.column)
        many = "one broken taxel" if self.taxels == 1 else f"up to {self.taxels} broken taxels"
        taxels = many if self.taxels else ""
        return " or ".join(filter(None, (taxels, lines))) or "no broken taxel"


@dataclass(frozen=True, slots=True)
class BrokenTaxels:
    """The broken taxels of a skin, at least one. silent, noisy: masks [R, C]."""

    silent: Mask
    noisy: Mask

    @classmethod
    def of(cls, kinds: Mask) -> BrokenTaxels | None:
        """From the two masks as one, bool [2, R, C]; None if there is no broken taxel."""
        return cls(*kinds) if kinds.any() else None

    @classmethod
    def read(cls, kinds: Any, format: SweepFormat) -> BrokenTaxels | None:
        """From the lists of a sidecar, [2, R, C]; None if they are None or name no taxel. Raises
        ValueError for another shape."""
        if kinds is None:
            return None
        masks = np.asarray(kinds, bool)
        if masks.shape != (2, format.rows, format.cols):
            raise ValueError(f"broken taxels of shape {masks.shape} do not fit {format}")
        return cls.of(masks)

    def __or__(self, other: BrokenTaxels) -> BrokenTaxels:
        return BrokenTaxels(self.silent | other.silent, self.noisy | other.noisy)

    @property
    def kinds(self) -> Mask:
        """The two masks as one, bool [2, R, C]."""
        return np.stack([self.silent, self.noisy])

    @property
    def mask(self) -> Mask:
        """All broken taxels, bool [R, C]."""
        return self.silent | self.noisy

    @property
    def text(self) -> str:
        """Kinds and places, for example "silent taxel 2.3 and noisy row 4"."""
        kinds = {"silent": self.silent, "noisy": self.noisy & ~self.silent}
        return " and ".join(f"{kind} {places(mask)}" for kind, mask in kinds.items() if mask.any())


def places(mask: Mask) -> str:
    """The taxels of a mask [R, C] by name: "taxel 1.2 2.3", "row 2", "column 3"."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 1 and 1 < len(columns) == mask.shape[1]:
        return f"row {rows[0] + 1}"
    if len(columns) == 1 and 1 < len(rows) == len(mask):
        return f"column {columns[0] + 1}"
    return "taxel " + " ".join(f"{r + 1}.{c + 1}" for r, c in np.argwhere(mask))


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A stretch of the signal, each value of a frame with the values of its neighbours on the same
    axis.

    noise, still: of the value, [R * C, A], see Window. around: median noise of the
    neighbours that are not still, [R * C, A]; infinite if there are none. Of an even number the
    lower median counts, so that half of the neighbours may be noisy.
    """

    noise: NDArray[np.float32]
    still: Mask
    around: NDArray[np.float32]

    @classmethod
    def of(cls, measured: Window, grid: tuple[int, ...]) -> Comparison:
        """Compare the values of `measured`. grid: R, C."""
        noise = measured.noise.reshape(grid[0] * grid[1], -1)
        still = measured.still.reshape(noise.shape)
        beyond = np.full((1, noise.shape[1]), np.inf, np.float32)
        around = np.concatenate([np.where(still, np.inf, noise), beyond])[_neighbours(*grid)]
        around.sort(axis=1)  # [R * C, K, A]
        middles = np.maximum(np.isfinite(around).sum(axis=1, keepdims=True) - 1, 0) // 2
        return cls(noise, still, np.take_along_axis(around, middles, axis=1)[:, 0])

    def lively(self, quietest: float) -> Mask:
        """Whether the neighbours show that the finger slides, bool [R * C, A]. quietest: see
        Bridging."""
        return np.isfinite(self.around) & (self.around >= LIVELY * quietest)


def surely_sound(measured: Window, bridging: Bridging) -> bool:
    """Whether all values change, and none is far noisier than the quietest: then `find` finds none,
    which takes longer."""
    quiet, loud = measured.quietest, np.maximum.reduce(measured.noise)
    sound = quiet > 0 and loud <= bridging.noise * max(quiet, bridging.quietest)
    return measured.readable and bool(sound)


def find(
    measured: Window,
    compared: Comparison,
    tare: NDArray[np.float64],
    limits: WindowLimits,
    bridging: Bridging,
) -> BrokenTaxels | None:
    """The broken taxels of a stretch of the signal; None if there are none.

    compared: the same stretch. tare: raw counts [R, C] or [R, C, A] of the unloaded skin. A taxel
    is broken if one of its axes is. If sound taxels were constant in training, a constant taxel is
    silent only if it is loaded, or if its direct neighbours are. A taxel at full scale is
    saturated, not silent, if a direct neighbour reaches full scale, too.
    """
    noisy = compared.noise > bridging.noise * np.maximum(compared.around, bridging.quietest)
    dark = measured.unreadable
    if not (noisy.any() or compared.still.any() or dark.any()):
        return None
    grid = tare.shape[:2]
    silent = compared.still & compared.lively(bridging.quietest)
    if bridging.still:
        load = measured.mean.reshape(silent.shape)[:, -1:] - normal(tare, 0).reshape(-1, 1)
        loaded = load >= (-np.inf if limits.contact is None else limits.contact)
        silent &= loaded | enclosed(loaded.reshape(grid)).reshape(-1, 1)
    top = (measured.highest >= limits.full_scale).reshape(silent.shape)
    taxels_at_top: Mask = np.logical_or.reduce(top, axis=1).reshape(grid)
    silent &= ~top | enclosed(~taxels_at_top).reshape(-1, 1)
    silent |= dark.reshape(silent.shape)
    noisy &= ~silent & (len(measured) >= LEAST_FRAMES)
    kinds = np.stack([silent, noisy]).any(axis=2)
    return BrokenTaxels.of(kinds.reshape(2, *grid))


@lru_cache(maxsize=4)
def _neighbours(rows: int, cols: int) -> NDArray[np.int64]:
    """Numbers of the taxels around each taxel, [R * C, K], and R * C for places beyond the edge."""
    r, c = np.divmod(np.arange(rows * cols), cols)
    steps = range(-REACH, REACH + 1)
    around = [(r + i, c + j) for i in steps for j in steps if i or j]
    there = np.stack([(i >= 0) & (i < rows) & (j >= 0) & (j < cols) for i, j in around], axis=1)
    return np.where(there, np.stack([i * cols + j for i, j in around], axis=1), rows * cols)


def bridged(
    taxels: NDArray[Any],
    broken: Mask,
    unloaded: NDArray[np.float64],
    loads: LoadModes | None = None,
) -> NDArray[Any]:
    """A copy of raw counts [T, R, C] or [T, R, C, A] with the taxels of the mask `broken` [R, C]
    replaced: each by what `loads` tell of it, or else by the mean load of its direct neighbours.

    unloaded: [R, C] or [R, C, A] raw counts of the unloaded skin in training, since taxels without
    load differ. At least one taxel must not be broken.
    """
    filled = taxels.copy()
    flat = filled.reshape(len(taxels), broken.size, -1)  # [T, R * C, A]
    if loads:
        values = np.repeat(broken.ravel(), flat.shape[2])
        frames = flat.reshape(len(taxels), -1)
        frames[:, values] = digitized(loads.expected(frames, values), taxels.dtype)
        return filled
    base = unloaded.reshape(broken.size, -1)
    targets, sources, weights = _weights(*broken.shape, broken.tobytes())
    offset = (base[targets] - weights @ base[sources]).astype(np.float32)
    part = flat[:, sources].astype(np.float32)
    # [T, A, targets] of [T, sources, A]
    new = np.tensordot(part, weights.astype(np.float32), axes=(1, 1)).swapaxes(1, 2) + offset
    flat[:, targets] = digitized(new, taxels.dtype)
    return filled


@lru_cache(maxsize=4)
def _weights(
    rows: int, cols: int, mask: bytes
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Broken taxels [B], the sound taxels [S] next to them, and weights [B, S] that give each
    broken taxel the mean of its direct neighbours, which may be broken, too."""
    broken = np.frombuffer(mask, bool)
    r, c = np.divmod(np.arange(rows * cols), cols)
    beside = np.abs(r[:, None] - r) + np.abs(c[:, None] - c) == 1
    targets = np.flatnonzero(broken)
    sources = np.flatnonzero(~broken & beside[targets].any(axis=0))
    between = np.diag(beside[targets].sum(axis=1)) - beside[np.ix_(targets, targets)]
    weights = np.linalg.solve(between, beside[np.ix_(targets, sources)].astype(np.float64))
    return targets, sources, weights


class TaxelWatch:
    """Watches the taxels over the stream, checks the window of a sweep and bridges broken taxels.

    A taxel that was broken in several stretches of the stream is bridged in every sweep, until it
    has been sound for a while. A taxel that is broken in a window is bridged there at once. Beyond
    the number that `bridging` tolerates, silent taxels make the window faulty; without it none is
    bridged. unloaded: as in `bridged`. broken: over the stream; None if there are none.
    """

    def __init__(
        self,
        format: SweepFormat,
        limits: WindowLimits,
        bridging: Bridging | None,
        unloaded: NDArray[np.float64],
    ) -> None:
        self._format, self._limits, self._bridging = format, limits, bridging
        self._unloaded = unloaded
        self._size = min(format.window, STRETCH)
        self._restart()

    def _restart(self) -> None:
        """Forget everything: this may be another skin."""
        self._epoch = -1
        self._waiting: list[NDArray[Any]] = []
        self._frames = 0
        # [2, R, C] each: silent, noisy
        self._against = np.zeros((2, self._format.rows, self._format.cols), np.int64)
        self._sound = np.zeros_like(self._against)
        self.broken: BrokenTaxels | None = None

    def put(self, frames: Frames, tare: NDArray[np.float64]) -> None:
        """Add frames of the stream, at least one. tare: raw counts [R, C] or [R, C, A]."""
        if self._bridging is None:
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
        measured, rule = Window(taxels), self._bridging
        assert rule
        compared = Comparison.of(measured, self._format.shape[:2])
        found = find(measured, compared, tare, self._clipping(measured), rule)
        bad = found.kinds if found else np.zeros(self._sound.shape, bool)
        lively = compared.lively(rule.quietest).any(axis=1).reshape(bad.shape[1:])
        good = ~bad & np.stack([lively, np.ones_like(lively)])
        self._against = np.clip(self._against + bad - good.astype(np.int64), 0, CERTAIN)
        self._sound = np.where(bad, 0, self._sound + good)
        was = self.broken.kinds if self.broken else np.zeros_like(bad)
        now = (was & (self._sound < SOUND)) | (self._against == CERTAIN)
        self.broken = BrokenTaxels.of(now)

    def apply(self, context: Context) -> Refusal | None:
        """Bridge broken taxels of the window, and refuse a faulty window."""
        context.taxels, finding = self.repaired(context.window, context.tare)
        context.degraded, context.mean, context.full = finding.degraded, finding.mean, finding.full
        if finding.status is not Status.OK:
            return Refusal(finding.status, finding.remark)
        return None

    def repaired(self, taxels: Counts, tare: NDArray[np.float64]) -> tuple[NDArray[Any], Finding]:
        """Raw counts [T, R, C] or [T, R, C, A] of a window with its broken taxels bridged, and the
        result of its check. tare: raw counts [R, C] or [R, C, A]."""
        window, limits = Window.of(taxels), self._limits
        broken = self._in_window(window, tare, limits)
        if self._beyond(broken):
            limits = self._clipping(window)
            broken = self._in_window(window, tare, limits)
        if broken and self._beyond(broken):
            broken = BrokenTaxels.of(broken.kinds & [[[True]], [[False]]])  # silent alone
        if not (broken and self._bridging):
            return window.taxels, inspect(window, tare, limits)
        if self._beyond(broken):
            return window.taxels, self._too_many(broken, window, tare)
        filled = bridged(window.taxels, broken.mask, self._unloaded, self._bridging.loads)
        return filled, replace(inspect(filled, tare, limits), degraded=broken.text)

    def _beyond(self, broken: BrokenTaxels | None) -> bool:
        """Whether more taxels are broken than the bundle tolerates."""
        return bool(broken and self._bridging and not self._bridging.allows(broken.mask))

    def _clipping(self, measured: Window) -> WindowLimits:
        """The limits, with the count at which the amplifier clips as full scale: taxels that stay
        there are saturated, not stuck."""
        return replace(self._limits, full_scale=ceiling(measured, self._limits.full_scale))

    def _in_window(
        self, measured: Window, tare: NDArray[np.float64], limits: WindowLimits
    ) -> BrokenTaxels | None:
        """The broken taxels of a window and of the stream."""
        if self._bridging is None:
            return None
        if surely_sound(measured, self._bridging):
            return self.broken
        compared = Comparison.of(measured, self._format.shape[:2])
        found = find(measured, compared, tare, limits, self._bridging)
        return found | self.broken if found and self.broken else found or self.broken

    def _too_many(
        self, broken: BrokenTaxels, measured: Window, tare: NDArray[np.float64]
    ) -> Finding:
        """The finding for silent taxels beyond the number that the bundle tolerates."""
        load = normal(measured.mean.reshape(tare.shape) - tare, 0)
        contact = self._limits.contact
        stuck = contact is None or (load[broken.silent] >= contact).any()
        status = Status.STUCK_TAXEL if stuck else Status.DEAD_TAXEL
        return Finding(status, Remark(Reason.TAXELS, {"taxels": places(broken.silent)}))

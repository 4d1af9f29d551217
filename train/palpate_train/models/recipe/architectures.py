"""The architecture of a trunk: its trained stages, and the other features.

Stages are dense strided convolutions over time with the taxels as input channels; a feature is the
logarithm of a channel's mean response.
"""

from __future__ import annotations

from dataclasses import dataclass

from palpate.answer import hum
from palpate.answer.slide import PARTS
from palpate.core.errors import FormatError

LEAST_WINDOW = 16
"""Frames of the shortest window of a trunk."""
PREFIXES = PARTS
"""Number of prefixes of a window, after each of which the box may answer early: the first tenth,
the first two tenths, and so on to the whole window."""
FLOOR = 0.02
"""Added to a mean response before its logarithm, so that a silent channel stays finite."""
MIN_LAST_STEPS = 24
"""Least number of time steps of the last stage: a mean over fewer is mostly noise."""
LATER = (5, 2)
"""Kernel and stride of the stages after the first."""
SHORT_KERNEL = 4
"""The first kernel for a window that does not allow any stride."""
MAINS_HZ = hum.MAINS_HZ[0]
"""Frequency that is filtered out by default. A kernel of 32 frames at 750 Hz then removes 50 Hz
completely, but passes three quarters of 60 Hz."""


@dataclass(frozen=True)
class FilterStage:
    """One convolution. steps: number of its responses. reach: number of frames that a response
    sees.

    Response j sees the frames from j * hop to j * hop + reach.
    """

    kernel: int
    stride: int
    steps: int
    reach: int
    hop: int

    def known_steps(self, window: int, prefixes: bool) -> list[int]:
        """Number of responses that are known by the end of each prefix, or of the window."""
        if not prefixes:
            return [self.steps]
        ends = [window * (d + 1) // PREFIXES for d in range(PREFIXES)]
        return [max((end - self.reach) // self.hop + 1, 0) for end in ends]


def each_frame(window: int) -> FilterStage:
    """The frames themselves, as if they were responses."""
    return FilterStage(1, 1, window, 1, 1)


@dataclass(frozen=True)
class Architecture:
    """The parts of a trunk. channels: of each stage, if there are any; kernel and stride: of the
    first stage for long windows.

    planned: number of stages for which a trunk without stages prepares counts. spectrum: whether
    the head sees the bands of spectrum.py after all other features. pools: the features of
    the filter bank that it sees, some of bank.POOLS. distribution: whether it sees the shares of
    distribution.py. loads: whether it sees the loads of loads.py. relations: number of scales of
    relations.py that it sees. slow: whether it sees the waves of slow.py. mains_hz: frequency of
    the mains, to whose hum stages and spectrum do not respond.
    """

    channels: tuple[int, ...]
    kernel: int = 32
    stride: int = 4
    planned: int = 0
    spectrum: bool = False
    pools: tuple[str, ...] = ()
    distribution: bool = False
    loads: bool = False
    relations: int = 0
    slow: bool = False
    mains_hz: float = MAINS_HZ

    def stages(self, window: int) -> tuple[FilterStage, ...]:
        """The stages for a window of this many frames.

        Kernel and stride of the first stage are halved as long as the last stage has fewer steps
        than MIN_LAST_STEPS; if that leaves no stride, the kernel is SHORT_KERNEL. Raises
        FormatError if the window is too short for any.
        """
        return self._planned_stages(window)[: len(self.channels)]

    def _planned_stages(self, window: int) -> tuple[FilterStage, ...]:
        kernel, stride = self.kernel, self.stride
        while (plan := self._plan(window, kernel, stride))[
            -1
        ].steps < MIN_LAST_STEPS and stride > 1:
            stride //= 2
            kernel = kernel // 2 if stride > 1 else SHORT_KERNEL
        if plan[-1].steps < 1:
            raise FormatError(
                f"a window of {window} frames is too short for the network; record at least "
                f"{LEAST_WINDOW}"
            )
        return plan

    def _plan(self, window: int, kernel: int, stride: int) -> tuple[FilterStage, ...]:
        plan, steps, reach, hop = [], window, 1, 1
        for k, s in ((kernel, stride), *(LATER,) * (max(self.planned, len(self.channels)) - 1)):
            steps, reach, hop = (steps - k) // s + 1, reach + (k - 1) * hop, hop * s
            plan.append(FilterStage(k, s, steps, reach, hop))
        return tuple(plan)

    def zero_sum(self, window: int) -> bool:
        """Whether the first stage's kernels sum to zero over time for every taxel, so that no
        offset or slow drift matters.

        They do if the window is long enough for a stride. The texture of a slow sensor lies in just
        these low frequencies; then the mean of each taxel over the window is subtracted instead.
        """
        return self._planned_stages(window)[0].stride > 1


STAGES = Architecture((40, 48, 64))
"""The trained stages of the recipe: about 50,000 weights for 1500 x 4 x 4 raw counts."""


@dataclass(frozen=True)
class NoiseLimit:
    """Attenuation of a taxel that is much noisier than others: a broken taxel must not drown the
    rest.

    The noise of a taxel is its mean difference between neighbouring frames, over `pairs` pairs at
    most. The reference is the taxel at rank a quarter of all, the noisiest first (the fifth of 16,
    the noisiest of three). A taxel with more than `times` the noise of the reference is scaled down
    to that. The rank is a quarter rather than a half because most taxels are silent if a finger
    touches only a few. Nothing is attenuated if the reference is silent.
    """

    times: float = 3.0
    pairs: int = 150

    def step(self, window: int) -> int:
        """Number of frames from one pair to the next."""
        return max(window // self.pairs, 1)

    def rank(self, taxels: int) -> int:
        """The rank of the reference taxel; the noisiest has 0."""
        return taxels // 4


NOISE_LIMIT = NoiseLimit()

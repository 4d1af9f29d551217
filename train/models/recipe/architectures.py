"""The architectures of the compact network. In: a size. Out: an Architecture, with its stages and
its cost.

All sizes are alike: dense strided convolutions over time with the taxels as input channels; the
head sees the logarithm of every stage's mean responses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat

PREFIXES = 10
"""Number of prefixes of a window, after each of which the box may answer early: the first tenth,
the first two tenths, and so on to the whole window."""
FLOOR = 0.02
"""Added to a mean response before its logarithm, so that a silent channel stays finite."""
MIN_LAST_STEPS = 24
"""Time steps that the last stage should have: a mean over fewer is mostly noise."""
LATER = (5, 2)
"""Kernel and stride of the stages after the first."""
SHORT_KERNEL = 4
"""The first kernel for a window that does not allow any stride."""
MAINS_HZ = 50.0
"""Frequency that is filtered out unless a fit is asked for another. Of 50 Hz nothing passes then,
but of 60 Hz three quarters pass a kernel of 32 frames at 750 Hz."""


@dataclass(frozen=True)
class Stage:
    """One convolution. steps: how many responses it gives; reach: frames of the window that one of
    them sees.

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


def each_frame(window: int) -> Stage:
    """The frames themselves, as if they were responses."""
    return Stage(1, 1, window, 1, 1)


@dataclass(frozen=True)
class Cost:
    """What a network costs: trained numbers, and multiply-accumulates of one sweep (convolutions
    and head)."""

    weights: int
    macs: int


@dataclass(frozen=True)
class Architecture:
    """The layers of one size. channels: of each stage; kernel and stride: of the first stage for
    long windows.

    planned: how many stages there were before some were cut off, 0 if none were; with none left the
    head sees only the spectrum. spectrum: whether the head sees the bands of spectrum.py after the
    stages' responses. fewest: number of stages that are never cut off. pools: how the filter bank
    of bank.py is pooled: 0 where there is none, 1 by magnitudes, 2 by shares as well. distribution:
    whether the head sees the shares of distribution.py. mains_hz: of the mains whose hum stages and
    spectrum do not respond to.
    """

    channels: tuple[int, ...]
    kernel: int = 32
    stride: int = 4
    planned: int = 0
    spectrum: bool = False
    fewest: int = 1
    pools: int = 0
    distribution: bool = False
    mains_hz: float = MAINS_HZ

    def cut(self, depth: int, spectrum: bool = False) -> Architecture:
        """The first `depth` stages, each as it was, with the spectrum or without."""
        planned = max(self.planned, len(self.channels))
        return replace(self, channels=self.channels[:depth], planned=planned, spectrum=spectrum)

    def stages(self, window: int) -> tuple[Stage, ...]:
        """The stages for a window of so many frames.

        Kernel and stride of the first are halved as long as the last stage has fewer steps than
        MIN_LAST_STEPS; where that leaves no stride, the kernel is SHORT_KERNEL. Raises FormatError
        where the window is too short for any.
        """
        return self._planned_stages(window)[: len(self.channels)]

    def _planned_stages(self, window: int) -> tuple[Stage, ...]:
        kernel, stride = self.kernel, self.stride
        while (plan := self._plan(window, kernel, stride))[
            -1
        ].steps < MIN_LAST_STEPS and stride > 1:
            stride //= 2
            kernel = kernel // 2 if stride > 1 else SHORT_KERNEL
        if plan[-1].steps < 1:
            raise FormatError(
                f"a window of {window} frames is too short for the network; record at least 16"
            )
        return plan

    def _plan(self, window: int, kernel: int, stride: int) -> tuple[Stage, ...]:
        plan, steps, reach, hop = [], window, 1, 1
        for k, s in ((kernel, stride), *(LATER,) * (max(self.planned, len(self.channels)) - 1)):
            steps, reach, hop = (steps - k) // s + 1, reach + (k - 1) * hop, hop * s
            plan.append(Stage(k, s, steps, reach, hop))
        return tuple(plan)

    def zero_sum(self, window: int) -> bool:
        """Whether the first stage's kernels sum to zero over time for every taxel, so that no
        offset or slow drift matters.

        They do where the window is long enough for a stride. A slow sensor's texture lies in just
        these low frequencies: there each taxel's mean over the window is subtracted instead.
        """
        return self._planned_stages(window)[0].stride > 1

    def cost(self, format: SweepFormat, classes: int) -> Cost:
        """Of convolutions and head, as they are in the graph."""
        head = sum(self.channels) * classes
        weights, macs, inputs = head + classes, head, format.channels
        for stage, outputs in zip(self.stages(format.window), self.channels, strict=True):
            taps = inputs * stage.kernel * outputs
            weights, macs, inputs = weights + taps + outputs, macs + taps * stage.steps, outputs
        return Cost(weights, macs)


ARCHITECTURES = {
    "bands": Architecture((), planned=3, spectrum=True, fewest=0),
    "1k": Architecture((2, 6, 8), 32, 8),
    "4k": Architecture((5, 12, 16), 32, 8),
    "10k": Architecture((8, 20, 36), 32, 8),
    "20k": Architecture((24, 24, 24)),
    "50k": Architecture((40, 48, 64)),
    "100k": Architecture((32, 72, 104)),
}
"""By the approximate maximum of their weights, for 1500 x 4 x 4 raw counts and six materials. The
last is as large as its bundle may be; the first has only the spectrum and a head."""
DEFAULT = replace(ARCHITECTURES["20k"], fewest=0)
"""Of the method `compact`: all stages may be cut off where the spectrum alone does as well."""


@dataclass(frozen=True)
class NoiseLimit:
    """A taxel that is much noisier than others is attenuated: a broken one must not drown the rest.

    A taxel's noise is its mean difference between neighbouring frames, over `pairs` pairs at most.
    The reference is the taxel at rank a quarter of all, the noisiest first (the fifth of 16, the
    noisiest of three): more than `times` its noise is scaled down to that. A quarter and not half:
    where a finger touches only a few taxels, most are silent. Nothing is attenuated where the
    reference is silent.
    """

    times: float = 3.0
    pairs: int = 150

    def step(self, window: int) -> int:
        """Frames from one pair to the next."""
        return max(window // self.pairs, 1)

    def rank(self, taxels: int) -> int:
        """The rank of the reference taxel, the noisiest being 0."""
        return taxels // 4


NOISE_LIMIT = NoiseLimit()

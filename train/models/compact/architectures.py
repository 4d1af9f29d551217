"""The room of the ladder. In: a number of weights. Out: a Architecture, what a compact network of that size is made of.

One architecture in several sizes: dense strided convolutions over time with the taxels as input channels; the head sees
the log of every stage's mean responses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat

FLOOR = 0.02
"""Added to a mean response before its logarithm: a silent channel stays finite."""
LEAST_STEPS = 24
"""Time steps that the last stage should have: a mean over less is mostly noise."""
LATER = (5, 2)
"""Kernel and stride of the stages after the first."""
SHORT = 4
"""The first kernel of a window that does not allow any stride."""
MAINS_HZ = 50.0
"""What is not heard. Of 60 Hz three quarters still pass 32 frames at 750 Hz."""


@dataclass(frozen=True)
class Stage:
    """One convolution. steps: how many responses it gives; reach: frames of the window that one of them sees.

    Response j sees the frames from j * hop to j * hop + reach.
    """

    kernel: int
    stride: int
    steps: int
    reach: int
    hop: int


@dataclass(frozen=True)
class Cost:
    """What a network costs: trained numbers, and multiply-accumulates of one sweep (convolutions and head)."""

    weights: int
    macs: int


@dataclass(frozen=True)
class Architecture:
    """A rung of the ladder. channels: of each stage; kernel and stride: of the first stage for long windows.

    planned: how many stages there were before some were cut off, 0 for no more than there are; all may be. spectrum:
    whether the head sees the bands of spectrum.py behind the stages' responses. fewest: stages that are not cut off.
    """

    channels: tuple[int, ...]
    kernel: int = 32
    stride: int = 4
    planned: int = 0
    spectrum: bool = False
    fewest: int = 1

    def cut(self, depth: int, spectrum: bool = False) -> Architecture:
        """The first `depth` stages, each as it was, and the spectrum or not."""
        planned = max(self.planned, len(self.channels))
        return replace(self, channels=self.channels[:depth], planned=planned, spectrum=spectrum)

    def stages(self, window: int) -> tuple[Stage, ...]:
        """The stages for a window of so many frames.

        Kernel and stride of the first are halved as long as the last stage has less than LEAST_STEPS; where that leaves
        no stride, the kernel is SHORT. Raises FormatError where the window is too short for any.
        """
        return self._stages(window)[: len(self.channels)]

    def _stages(self, window: int) -> tuple[Stage, ...]:
        kernel, stride = self.kernel, self.stride
        while (plan := self._plan(window, kernel, stride))[-1].steps < LEAST_STEPS and stride > 1:
            stride //= 2
            kernel = kernel // 2 if stride > 1 else SHORT
        if plan[-1].steps < 1:
            raise FormatError(f"a window of {window} frames is too short for the network; record at least 16")
        return plan

    def _plan(self, window: int, kernel: int, stride: int) -> tuple[Stage, ...]:
        plan, steps, reach, hop = [], window, 1, 1
        for k, s in ((kernel, stride), *(LATER,) * (max(self.planned, len(self.channels)) - 1)):
            steps, reach, hop = (steps - k) // s + 1, reach + (k - 1) * hop, hop * s
            plan.append(Stage(k, s, steps, reach, hop))
        return tuple(plan)

    def zero_sum(self, window: int) -> bool:
        """Whether the first stage's kernels sum to zero over time for every taxel: no offset or slow drift moves them.

        So they do where the window is long enough for a stride. A slow sensor's texture lies in just these low
        frequencies; there each taxel's mean over the window is taken away instead.
        """
        return self._stages(window)[0].stride > 1

    def cost(self, form: SweepFormat, classes: int) -> Cost:
        """Of convolutions and head, as they stand in the graph."""
        head = sum(self.channels) * classes
        weights, macs, inputs = head + classes, head, form.rows * form.cols
        for stage, outputs in zip(self.stages(form.window), self.channels, strict=True):
            each = inputs * stage.kernel * outputs
            weights, macs, inputs = weights + each + outputs, macs + each * stage.steps, outputs
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
"""By about how many weights they have at most, for 1500 x 4 x 4 digits and six materials; the last is as large as its
bundle may be, the first has nothing but the spectrum and a head."""
DEFAULT = replace(ARCHITECTURES["20k"], fewest=0)
"""Of the box's own method: no stage at all where the spectrum alone does as well."""


@dataclass(frozen=True)
class Cap:
    """A taxel that trembles more than others is turned down: a broken one must not drown the rest.

    The mean difference of neighbouring frames, of `pairs` pairs at most, is compared with that of the strongest taxel
    after a quarter of all (the fifth of 16, none of three): more than `times` of it is turned down to that. A quarter,
    not half: where a finger touches few taxels only, most are silent. Nothing is turned down where that one is silent.
    """

    times: float = 3.0
    pairs: int = 150

    def step(self, window: int) -> int:
        """Frames from one pair to the next."""
        return max(window // self.pairs, 1)

    def place(self, taxels: int) -> int:
        """Which taxel they are compared with, the strongest being 0."""
        return taxels // 4


CAP = Cap()

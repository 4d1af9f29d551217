"""The skins that tests plug in: boards of the rig that number their frames in the raw counts."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count, repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.clock import Clock
from palpate.core.types import EPOCH_BITS, SweepFormat
from palpate.sim import rig, skin
from tests.factories.simulated_box import numbered
from tests.rig.backends import Skin

_PERIOD = 97
_LENGTH = 30 * _PERIOD  # the script is one endless act; frame i equals frame i + 97
_FIFO_S = 10
"""Depth of the FIFO. Real boards have 0.25 s to 1 s; this depth loses nothing on a busy machine."""


class Nowhere:
    """A sink for the edges of a robot that only slides."""

    def drive(self, name: str, level: bool, t_ns: int) -> None:
        """Ignore the edge."""

    def forget(self, name: str, t_ns: int) -> None:
        """Ignore it: no edge was planned."""


def board(what: Skin, clock: Clock) -> rig.ReadoutBoard:
    """A board that identifies itself as `what` and sends numbered frames of its format."""
    format = SweepFormat(
        what.rows, what.cols, what.rate_hz, skin.FORMAT.window, what.dtype, what.axes
    )
    act = rig.Act(numbered(_LENGTH, format), 10**9, 10**9 + 1, "")
    robot = rig.Robot(repeat(act), Nowhere())
    made = rig.ReadoutBoard(
        format, robot, clock, serial=what.serial, fifo_frames=round(_FIFO_S * what.rate_hz)
    )
    made.identity = replace(made.identity, protocol=what.protocol)
    return made


def counts(seq: NDArray[np.int64], format: SweepFormat) -> NDArray[Any]:
    """Raw counts of the frames with these unwrapped numbers [n]: [n, R, C]."""
    return numbered(_PERIOD, format)[(seq & ((1 << EPOCH_BITS) - 1)) % _PERIOD]


def garbler() -> Callable[[bytes], bytes]:
    """A cable that replaces every fifth transfer by zeros."""
    number: Iterator[int] = count(1)
    return lambda data: data if next(number) % 5 else bytes(len(data))

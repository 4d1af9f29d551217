"""Emulated skins on terminals that send numbered frames, by the name of a profile."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.clock import SystemClock
from tests.factories.skins.player import Player, running
from tests.factories.skins.wires import wire

SHAPES: dict[str, tuple[tuple[int, ...], str, float]] = {
    "flexitac": ((12, 32), "uint8", 100.0),
    "matrix": ((4, 4), "uint8", 100.0),
    "anyskin": ((1, 5, 3), "float32", 28.0),
    "reskin": ((1, 5, 3), "float32", 28.0),
    "3d-vitac": ((16, 16), "uint8", 32.0),
    "papillarray": ((3, 3, 3), "float32", 1000.0),
    "xela-can": ((4, 4, 3), "uint16", 100.0),
    "robotiq-tsf": ((14, 4), "uint16", 62.5),
    "paxini": ((3, 3, 3), "int16", 50.0),
    "synria": ((10, 6), "uint16", 100.0),
    "dfrobot-tactile": ((4, 8), "uint16", 50.0),
    "bota-serial": ((1, 1, 3), "float32", 100.0),
}
"""Shape, data type and rate of each skin in its maker's default."""


class Numbered:
    """Frame i holds the whole number i, for floats in steps of 0.25."""

    def __init__(self, name: str) -> None:
        self.shape, dtype, self.rate_hz = SHAPES[name]
        self._share = 2 if name == "paxini" else 1  # its forces end at 127
        self.dtype = np.dtype(dtype)

    def frame(self, i: int, frame_ns: Callable[[int], int] = lambda i: 0) -> NDArray[Any]:
        """Frame `i`. Frame i + 199 is the same."""
        cells = np.arange(np.prod(self.shape)).reshape(self.shape)
        values = ((i % 199) + 3 * cells % 50) // self._share
        return (values / 4 - 20 if self.dtype.kind == "f" else values).astype(self.dtype)


@contextmanager
def played(name: str, **how: Any) -> Iterator[Player]:
    """A skin that plays in a thread until the block ends."""
    source = Numbered(name)
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "ttySkin"
        player = Player(wire(name, source.rate_hz), source, SystemClock(), link, **how)
        with running(player):
            yield player

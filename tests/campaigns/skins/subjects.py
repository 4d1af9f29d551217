"""The skins that are measured: profile, emulator and numbered frames."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from palpate.io import skin_profile
from palpate.io.serial_sensor import requests
from palpate.io.skin_profile import SkinProfile
from tests.factories.paths import ROOT
from tests.factories.skins.devices import on_wire
from tests.factories.skins.wires import WIRES, Wire, wire

PROFILES = ROOT / "firmware_config" / "skins"
NAMES = tuple(WIRES)


@dataclass(frozen=True, slots=True)
class Subject:
    """A skin that sends frames of random content. frames: [n, *shape], repeated."""

    name: str
    profile: SkinProfile
    frames: NDArray[np.generic]

    def wire(self) -> Wire:
        """A new emulator of this skin."""
        return wire(self.name, self.profile.rate_hz)

    def sent(self, skin: Wire, i: int) -> bytes:
        """The bytes of frame `i`; a skin that answers is asked for it."""
        taxels = on_wire(self.frames[i % len(self.frames)], self.profile)
        data = skin.frame(taxels, round(1e6 * i / self.profile.rate_hz))
        return data + b"".join(map(skin.receive, requests(self.profile)))


@lru_cache
def subject(name: str, rows: int = 0, cols: int = 0, n: int = 251) -> Subject:
    """The skin of this name; its numbers fill the type, so markers occur. rows, cols: the grid."""
    profile = skin_profile.load(name, [PROFILES])
    profile = replace(profile, rows=rows or profile.rows, cols=cols or profile.cols)
    format, rng = profile.format, np.random.default_rng(sum(name.encode()))
    if format.dtype == "float32":
        # multiples of 0.25 are exact with two decimals
        values = rng.integers(-4000, 4000, (n, *format.shape)) / 4
    else:
        most = {"xela-can": 0xF9FF, "paxini": 127}.get(name, np.iinfo(format.dtype).max)
        values = rng.integers(0, most + 1, (n, *format.shape))
    return Subject(name, profile, values.astype(format.numpy_type))

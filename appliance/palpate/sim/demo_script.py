"""The script of `palpate demo`: sweeps over tubes, and on purpose other things that a box meets: a
stuck taxel, a material that nobody taught, a sweep over two materials, a cable that is pulled."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.random import Generator

from palpate.core.status import Status
from palpate.core.types import SweepFormat, normal
from palpate.sim import script, skin
from palpate.sim.rig import Act

CORK = skin.Material("cork", 0.30, 0.0200, 1.5, 0.2, 0.0040, 300.0, 0.2)
"""A tube that no bundle of the simulated tubes knows: a fine texture, hardly a vibration."""
PLACES = 0
"""Seed of the skin's position."""
SEED = 1
"""Draws the sweeps. With this one the packaged bundle is unsure about metal, then wood."""
STUCK = 1, 2
"""Row and column of the taxel that is stuck, at this count."""
STUCK_AT = 60
UNPLUGGED = 0.4, 0.7
"""When the skin is unplugged and plugged in again, as a share of a sweep."""


def acts(format: SweepFormat, seed: int) -> Iterator[Act]:
    """The sweeps of the demo, then tubes without end. format: as for script.named."""
    world = replace(script.PLAYED, shear=format == skin.SHEAR_FORMAT)
    return chain(_special(np.random.default_rng(SEED), world), script.tubes(seed, world=world))


def _special(rng: Generator, world: skin.World) -> Iterator[Act]:
    place = skin.placements("T-LAB", PLACES)[0]

    def over(tube: str) -> Act:
        return script.slide(tube, place, rng, replace(world, tubes=(*world.tubes, CORK)))

    yield over("wood")
    yield over("plastic rough")
    act = over("foam")
    normal(act.frames, 1)[:, STUCK[0], STUCK[1]] = STUCK_AT
    yield replace(act, about="a taxel is stuck: its neighbours stand in")
    yield replace(over("cork"), about="nobody taught it", wanted=Status.UNKNOWN)
    yield over("metal")
    first, second = over("metal"), over("wood")
    middle = min(first.stop + first.start, second.stop + second.start) // 2
    both = np.concatenate([first.frames[:middle], second.frames[middle:]])
    of_both = first.start, second.stop, "metal, then wood"
    yield Act(both, *of_both, about="half of each", wanted=Status.UNKNOWN)
    act = over("paper")
    gone, back = (round(act.start + share * (act.stop - act.start)) for share in UNPLUGGED)
    yield replace(
        act, about="somebody pulled the cable", wanted=Status.SENSOR_LOST, unplugged=(gone, back)
    )
    yield replace(over("paper"), about="plugged in again, nothing restarted")

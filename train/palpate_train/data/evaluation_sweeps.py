"""Test sweeps that can be corrupted, and the simulated scene that draws them again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.sim import skin
from palpate_train.data import sets
from palpate_train.data.sets import Dataset

Array = NDArray[Any]
USUAL_SWEEPS = 120
"""Test sweeps of a file that are corrupted; more sweeps narrow the intervals and take more time."""
REST_S = 0.1
"""Seconds that the simulated finger rests before and after the slide, which is as long as the
window."""


@dataclass(frozen=True)
class SimulatedScene:
    """Simulated sweeps that can be drawn again, each from its own random stream.

    materials: text [N]. places: placement of the skin in each sweep. worlds: seed of the set of
    each sweep. physics: the world in which they were drawn.
    """

    materials: tuple[str, ...]
    places: tuple[skin.Placement, ...]
    worlds: tuple[int, ...]
    physics: skin.World = skin.WORLD

    def take(self, kept: Array) -> SimulatedScene:
        """The sweeps with the numbers `kept`."""
        parts = self.materials, self.places, self.worlds
        materials, places, worlds = (tuple(part[i] for i in kept) for part in parts)
        return SimulatedScene(materials, places, worlds, self.physics)

    def draw(
        self,
        place: Callable[[skin.Placement], skin.Placement] = lambda p: p,
        world: skin.World | None = None,
        late_ms: Array | float = 0.0,
    ) -> Array:
        """Raw counts [N, 1500, 4, 4] or [N, 1500, 4, 4, 3] of the sweeps with changed placements or
        in a changed world.

        late_ms: a number or [N], at most 100 either way: start of the window minus start of the
        slide.
        """
        world = world or self.physics
        format, rest = world.format, round(REST_S * world.format.rate_hz)
        late = np.rint(np.broadcast_to(late_ms, len(self.places)) * format.rate_hz / 1000).astype(
            int
        )
        drawn = np.empty((len(self.places), format.window, *format.shape), format.numpy_type)
        for i, (material, at, seed) in enumerate(
            zip(self.materials, self.places, self.worlds, strict=True)
        ):
            rng = np.random.default_rng([seed, i, *b"stress"])
            length_s = {
                "rest_s": REST_S,
                "slide_s": format.window / format.rate_hz,
                "after_s": REST_S,
            }
            whole = skin.sweep(material, place(at), rng, world, **length_s)
            drawn[i] = whole[rest + late[i] :][: format.window]
        return drawn


@dataclass(frozen=True)
class EvaluationSweeps:
    """Test sweeps that can be corrupted. If they are simulated, `scene` draws them again."""

    sweeps: Dataset
    scene: SimulatedScene | None = None

    @classmethod
    def of(cls, sweeps: Dataset, most: int = USUAL_SWEEPS, seed: int = 0) -> EvaluationSweeps:
        """About `most` of the `sweeps`, with equal numbers of each material if there are enough."""
        order = np.random.default_rng(seed).permutation(len(sweeps))
        rank = np.empty(len(sweeps), int)
        for label in np.unique(sweeps.labels):
            those = order[sweeps.labels[order] == label]
            rank[those] = np.arange(len(those))
        return cls(sweeps.take(np.sort(order[np.argsort(rank[order], kind="stable")[:most]])))

    @classmethod
    def simulated(cls, spec: str, seed: int = 0) -> EvaluationSweeps:
        """Sweeps as in a simulated set (see sets.load), with a rest before and after each.

        They have the placements of that set and other noise. Raises FormatError as `sets.load`
        does.
        """
        base = sets.load(spec, seed)
        found = sets.SIMULATED.fullmatch(spec)
        if not found:
            raise FormatError(
                f"set {spec!r} is not a simulated one; use sim:NAME, or "
                "EvaluationSweeps.of for a file"
            )
        first = int(found["seed"] or seed)
        name = cast("skin.SetName", found["name"])
        worlds = range(first, int(found["last"] or first) + 1)
        all_places = [(world, place) for world in worlds for place in skin.placements(name, world)]
        own, places = zip(*(all_places[i] for i in base.group("position")), strict=True)
        physics = sets.simulated_world(found)
        scene = SimulatedScene(tuple(base.materials[k] for k in base.labels), places, own, physics)
        return cls(replace(base, samples=scene.draw()), scene)

    def take(self, kept: Array) -> EvaluationSweeps:
        """The sweeps with the numbers `kept`, whose faults are as strong as among all sweeps."""
        some = EvaluationSweeps(self.sweeps.take(kept), self.scene and self.scene.take(kept))
        vars(some).update(deviation=self.deviation, rms=self.rms, load=self.load)
        return some

    @cached_property
    def deviation(self) -> Array:
        """Standard deviation in raw counts [R, C] or [R, C, A] within a sweep, as root mean square
        over sweeps."""
        deviation: Array = np.sqrt(self.sweeps.samples.var(axis=1, dtype=np.float64).mean(axis=0))
        return deviation

    @cached_property
    def rms(self) -> float:
        """The deviation of all taxels together, in raw counts."""
        return float(np.sqrt(np.mean(self.deviation**2)))

    @cached_property
    def load(self) -> float:
        """Full load in raw counts: the 99.9th percentile of their magnitude. The largest count may
        be an outlier."""
        return float(np.percentile(np.abs(self.sweeps.samples.astype(np.float32)), 99.9))

"""The room of trials: what is put under stress. In: test sweeps, or the name of a simulated set. Out: a EvaluationSweeps.

A EvaluationSweeps knows how strong its signals are and, where it is simulated, can draw its sweeps anew with one thing changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.sim import skin
from train.data import sets
from train.data.sets import Dataset

Array = NDArray[Any]
USUAL_SWEEPS = 120
"""Test sweeps of a file that are put under stress; more make a point surer and everything slower."""
REST_S = 0.1
"""How long the simulated finger rests before and after the slide, which is as long as the window."""


@dataclass(frozen=True)
class SimulatedScene:
    """Simulated sweeps that can be drawn anew, each from the random stream that it had.

    materials: text [N]. places: where the skin sat in each. worlds: seed of the set that each is of.
    """

    materials: tuple[str, ...]
    places: tuple[skin.Placement, ...]
    worlds: tuple[int, ...]

    def draw(
        self,
        place: Callable[[skin.Placement], skin.Placement] = lambda p: p,
        world: skin.World = skin.WORLD,
        late_ms: Array | float = 0.0,
    ) -> Array:
        """Digits uint8 [N, 1500, 4, 4]; late_ms (a number or [N], at most 100 each way): start of window minus slide's."""
        form, rest = skin.FORMAT, round(REST_S * skin.FORMAT.rate_hz)
        late = np.rint(np.broadcast_to(late_ms, len(self.places)) * form.rate_hz / 1000).astype(int)
        drawn = np.empty((len(self.places), form.window, form.rows, form.cols), form.digits)
        for i, (material, at, seed) in enumerate(zip(self.materials, self.places, self.worlds, strict=True)):
            rng = np.random.default_rng([seed, i, *b"stress"])
            length_s = {"rest_s": REST_S, "slide_s": form.window / form.rate_hz, "after_s": REST_S}
            whole = skin.sweep(material, place(at), rng, world, **length_s)
            drawn[i] = whole[rest + late[i] :][: form.window]
        return drawn


@dataclass(frozen=True)
class EvaluationSweeps:
    """What is put under stress: test sweeps and, where they are simulated, the scene that draws them anew."""

    sweeps: Dataset
    scene: SimulatedScene | None = None

    @classmethod
    def of(cls, sweeps: Dataset, most: int = USUAL_SWEEPS, seed: int = 0) -> EvaluationSweeps:
        """About `most` of the `sweeps`, as many of each material as there are."""
        order = np.random.default_rng(seed).permutation(len(sweeps))
        rank = np.empty(len(sweeps), int)
        for label in np.unique(sweeps.labels):
            those = order[sweeps.labels[order] == label]
            rank[those] = np.arange(len(those))
        return cls(sweeps.take(np.sort(order[np.argsort(rank[order], kind="stable")[:most]])))

    @classmethod
    def simulated(cls, spec: str, seed: int = 0) -> EvaluationSweeps:
        """The sweeps of the scene "sim:NAME[:SEED[-LAST][:SWEEPS]]" (see sets.load), with a rest before and after each.

        They are others than those of the set of that name, at the same places. Raises FormatError as `sets.load`.
        """
        base = sets.load(spec, seed)
        found = sets.SIMULATED.fullmatch(spec)
        if not found:
            raise FormatError(f"set {spec!r} is no simulated one; use sim:NAME, or EvaluationSweeps.of for a file")
        first = int(found["seed"] or seed)
        worlds = range(first, int(found["last"] or first) + 1)
        all_places = [(world, place) for world in worlds for place in skin.placements(found["name"], world)]
        own, places = zip(*(all_places[i] for i in base.group("position")), strict=True)
        scene = SimulatedScene(tuple(base.materials[k] for k in base.labels), places, own)
        return cls(replace(base, samples=scene.draw()), scene)

    @cached_property
    def deviation(self) -> Array:
        """Standard deviation in digits [R, C] within a sweep, rms over sweeps."""
        return np.sqrt(self.sweeps.samples.var(axis=1, dtype=np.float64).mean(axis=0))

    @cached_property
    def rms(self) -> float:
        """The deviation of all taxels together, in digits."""
        return float(np.sqrt(np.mean(self.deviation**2)))

    @cached_property
    def load(self) -> float:
        """Full load in digits: the 99.9 percentile of their magnitude. The very largest may be an accident."""
        return float(np.percentile(np.abs(self.sweeps.samples.astype(np.float32)), 99.9))

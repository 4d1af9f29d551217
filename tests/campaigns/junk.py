"""Counts the answers of the packaged bundle to junk: sweeps without a material that it knows.

`python -m tests.campaigns junk` prints a row for each kind of sweep: how many the box answers
with `ok`, and how many of these labels are wrong, for whole sweeps and with early answers. A sweep
of two materials, or of none, is wrong under any label. Takes some minutes.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core import storage
from palpate.core.provenance import commit
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.sim import skin
from palpate.sim.rig import VirtualClock
from palpate_train.metrics.bundle_score import first_answer

Counts = NDArray[np.float64]
N, RATE = skin.FORMAT.window, skin.FORMAT.rate_hz
TIMES = np.arange(N)[:, None, None]
SECONDS = TIMES / RATE
EACH = 200


@dataclass(frozen=True)
class SweepDraw:
    """Draws sweeps of the materials at trained placements in a world."""

    world: skin.World
    rng: Generator

    def place(self) -> skin.Placement:
        """A random trained placement."""
        places = skin.placements("T-REAL", int(self.rng.integers(1000, 2000)))
        return places[self.rng.integers(len(places))]

    def slide(self, material: str, **changed: float) -> Counts:
        """A window of a slide. changed: parameters of the world."""
        world = replace(self.world, **changed)  # type: ignore[arg-type]
        return skin.window(material, self.place(), self.rng, world).astype(float)

    def touch(self, material: str, rest: float, slid: float, dx_mm: float = 0.0) -> Counts:
        """A window of a finger that rests, slides and rests again; shares of the window."""
        place, s = self.place(), N / RATE
        place = replace(place, dx_mm=place.dx_mm + dx_mm)
        parts = {"rest_s": rest * s, "slide_s": slid * s, "after_s": (1 - rest - slid) * s + 0.1}
        return skin.sweep(material, place, self.rng, self.world, **parts)[:N].astype(float)

    def other(self, material: str) -> str:
        """Another material."""
        return str(self.rng.choice([m for m in skin.MATERIALS if m != material]))


LEAST_PROPERTY = 0.005
"""A property below it is as good as absent."""
OTHER_SKIN = {"counts_per_kpa": 12.0, "damping_hz": 80.0, "noise_counts": 1.64}
"""A fifth less sensitive, twice the noise, more damping."""
Make = Callable[[SweepDraw, str], Counts]
"""Raw counts [T, R, C], not yet rounded, of a scene and a material."""
Wave = Callable[[SweepDraw], Counts]


def rests(scene: SweepDraw, material: str) -> Counts:
    """A window of a finger that rests."""
    return scene.touch(material, 1.0, 0.0)


def level(scene: SweepDraw, material: str) -> Counts:
    """The mean load of a slide [1, R, C]."""
    return scene.slide(material).mean(axis=0, keepdims=True)


def strength(x: Counts) -> float:
    """The deviation of counts [T, R, C] within the window."""
    return float(np.sqrt(x.var(axis=0).mean()))


def added(base: Make, wave: Wave, share: float) -> Make:
    """`base` and a wave of `share` deviations of a slide."""

    def make(scene: SweepDraw, material: str) -> Counts:
        size = share * strength(scene.slide(material))
        return base(scene, material) + size * wave(scene)

    return make


def sine(hz: float) -> Wave:
    """A sine on all taxels, of deviation 1."""
    return lambda scene: np.sqrt(2) * np.sin(2 * np.pi * (hz * SECONDS + scene.rng.random()))


def chirp(scene: SweepDraw) -> Counts:
    """A sine that rises from 5 to 300 Hz, of deviation 1."""
    turns = 5 * SECONDS + (300 - 5) / (2 * N / RATE) * SECONDS**2
    return np.asarray(np.sqrt(2) * np.sin(2 * np.pi * turns))


def square(scene: SweepDraw) -> Counts:
    """A square wave of 10 Hz."""
    return np.sign(np.sin(2 * np.pi * (10 * SECONDS + scene.rng.random())))


def white(taxels: int) -> Wave:
    """White noise of each of 4 x 4 taxels, or of one that stands for all."""
    return lambda scene: scene.rng.standard_normal((N, taxels, taxels))


def coloured(power: float) -> Wave:
    """Noise that all taxels share, of deviation 1, whose power falls with the frequency."""

    def wave(scene: SweepDraw) -> Counts:
        bins = np.fft.rfft(scene.rng.standard_normal(N))
        bins[1:] /= np.arange(1, len(bins)) ** (power / 2)
        bins[0] = 0
        found = np.fft.irfft(bins, N)
        return np.asarray((found / found.std())[:, None, None])

    return wave


def clicks(scene: SweepDraw) -> Counts:
    """Short pulses at random times, of deviation 1."""
    found = (scene.rng.random((N, 1, 1)) < 0.01) * 1.0
    return found / max(found.std(), 1e-9)


def taps(scene: SweepDraw, material: str) -> Counts:
    """A finger that taps five times a second."""
    load = np.maximum(np.sin(2 * np.pi * (5 * SECONDS + scene.rng.random())), 0)
    return rests(scene, material) * load


def rocks(scene: SweepDraw, material: str) -> Counts:
    """A finger that rests and rocks to and fro once a second."""
    lean = 0.3 * np.sin(2 * np.pi * (SECONDS + scene.rng.random()))
    return rests(scene, material) * (1 + lean * np.linspace(-1, 1, 4)[:, None])


def lifted(off: NDArray[np.bool_]) -> Make:
    """A slide that is lifted in these frames [T, 1, 1]."""

    def make(scene: SweepDraw, material: str) -> Counts:
        x, idle = scene.slide(material), skin.idle(N, scene.rng, scene.world)
        return np.where(off, idle, x)

    return make


def both(first: NDArray[np.bool_]) -> Make:
    """A slide in these frames [T, 1, 1], a slide over another material in the others."""
    return lambda s, m: np.where(first, s.slide(m), s.slide(s.other(m)))


def pauses(scene: SweepDraw, material: str) -> Counts:
    """A slide that rests between a quarter and three quarters of the window."""
    x, still = scene.slide(material), rests(scene, material)
    return np.where(between(0.25, 0.75), still, x)


def between(first: float, last: float) -> NDArray[np.bool_]:
    """The frames [T, 1, 1] between two shares of the window."""
    return np.asarray((first * N <= TIMES) & (last * N > TIMES))


def shaken(share: float) -> Make:
    """A slide with a share of its vibration, around the same load."""

    def make(scene: SweepDraw, material: str) -> Counts:
        x = scene.slide(material)
        middle = x.mean(axis=0, keepdims=True)
        return middle + share * (x - middle)

    return make


def permuted(scene: SweepDraw, material: str) -> Counts:
    """A slide whose taxels are confused."""
    order = scene.rng.permutation(16)
    return scene.slide(material).reshape(N, 16)[:, order].reshape(N, 4, 4)


def mosaic(scene: SweepDraw, material: str) -> Counts:
    """Taxels of sixteen slides of different materials."""
    names = scene.rng.permutation(np.tile(skin.MATERIALS, 3))[:16]
    parts = [scene.slide(str(name)).reshape(N, 16)[:, i] for i, name in enumerate(names)]
    return np.stack(parts, axis=1).reshape(N, 4, 4)


def phases(scene: SweepDraw, material: str) -> Counts:
    """A slide whose taxels keep their spectra and get random phases."""
    bins = np.fft.rfft(scene.slide(material), axis=0)
    turns = np.exp(2j * np.pi * scene.rng.random(bins.shape))
    turns[0] = 1
    return np.fft.irfft(bins * turns, N, axis=0)


def one_taxel(scene: SweepDraw, material: str) -> Counts:
    """A slide that loads one taxel."""
    x, keep = skin.idle(N, scene.rng, scene.world).astype(float), scene.rng.integers(4, size=2)
    x[:, keep[0], keep[1]] = scene.slide(material)[:, keep[0], keep[1]]
    return x


def walks(scene: SweepDraw, material: str) -> Counts:
    """A random walk of each taxel around the load of a slide."""
    steps = scene.rng.standard_normal((N, 4, 4)).cumsum(axis=0)
    return level(scene, material) + steps / 4


def untaught(draw: Callable[[SweepDraw], skin.Material]) -> Make:
    """A slide over a material that no bundle knows."""

    def make(scene: SweepDraw, material: str) -> Counts:
        drawn = draw(scene)
        place, world = scene.place(), replace(scene.world, tubes=(drawn,))
        return skin.window(drawn.name, place, scene.rng, world).astype(float)

    return make


def near_foam(scene: SweepDraw) -> skin.Material:
    """Foam with each parameter up to a fifth larger or smaller."""
    foam = scene.world.tube("foam")
    return _varied(scene, foam, foam, 0.2)


def felt(scene: SweepDraw) -> skin.Material:
    """A soft material with a fine, shallow pattern and low vibrations."""
    foam, paper = scene.world.tube("foam"), scene.world.tube("paper")
    return _varied(scene, replace(foam, pitch_mm=2.0, texture_mm=paper.texture_mm / 3), foam, 0.05)


def random_material(scene: SweepDraw) -> skin.Material:
    """Each parameter of another material, up to a third larger or smaller."""
    one, other = (scene.world.tube(str(scene.rng.choice(skin.MATERIALS))) for _ in range(2))
    return _varied(scene, one, other, 1 / 3)


def one_property(name: str) -> Make:
    """A known material of which one property alone is half larger, or a third smaller."""

    def draw(scene: SweepDraw) -> skin.Material:
        has = [tube for tube in scene.world.tubes if getattr(tube, name) > LEAST_PROPERTY]
        known = has[int(scene.rng.integers(len(has)))]
        factor = 1.5 if scene.rng.random() < 0.5 else 1 / 1.5
        return replace(known, name="untaught", **{name: factor * getattr(known, name)})

    return untaught(draw)


def halfway(scene: SweepDraw) -> skin.Material:
    """Each property halfway between those of two known materials."""
    two = [scene.world.tube(str(name)) for name in scene.rng.choice(skin.MATERIALS, 2, False)]
    names = [part.name for part in fields(skin.Material) if part.name != "name"]
    middle = {name: float(np.mean([getattr(one, name) for one in two])) for name in names}
    return skin.Material("untaught", **middle)


def beside(make: Make, wave: Wave, share: float) -> Make:
    """A sweep and a wave of `share` of its own deviations."""

    def made(scene: SweepDraw, material: str) -> Counts:
        x = make(scene, material)
        return x + share * strength(x) * wave(scene)

    return made


def elsewhere(make: Make, **changed: float) -> Make:
    """A sweep in a world with other parameters."""

    def made(scene: SweepDraw, material: str) -> Counts:
        world = replace(scene.world, **changed)  # type: ignore[arg-type]
        return make(SweepDraw(world, scene.rng), material)

    return made


def _varied(
    scene: SweepDraw, one: skin.Material, other: skin.Material, share: float
) -> skin.Material:
    """A material with each parameter of one of the two, varied by a share."""
    values = {}
    for part in fields(skin.Material):
        if part.name != "name":
            source = one if scene.rng.random() < 0.5 else other
            factor = 1 + share * scene.rng.uniform(-1, 1)
            values[part.name] = float(getattr(source, part.name) * factor)
    return skin.Material("untaught", **values)


UNTAUGHT: dict[str, Make] = {
    "material near foam": untaught(near_foam),
    "felt": untaught(felt),
    "random material": untaught(random_material),
}
HARDER: dict[str, Make] = {
    "softness alone": one_property("softness_mm_per_kpa"),
    "roughness alone": one_property("texture_mm"),
    "vibration alone": one_property("vibration"),
    "halfway between two": untaught(halfway),
    "random material, 50 Hz hum": beside(untaught(random_material), sine(50), 0.5),
    "random material, noise": beside(untaught(random_material), white(4), 0.5),
    "random material, 35 % faster": elsewhere(untaught(random_material), speed=1.35),
    "random material, other skin": elsewhere(untaught(random_material), **OTHER_SKIN),
}
COUNTED = "whole", "whole wrong", "early", "early wrong"
NAMELESS: dict[str, Make] = {
    "finger rests": rests,
    "rests, skin two rows off": lambda s, m: s.touch(m, 1.0, 0.0, 8.0),
    "rests, 50 Hz hum": added(rests, sine(50), 0.5),
    "rests, 50 Hz hum, strong": added(rests, sine(50), 2.0),
    "rests, noise": added(rests, white(4), 0.5),
    "rests, common noise": added(rests, white(1), 0.5),
    "rests, common pink noise": added(rests, coloured(1.0), 1.0),
    "rests, clicks": added(rests, clicks, 0.5),
    "rests and taps": taps,
    "rests and rocks": rocks,
    "rests and presses more": lambda s, m: rests(s, m) * np.linspace(0.4, 1.2, N)[:, None, None],
    "load and white noise": added(level, white(4), 1.0),
    "load and loud white noise": added(level, white(4), 3.0),
    "load and common noise": added(level, white(1), 1.0),
    "load and pink noise": added(level, coloured(1.0), 1.0),
    "load and brown noise": added(level, coloured(2.0), 1.0),
    "load and a 20 Hz sine": added(level, sine(20), 1.0),
    "load and a 50 Hz sine": added(level, sine(50), 1.0),
    "load and a 100 Hz sine": added(level, sine(100), 1.0),
    "load and a chirp": added(level, chirp, 1.0),
    "load and a square wave": added(level, square, 1.0),
    "load and clicks": added(level, clicks, 1.0),
    "random bytes": lambda s, m: s.rng.integers(0, 256, (N, 4, 4)),
    "random bytes, all taxels alike": lambda s, m: s.rng.integers(0, 256, (N, 1, 1)),
    "random walk": walks,
    "sixteen slides, a taxel of each": mosaic,
    "two halves": both(TIMES * 2 < N),
    "mean of two slides": lambda s, m: (s.slide(m) + s.slide(s.other(m))) / 2,
    "two slides in turn": both(TIMES % 2 == 1),
}
ALTERED: dict[str, Make] = {
    "first half lifted": lifted(between(0, 0.5)),
    "second half lifted": lifted(between(0.5, 1)),
    "middle lifted": lifted(between(0.25, 0.75)),
    "lifted ten times": lambda s, m: np.where(
        SECONDS % 0.2 >= 0.1, skin.idle(N, s.rng, s.world), s.slide(m)
    ),
    "slides the first half": lambda s, m: s.touch(m, 0, 0.5),
    "slides the second half": lambda s, m: s.touch(m, 0.5, 0.5),
    "slides the first fifth": lambda s, m: s.touch(m, 0, 0.2),
    "slides the last fifth": lambda s, m: s.touch(m, 0.8, 0.2),
    "slides, rests, slides": pauses,
    "gain x 0.2": lambda s, m: 0.2 * s.slide(m),
    "gain x 0.33": lambda s, m: s.slide(m) / 3,
    "gain x 3": lambda s, m: 3 * s.slide(m),
    "vibration x 0.1": shaken(0.1),
    "vibration x 0.33": shaken(1 / 3),
    "vibration x 3": shaken(3.0),
    "speed x 0.33": lambda s, m: s.slide(m, speed=1 / 3),
    "speed x 3": lambda s, m: s.slide(m, speed=3.0),
    "one row off": lambda s, m: s.touch(m, 0, 1, skin.PITCH_MM),
    "two rows off": lambda s, m: s.touch(m, 0, 1, 2 * skin.PITCH_MM),
    "two rows off, backwards": lambda s, m: s.touch(m, 0, 1, -2 * skin.PITCH_MM),
    "taxels confused": permuted,
    "frames shuffled": lambda s, m: s.slide(m)[s.rng.permutation(N)],
    "each tenth frame held": lambda s, m: s.slide(m)[::10].repeat(10, axis=0),
    "random phases": phases,
    "one taxel loaded": one_taxel,
}
GROUPS = {
    "no material, or no slide": NAMELESS,
    "slides that were altered": ALTERED,
    "materials that nobody taught": UNTAUGHT,
    "untaught materials, made harder": HARDER,
}
KINDS = NAMELESS | ALTERED | UNTAUGHT | HARDER
"""How to draw a sweep of each kind. Only in altered slides the label of the material is right."""


def window(name: str, world: skin.World, number: int) -> tuple[NDArray[np.uint8], str]:
    """The raw counts [T, R, C] of a sweep of a kind, and the label that is right, "" for none."""
    scene = SweepDraw(world, np.random.default_rng([number, *name.encode()]))
    material = skin.MATERIALS[number % len(skin.MATERIALS)]
    counts = np.clip(np.rint(KINDS[name](scene, material) * np.ones((N, 4, 4))), 0, 255)
    return counts.astype(np.uint8), material * (name in ALTERED)


def answer(box: Classifier, early: EarlyExit | None, taxels: NDArray[np.uint8]) -> Verdict:
    """The first answer to a sweep whose frames arrive in tenths."""
    t_ns = (np.arange(N) * skin.FORMAT.period_ns).astype(np.int64)
    whole = Sweep(1, 0, int(t_ns[-1]), Status.OK, Frames(t_ns, np.arange(N), taxels))
    return (early and first_answer(early, whole)) or box(whole)


def counted(
    model: bundle.Bundle, world: skin.World, each: int, wanted: Iterable[str] = ()
) -> dict[str, dict[str, Any]]:
    """Prints and returns the sweeps, labels and wrong labels of each kind, whole and early. wanted:
    the kinds, all without any."""
    box = Classifier(model, VirtualClock())
    early = EarlyExit(box) if model.manifest.early else None
    print(f"{'of ' + str(each):32} whole: ok, wrong; early: ok, wrong; most frequent status")
    kinds = {}
    for name in wanted or KINDS:
        found, statuses = Counter[str](), Counter[str]()
        for number in range(each):
            taxels, right = window(name, world, number)
            for how, by in (("whole", None), ("early", early)):
                verdict = answer(box, by, taxels)
                ok = verdict.status is Status.OK
                found.update({how: ok, f"{how} wrong": ok and verdict.label != right})
                statuses.update([str(verdict.status)] if by is None else [])
        kinds[name] = {"group": group(name), "sweeps": each, **found} | {
            "statuses": dict(statuses.most_common())
        }
        usual = ", ".join(f"{status} {n}" for status, n in statuses.most_common(2))
        print(f"{name:32} {' '.join(f'{found[key]:5}' for key in COUNTED)} ", usual, flush=True)
    return kinds


def group(name: str) -> str:
    """The group of a kind, for the sums."""
    return next(text for text, kinds in GROUPS.items() if name in kinds)


def table(content: dict[str, Any]) -> str:
    """The counts in Markdown: first the sum of each group, then each kind."""
    kinds = content["kinds"]
    sums: dict[str, Counter[str]] = {}
    for name, found in kinds.items():
        total = sums.setdefault(f"**{group(name)}**", Counter[str]())
        total.update({key: found[key] for key in ("sweeps", *COUNTED)})
    rows = [
        f"Measured by `python -m tests.campaigns junk`, bundle {content['bundle']}, world "
        f"{content['world']}; commit {content['commit'][:12]}.",
        "",
        "| kind of sweep | sweeps | whole: `ok`, of these wrong | early: `ok`, of these wrong | "
        "most frequent answers |",
        "|---|---|---|---|---|",
    ]
    for name, found in {**sums, **kinds}.items():
        usual = [f"`{s}` {n}" for s, n in [*found.get("statuses", {}).items()][:2]]
        whole, whole_wrong, early, early_wrong = (found[key] for key in COUNTED)
        rows.append(
            f"| {name} | {found['sweeps']} | {whole}, {whole_wrong} | {early}, {early_wrong} | "
            f"{', '.join(usual)} |"
        )
    return "\n".join(rows)


def main() -> None:
    """Count, write the figures, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns junk", description=__doc__)
    parser.add_argument("--each", type=int, default=EACH, help="sweeps of a kind (default: 200)")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, help="count only these")
    parser.add_argument("--bundle", type=Path, default=bundle.DEFAULT)
    parser.add_argument("--world", choices=skin.WORLDS, default="level-blind")
    parser.add_argument("--out", type=Path, default=Path("build/junk.json"))
    parser.add_argument("--draw", action="store_true", help="count nothing: the table of --out")
    options = parser.parse_args()
    if not options.draw:
        model = bundle.load(options.bundle)
        made = {"commit": commit(), "bundle": model.id, "world": options.world}
        kinds = counted(model, skin.WORLDS[options.world], options.each, options.kinds)
        content = made | {"kinds": kinds}
        if options.kinds:
            content = json.loads(options.out.read_text("utf-8"))
            content["kinds"] |= {name: found | made for name, found in kinds.items()}
        storage.put(options.out, json.dumps(content, indent=1).encode() + b"\n", parents=True)
    content = json.loads(options.out.read_text("utf-8"))
    print(table(content))


if __name__ == "__main__":
    main()

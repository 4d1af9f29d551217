"""The room of what a method costs on the box. In: methods, a scene's sweeps. Out: each one's Price, measured on a bundle.

The bundle is a real one: trained, packed, loaded and timed by the box's own classifier, and then thrown away.
"""

from __future__ import annotations

import json
import math
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from appliance.bundle import bundle
from appliance.core.clock import SystemClock
from appliance.core.errors import BundleError, FormatError
from appliance.core.storage import put
from appliance.core.types import Frames, Status, Sweep
from appliance.inference.classifier import Classifier
from train.data.sets import Dataset, digest
from train.evaluation.evaluate import Where
from train.evaluation.fold import fingerprint
from train.export import pack
from train.models import methods
from train.models.methods import Effort, Method
from train.selection.scene import Budget, Scene

TRIED_S = 1.0
"""How long a bundle is timed, and at least LEAST times."""
LEAST = 30
RESIDENT = """
import os, sys
from pathlib import Path
from appliance.bundle import bundle
from appliance.core import clock
from appliance.inference import classifier
classifier.Classifier(bundle.load(Path(sys.argv[1])), clock.SystemClock()).self_test()
pages = int(Path("/proc/self/statm").read_text().split()[1])
print(pages * os.sysconf("SC_PAGESIZE") / 2**20)
"""
"""Run in a process of its own, which holds what the box holds: its memory in 2**20 bytes."""


@dataclass(frozen=True)
class Price:
    """What a sweep costs. ms: median, features and checks too, on this machine. kb: 1000 bytes, the whole bundle, golden
    sweeps too. mb: 2**20 bytes, resident. refused: why there is no bundle; the rest is not a number then."""

    ms: float = math.nan
    kb: float = math.nan
    mb: float = math.nan
    refused: str = ""

    def cost(self, budget: Budget) -> tuple[float, float]:
        """What rungs are ordered by: how much of what the board has of time and of room is used, whichever is scarcer;
        where neither has a limit the size alone. Memory does not count: it is nearly the same for all. Equals by time."""
        shares = [share for key, share in self.used(budget).items() if key != "mb"]
        return max(shares, default=self.kb), self.ms

    def used(self, budget: Budget) -> dict[str, float]:
        """Share of each part of the budget that has a limit."""
        needs = {"ms": self.ms * budget.slower, "kb": self.kb, "mb": self.mb}
        return {k: v / limit for k, v in needs.items() if math.isfinite(limit := getattr(budget, k))}


def ladder(scene: Scene) -> list[str]:
    """The scene's methods, or the usual ones: the paper's classical ones that are cheap, and the family of compact."""
    if scene.methods:
        return list(scene.methods)
    known = methods.every()
    family = [name for name in known if name.startswith("compact-")] or ["compact"]
    return [name for name in ("L-gauss", "L-svm", "H-svm", *family) if name in known]


def prices(
    names: Sequence[str], sweeps: Dataset, scene: Scene, effort: Effort, where: Where, log: Callable[[str], None]
) -> dict[str, Price]:
    """The price of each method, cheapest first and refused ones last. Measured one after another, and kept."""
    found, data = {}, digest(sweeps)
    for i, method in enumerate(methods.find(names, effort)):
        about = ["price", platform.node(), data, method.name, method.effort, scene.full_scale]
        key = fingerprint(about, methods.module_of(method.name), "train.export.pack")
        path = where.cache / f"{key}.json" if where.cache else None
        if path and path.exists():
            found[method.name] = Price(**json.loads(path.read_text()))
            continue
        log(f"{i}/{len(names)} bundles timed ({method.name} is trained)")
        found[method.name] = _price(method, sweeps, scene)
        if path:
            put(path, json.dumps(asdict(found[method.name])).encode(), parents=True)
    return dict(sorted(found.items(), key=lambda item: (bool(item[1].refused), item[1].cost(scene.budget))))


def _price(method: Method, sweeps: Dataset, scene: Scene) -> Price:
    try:
        with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
            content = pack.trained(method, sweeps, 1)
            out = Path(folder) / "bundle"
            pack.pack(content, out, "price", "0", "", scene.full_scale or None)
            return measured(out, content.held)
    except (FormatError, BundleError) as e:
        return Price(refused=str(e))


def measured(folder: Path, sweeps: Dataset) -> Price:
    """The price of the bundle in `folder`, timed on `sweeps`."""
    box = Classifier(bundle.load(folder), SystemClock())
    form, n = sweeps.format, np.arange(sweeps.format.window)
    t_ns = (n * form.period_ns).astype(np.int64)
    times: list[float] = []
    end = time.perf_counter() + TRIED_S
    while len(times) < LEAST or time.perf_counter() < end:
        taxels = sweeps.samples[len(times) % len(sweeps)]
        sweep = Sweep(0, 0, int(t_ns[-1]), Status.OK, Frames(t_ns, n, taxels))
        start = time.perf_counter()
        box(sweep)
        times.append(1e3 * (time.perf_counter() - start))
    size = sum(file.stat().st_size for file in folder.iterdir())
    return Price(round(float(np.median(times)), 4), round(size / 1000, 2), round(_resident(folder), 1))


def _resident(folder: Path) -> float:
    done = subprocess.run([sys.executable, "-c", RESIDENT, str(folder)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise BundleError(f"a process of its own cannot load the bundle: {done.stderr.strip()[-200:]}")
    return float(done.stdout)

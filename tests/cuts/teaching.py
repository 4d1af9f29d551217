"""Teaching, cut short. A box forgets a material, makes a bundle of its sweeps, tries it, is taught
again, and gets a delivery.

The judge finds each box that does not come back with the old or the new bundle, whole; that has
lost a sweep or a decision; or that cannot be taught again. `python -m tests.cuts.teaching ARGUMENT
...` is `palpate` whose fit takes no time: its files are those of the packaged bundle.
"""

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import numpy as np

from palpate.bundle import bundle
from palpate.cli.main import main
from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.errors import FormatError
from palpate.core.sweep_file import load
from palpate.learn import install
from palpate.sweeps.sweep_folder import FORGOTTEN, forgotten_in
from tests.cuts import delivery
from tests.cuts.calls import NotFollowed
from tests.cuts.delivery import STORE, Shop
from tests.cuts.scene import CutScene, Found, SceneStep
from tests.factories import lessons
from tests.factories.sweep_sets import easy

MATERIAL = "low"
"""The material that is forgotten."""
FORGET, USE = ("teach", "--forget", MATERIAL), ("teach", "--use", "--by", "anna")


@dataclass(frozen=True, slots=True)
class TeachingShop(Shop):
    """Beside the box: its key, and a bundle that is delivered at the end."""

    def teaching(self) -> CutScene:
        """The scene of all steps; each command is cut short."""
        ids, may = self._ids(), {step.name: names.split() for names, step in self._steps()}
        steps = tuple(step for _, step in self._steps())

        def judge(found: Found) -> list[str]:
            ran = {found.heard} if found.heard else {ids[name] for name in may[found.step]}
            later = found.step != steps[0].name
            # the next forget overwrites it
            part = f"{FORGOTTEN}{storage.PART}"
            (found.folder / STORE / "sweeps" / part).unlink(missing_ok=True)
            return (
                _lost(found.folder / STORE, forgotten=later)
                or self._comes_back(found.folder, ran)
                or self._taught_again(found.folder)
                or self._takes_another(found.folder, ids["last"])
            )

        apart = delivery.APART
        return CutScene("teaching", self._recorded, steps, judge, apart, delivery._promised)

    def once(self) -> CutScene:
        """A single lesson, on a box that runs the first bundle."""
        whole = self.teaching()
        return replace(whole, steps=whole.steps[:2])

    def _steps(self) -> list[tuple[str, SceneStep]]:
        """As `Shop.steps`."""
        do = self.palpate
        return [
            ("first", self._teach("forget a material", *FORGET)),
            ("first taught", self._teach("teach", *USE)),
            ("taught", do("start it and end in order", *delivery.START)),
            ("taught", do("start and commit it", *delivery.START_AND_COMMIT)),
            ("taught again", self._teach("teach again", *USE)),
            ("again taught", do("roll back from the trial", "bundles", "rollback")),
            ("taught", self.copy("second")),
            ("taught second", do("install another", "bundles", "install", "@second")),
        ]

    def _teach(self, name: str, *words: str) -> SceneStep:
        program = [sys.executable, "-m", "tests.cuts.teaching"]
        return SceneStep(name, lambda folder: [*program, *self.words(folder, *words)])

    def _recorded(self, folder: Path) -> None:
        """A box that runs the first bundle and has recorded sweeps."""
        self._delivered(folder)
        lessons.write(folder / STORE / "sweeps", easy(1))

    def _ids(self) -> dict[str, str]:
        """The ids of all bundles; the same sweeps give the same bytes."""
        ids = {name: bundle.load(self.at(name)).id for name in delivery.NAMES}
        with TemporaryDirectory() as aside:
            self._recorded(folder := Path(aside))
            for name in ("taught", "again"):
                code, output = self._taught(folder)
                ids[name] = delivery._promised(output)
                if code or not ids[name]:
                    raise NotFollowed(f"teaching ended with {code}: {delivery._end(output)}")
                delivery._apart(self.words(folder, *delivery.START_AND_COMMIT))
        return ids

    def _taught(self, folder: Path) -> tuple[int, str]:
        with mock.patch.object(install, "_wait", at_once):
            return delivery._apart(self.words(folder, *USE))

    def _taught_again(self, folder: Path) -> list[str]:
        """Faults of a copy of the box when it is taught after the cut."""
        with TemporaryDirectory(dir=folder.parent) as aside:
            again = Path(aside) / "again"
            shutil.copytree(folder, again, symlinks=True)
            code, output = self._taught(again)
            if code or (again / STORE / "teaching").exists():
                return [f"taught again: exit code {code}: {delivery._end(output)}"]
        return []


def _lost(store: Path, *, forgotten: bool) -> list[str]:
    """Sweeps and decisions that are gone. forgotten: whether the material must be forgotten."""
    try:
        sweeps = [load(path)[0] for path in sorted((store / "sweeps").glob("*.npy"))]
        gone = forgotten_in(store / "sweeps")
    except FormatError as e:
        return [str(e)]
    wrong = [] if len(sweeps) == len(easy(1)) else [f"{len(sweeps)} sweeps are left"]
    low = np.flatnonzero(easy(1).labels == easy(1).materials.index(MATERIAL)) + 1
    held = {MATERIAL: low.tolist()}
    if gone not in ([held] if forgotten else [held, {}]):
        wrong.append(f"forgotten are {gone}")
    return wrong


def at_once(
    words: list[str], limit_s: float, clock: Clock, tell: Callable[[dict[str, Any]], object]
) -> None:
    """Write a bundle as the process that learns does, without a fit."""
    out = Path(words[words.index("--out") + 1])
    manifest = replace(
        bundle.load(bundle.DEFAULT).manifest,
        name="taught",
        version=words[words.index("--version") + 1],
    )
    files = bundle.files(bundle.DEFAULT) | {bundle.MANIFEST: manifest.json()}
    out.parent.mkdir()
    with storage.folder(out) as new:
        for name, data in files.items():
            (new / name).write_bytes(data)
    tell({"type": "taught", "labels": [*manifest.labels], "figures": {}, "peak_mb": 0})


if __name__ == "__main__":
    with mock.patch.object(install, "_wait", at_once):
        sys.exit(main(sys.argv[1:]))

"""Releases, cut short: a new release is activated, started, sent back and committed. The judge
finds each box on which neither the old release nor the new one runs, or whose trial is lost."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from palpate.deployment.releases import REPORT, Releases
from palpate.deployment.state import MOST_STARTS
from tests.cuts.scene import CutScene, Found, SceneStep

ONE, TWO, THREE, LAST = NAMES = tuple(f"palpate-{n}" for n in (1, 2, 3, 4))
PASS = """
import dataclasses, pathlib, sys; from palpate.deployment import releases
opt, var = map(pathlib.Path, sys.argv[1:]); trial = releases.Releases(opt).trial
releases.write_report(var, releases.ReleaseReport(trial.id, trial.start, passed=True))
"""
"""The service says that its release has passed the trial."""


def scene() -> CutScene:
    """The life of two releases."""
    steps = [
        (f"{ONE} {TWO}", _does("activate the second", "activate", TWO)),
        *((TWO, _does(f"start it, {n}", "begin")) for n in range(MOST_STARTS)),
        (f"{TWO} {ONE}", _does("start it once more", "begin")),
        (f"{ONE} {THREE}", _does("activate the third", "activate", THREE)),
        (THREE, _does("start the third", "begin")),
        (THREE, SceneStep("pass", lambda f: [sys.executable, "-c", PASS, f / "opt", f / "var"])),
        (THREE, _does("commit the third", "begin")),
        (f"{THREE} {ONE}", _does("activate the first", "activate", ONE)),
        (f"{ONE} {THREE}", _does("go back by hand", "activate", THREE)),
    ]
    may = {step.name: names.split() for names, step in steps}

    def judge(found: Found) -> list[str]:
        return _wrong(found.folder, may[found.step])

    return CutScene("releases", _prepare, tuple(step for _, step in steps), judge)


def _does(name: str, *words: str) -> SceneStep:
    """A command of root."""
    command = [sys.executable, "-m", "palpate.deployment.releases", *words]
    where = ("--folder", "opt"), ("--report", "var")
    return SceneStep(name, lambda f: [*command, *(str(x) for k, v in where for x in (k, f / v))])


def _prepare(folder: Path) -> None:
    """A box with the first release; the others are built."""
    for name in NAMES:
        (folder / "opt" / name).mkdir(parents=True)
    (folder / "var").mkdir()
    Releases(folder / "opt").activate(ONE)


def _wrong(folder: Path, may: list[str]) -> list[str]:
    """Faults of the box when it starts after a loss of power, and when another release comes."""
    boot = folder / "boot_id"
    boot.write_text("the next\n")
    box = Releases(folder / "opt", folder / "var", boot)
    box.begin()
    now, trial, wrong = box.current, box.trial, []
    if now not in may or now in box.rejected:
        wrong.append(f"{now or 'nothing'} runs instead of {may}, rejected {[*box.rejected]}")
    if trial and trial.back not in (ONE, THREE):
        wrong.append(f"{now} would go back to {trial.back}")
    box.activate(LAST)
    proven = trial.back if trial else now
    (folder / "var" / REPORT).unlink(missing_ok=True)
    for _ in range(MOST_STARTS + 1):
        box.begin()
    if box.current != proven or LAST not in box.rejected:
        wrong.append(f"the next release goes back to {box.current} instead of {proven}")
    left = [path.name for path in (folder / "opt").iterdir() if path.suffix == ".part"]
    held = json.loads((folder / "opt" / "palpate.rejected").read_bytes())
    return wrong + [f"{name} is left" for name in left] + [f"{held}"] * (not held)

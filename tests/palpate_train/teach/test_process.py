"""`python -m palpate_train.teach` as a process: its imports, output, files and failures."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.inference.classifier import Classifier
from palpate.learn.process import TeachingProcess
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.answer.stranger_limits import FIGURES
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.models.recipe import recipe
from palpate_train.teach.lesson import Lesson
from tests.factories import lessons
from tests.factories.paths import ROOT
from tests.factories.sweep_sets import easy

pytestmark = pytest.mark.slow

WATCHED = """
import sys
from palpate_train.teach.__main__ import main
code = main(sys.argv[1:])
loaded = sorted({name.partition(".")[0] for name in sys.modules})
print(" ".join(loaded), file=sys.stderr)
sys.exit(code)
"""
LONG_S = 900
"""Limit of a process, far beyond its time on a loaded machine."""


def run(code: str, *words: str | Path | int) -> subprocess.CompletedProcess[str]:
    """A process of this program."""
    command, how = [sys.executable, "-c", code, *map(str, words)], {"text": True, "check": False}
    return subprocess.run(command, cwd=ROOT, capture_output=True, timeout=LONG_S, **how)


def ran(*words: str | Path) -> tuple[int, list[dict[str, Any]], set[str]]:
    """Exit code, printed objects, and the imported packages."""
    done = run(WATCHED, *words)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return done.returncode, lines, set(done.stderr.split("\n")[-2].split())


def test_a_bundle_is_made_without_a_desktops_libraries(tmp_path: Path):
    """The recipe's without stages, and who taught it; three sweeps of something else are told."""
    forbidden = {"torch", "sklearn", "pandas", "h5py", "joblib", "matplotlib", "skl2onnx", "aeon"}
    sweeps = easy(12)
    plain = replace(
        sweeps,
        samples=np.concatenate([sweeps.samples, np.roll(sweeps.samples[:3], 1, axis=2)]),
        labels=np.append(sweeps.labels, [3, 3, 3]),
        materials=(*sweeps.materials, NOT_THIS),
        groups={"recording": np.arange(len(sweeps) + 3)},
    )
    lessons.write(tmp_path / "sweeps", plain)
    code, (assessed,), loaded = ran(tmp_path / "sweeps")
    assert code == 0
    assert assessed["type"] == "assessed"
    assert not loaded & forbidden
    out = tmp_path / "bundle"
    code, lines, loaded = ran(
        tmp_path / "sweeps", "--out", out, "--by", "anna", "--at", "today", "--memory-mb", "700"
    )
    assert code == 0, lines
    assert not loaded & forbidden
    assert [one.get("step") for one in lines[:-1]] == ["features", "heads", "bundle"]
    made = bundle.load(out)
    held = {"high": 12, "low": 12, "middle": 12}
    assert made.manifest.made["taught"] == {"by": "anna", "at": "today", "sweeps": held}
    box = Classifier(made, SystemClock())
    box.self_test()
    lesson = Lesson.read(tmp_path / "sweeps")
    fit = recipe.fit(lesson.sweeps, Run(0), recipe.Settings())
    assert made.manifest.made["chosen"] == fit.about["chosen"]
    assert made.manifest.known
    assert made.manifest.figures[FIGURES][NOT_THIS] == 3
    assert lines[-1]["peak_mb"] < 700


@pytest.mark.parametrize(("materials", "each", "why"), [(1, 6, "'high'"), (3, 2, "'high' has 2")])
def test_too_little_is_refused_with_the_remedy(tmp_path: Path, materials: int, each: int, why: str):
    """One material, or too few sweeps of one: no bundle, and the reason on a line."""
    sweeps = easy(each)
    lessons.write(tmp_path / "sweeps", sweeps.take(sweeps.labels >= 3 - materials))
    code, lines, _ = ran(tmp_path / "sweeps", "--out", tmp_path / "bundle")
    assert code
    assert why in lines[-1]["text"]
    assert not (tmp_path / "bundle").exists()


def materials(kinds: int, each: int, spread: float) -> Dataset:
    """Sweeps of materials whose pitches lie apart by `spread` periods per frame."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(kinds), each)
    pitch = 0.15 + spread * labels * rng.uniform(0.98, 1.02, kinds * each)
    phase = 2 * np.pi * (pitch[:, None] * np.arange(64) + rng.random((kinds * each, 1)))
    level = rng.uniform(80, 120, (kinds * each, 1, 2, 2))
    samples = level + 12 * np.sin(phase)[:, :, None, None]
    samples = samples + 2 * rng.standard_normal((*samples.shape[:2], 2, 2))
    names = tuple(f"material {k}" for k in range(kinds))
    groups = {"recording": np.arange(kinds * each)}
    return Dataset(samples.astype(np.uint8), labels, names, 100.0, groups, "materials")


def test_materials_that_chance_would_name_as_well_are_refused(tmp_path: Path):
    """One material under two names: no bundle is made, and the reason says what to do."""
    lessons.write(tmp_path / "sweeps", materials(2, 8, 0.0))
    code, lines, _ = ran(tmp_path / "sweeps", "--out", tmp_path / "bundle")
    assert code
    assert "material 0, material 1" in lines[-1]["text"]
    assert "as one" in lines[-1]["text"]
    assert not (tmp_path / "bundle").exists()


@pytest.mark.thorough  # a fit of minutes
def test_forty_materials_are_a_bundle(tmp_path: Path):
    """With three sweeps of each: all of them are its labels, and it says how often it is right."""
    lessons.write(tmp_path / "sweeps", materials(40, 3, 0.008))
    code, lines, _ = ran(tmp_path / "sweeps", "--out", tmp_path / "bundle")
    assert code == 0, lines
    assert len(lines[-1]["labels"]) == 40
    assert lines[-1]["figures"]["held-out recording"]["n"] == 120
    assert len(bundle.load(tmp_path / "bundle").manifest.labels) == 40


@pytest.mark.thorough  # a fit with all checks of an export
def test_a_full_disk_leaves_no_bundle(tmp_path: Path):
    """The model does not fit: the reason is on a line, and nothing is left."""
    lessons.write(tmp_path / "sweeps", easy(8))
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
    done = run(limit + WATCHED, tmp_path / "sweeps", "--out", tmp_path / "bundle")
    assert done.returncode
    assert "be written" in json.loads(done.stdout.splitlines()[-1])["text"]
    assert [path.name for path in tmp_path.iterdir()] == ["sweeps"]


@pytest.mark.parametrize(
    ("free_mb", "limit_mb", "why"), [(4000, 100, "100 MB"), (50, 768, "50 MB"), (50, 0, "50 MB")]
)
def test_too_little_memory_is_said_before_numpy_is_loaded(
    tmp_path: Path, free_mb: int, limit_mb: int, why: str
):
    """A library that is loaded without room may ask for memory for ever, so nothing is loaded."""
    looked = dedent("""
    import sys
    from pathlib import Path
    from palpate_train.teach import __main__ as teach
    from palpate_train.data.run import Run
    teach.MEMINFO = Path(sys.argv.pop())
    code = teach.main(sys.argv[1:])
    sys.exit(9 if "numpy" in sys.modules else code)
    """)
    (tmp_path / "meminfo").write_text(f"MemFree: 3 kB\nMemAvailable: {free_mb << 10} kB\n")
    done = run(looked, tmp_path, "--memory-mb", limit_mb, tmp_path / "meminfo")
    assert done.returncode == 1, done.stderr
    assert json.loads(done.stdout)["type"] == "error"
    assert why in json.loads(done.stdout)["text"]


def test_imports_that_spin_are_ended_by_the_kernel(tmp_path: Path):
    """Their processor time is limited, whatever the library does; whoever started it says so."""
    code = (
        "from palpate_train.teach import __main__ as teach\n"
        "def spin(args):\n    while True: pass\n"
        "teach.LOAD_CPU_S, teach._run = 1, spin\n"
        f"teach.main([{str(tmp_path)!r}])"
    )
    process = TeachingProcess([sys.executable, "-c", code], 300, SystemClock())
    found: list[dict[str, Any]] = []
    while not process.ended:
        found += process.news()
        time.sleep(0.05)
    assert found[-1]["type"] == "error"
    assert "processor" in found[-1]["text"]

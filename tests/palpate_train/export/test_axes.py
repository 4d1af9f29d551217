"""A skin with three axes from a set to the box: fit, export, the same answers, replay."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.cli.main import main as palpate
from palpate.core.clock import SystemClock
from palpate.core.types import SweepFormat
from palpate.inference.classifier import Classifier
from palpate.sim import devices, rig, script
from palpate.sweeps.black_box import BlackBox
from palpate.sweeps.capture import CaptureWriter
from palpate_train.cli.main import main
from palpate_train.metrics import bundle_score
from tests.factories.sheared import PITCH_MM, sheared
from tests.factories.simulated_box import Rigged


@pytest.mark.slow
@pytest.mark.parametrize(
    "size",
    [
        pytest.param((), id="chosen", marks=pytest.mark.thorough),
        pytest.param(("--size", "stages", "--stages", "60"), id="stages"),
    ],
)
def test_from_a_set_to_the_answers_of_the_box(
    rigged: Callable[..., Rigged],
    size: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    """By command, over the wire, and replayed, as on the desktop."""
    sheared().save(tmp_path / "set.npz")
    fit, out = str(tmp_path / "fit.npz"), tmp_path / "bundle"
    assert (
        main(["fit", "--set", str(tmp_path / "set.npz"), "--seed", "1", "--out", fit, *size]) == 0
    )
    export = f"export {fit} --out {out} --name sheared --version 1 --full-scale 2047".split()
    assert main([*export, "--pitch-mm", str(PITCH_MM)]) == 0
    model = bundle.load(out)
    assert model.format == SweepFormat(2, 2, 750.0, 600, "int16", axes=3)
    assert model.manifest.thresholds.full_scale == 2047
    assert model.manifest.contact
    assert np.abs(np.array(model.manifest.contact.cols_mm) - PITCH_MM / 2).max() < 2
    unseen = sheared(1, seed=6).take(np.arange(0, 54, 3))
    unseen.save(tmp_path / "unseen.npz")
    answers, _ = bundle_score.labels_of(Classifier(model, SystemClock()), unseen)
    labels = [model.manifest.labels[k] if k >= 0 else "" for k in answers]
    assert (
        np.mean([a == unseen.materials[k] for a, k in zip(labels, unseen.labels, strict=True)])
        > 0.5
    )  # by chance a sixth
    acts = list(script.named(f"replay:{tmp_path / 'unseen.npz'}", model.format, 0)[0])
    simulated = devices.build(model.format, acts, rig.VirtualClock(), "replay")
    kept = BlackBox(tmp_path / "kept", model.format, len(acts))
    capture = CaptureWriter(tmp_path / "capture", model.format)
    box = rigged(simulated, model=model, observers=[kept], capture=capture)
    verdicts = box.until(lambda: simulated.finished(box.box.answered), limit_s=300)
    kept.close()
    capture.close()
    assert [v.label for v in verdicts] == labels
    capsys.readouterr()
    choose = ["--set", f"classifier.bundle={out}"]
    assert palpate(["replay", str(tmp_path / "capture"), *choose]) == 0
    sentences = [
        line.split(",") for line in capsys.readouterr().out.splitlines() if ",RES," in line
    ]
    assert [fields[5] for fields in sentences] == labels
    assert palpate(["replay", str(tmp_path / "kept"), *choose]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{len(acts)} sweeps: {len(acts)} the same"


@pytest.mark.slow
@pytest.mark.thorough  # a whole demo
def test_the_demo_slides_a_skin_that_feels_shear(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """With a bundle of three axes `palpate demo` simulates shear, and names most tubes."""
    fit, out = str(tmp_path / "fit.npz"), str(tmp_path / "bundle")
    given = f"fit --set sim:T-REALx3/level-blind:1001:1 --seed 1 --out {fit} --size bands"
    assert main(given.split()) == 0
    assert main(["export", fit, "--out", out, "--name", "shear", "--version", "1"]) == 0
    capsys.readouterr()
    asked = f"demo --sim skin --virtual --seed 3 --sweeps 12 --set classifier.bundle={out}"
    assert palpate(asked.split()) == 0
    shown = capsys.readouterr().out
    assert shown.count("-> ") == 12
    assert shown.count("✓") >= 8
    assert "  frames lost     0 of " in shown

"""A skin that reads thousands without contact, from its recording to the box."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.types import Status, SweepFormat, Verdict
from palpate.sim import devices, rig, skin
from palpate.sweeps.recording import Labels, RecordingSession
from palpate_train.cli.main import main
from tests.factories.simulated_box import Rigged
from tests.factories.skins.sweeps import SCALES, view

FORMAT = SweepFormat(4, 4, 100.0, 200, "uint16", 3)
SEEN, REST = view("xela-can", FORMAT), SCALES["xela-can"].rest
MATERIALS = "metal", "plastic rough"
PLACES = skin.placements("T-REAL", 3)[:4]
EACH = 3


def act(
    material: str, place: skin.Placement | None, rng: np.random.Generator, more: int = 0
) -> rig.Act:
    """Three seconds between half seconds without contact. more: above the usual rest."""
    off = SEEN.idle(50, rng, skin.WORLD)
    on = SEEN.idle(320, rng, skin.WORLD)
    if place:
        on = SEEN.sweep(material, place, rng, skin.WORLD, rest_s=0.1, slide_s=3.0, after_s=0.1)
    return rig.Act(np.concatenate([off, on, off]) + np.uint16(more), 60, 360, material)


def answered(
    rigged: Callable[..., Rigged], acts: Sequence[rig.Act], **how: object
) -> list[Verdict]:
    """The answers of a box whose robot plays these acts."""
    simulated = devices.build(FORMAT, acts, rig.VirtualClock(), "sim")
    if folder := how.pop("folder", None):
        session = RecordingSession(
            folder, FORMAT, how.pop("labels"), simulated.clock, lambda line: None
        )
        how = {"observers": [session], "commands": session.commands}
    box = rigged(simulated, **how)
    return box.until(lambda: simulated.finished(box.box.answered), limit_s=300)


@pytest.fixture
def folder(rigged: Callable[..., Rigged], tmp_path: Path) -> Path:
    """Recordings of two tubes at four positions."""
    rng, whole = np.random.default_rng(1), tmp_path / "sweeps"
    for number, place in enumerate(PLACES):
        for material in MATERIALS:
            to = whole / f"{material} {number}"
            to.mkdir(parents=True)
            acts = [act(material, place, rng) for _ in range(EACH)]
            verdicts = answered(rigged, acts, folder=to, labels=Labels(material, str(number)))
            assert [(v.status, v.detail) for v in verdicts] == [(Status.RECORDED, "")] * EACH
    return whole


@pytest.mark.slow
@pytest.mark.thorough  # a whole way to a bundle
def test_the_whole_way(
    rigged: Callable[..., Rigged], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """record, fit, export, box: an untouched window is `no-contact`, a touched one has its label
    and is in place. A skin with another rest works after TARE. Without an unloaded skin in the
    recordings, export says that `no-contact` cannot be recognised, and the box never answers it."""

    def exported(source: Path, out: Path) -> bundle.Bundle:
        """The bundle of a set, by command."""
        fit = str(out.with_suffix(".npz"))
        assert main(["fit", "--set", str(source), "--seed", "1", "--out", fit]) == 0
        assert (
            main(
                [
                    "export",
                    fit,
                    "--out",
                    str(out),
                    "--name",
                    "x",
                    "--version",
                    "1",
                    "--pitch-mm",
                    "4",
                ]
            )
            == 0
        )
        return bundle.load(out)

    model = exported(folder, tmp_path / "known")
    assert "no-contact cannot" not in capsys.readouterr().out
    m = model.manifest
    assert m.tare == pytest.approx(np.full(FORMAT.shape, REST), abs=40)
    assert m.contact
    assert m.thresholds.contact < 0.2 * REST
    rng = np.random.default_rng(5)
    touched = [act(material, place, rng) for place in PLACES[:2] for material in MATERIALS]
    verdicts = answered(rigged, [act("", None, rng), *touched], model=model)
    assert verdicts[0].status is Status.NO_CONTACT
    assert sum(v.label == a.label for v, a in zip(verdicts[1:], touched, strict=True)) >= 3
    assert Status.NO_CONTACT not in [v.status for v in verdicts[1:]]
    assert sum(not v.displacement for v in verdicts[1:]) >= 3

    more = 4000
    simulated = devices.build(
        FORMAT, [act("", None, rng, more), act("", None, rng, more)], rig.VirtualClock(), "sim"
    )
    box = rigged(simulated, model=model)
    (before,) = box.until(lambda: box.box.answered == 1)
    assert before.status is not Status.NO_CONTACT
    assert box.ask("$PPLP,TARE").startswith("$PPLP,ANS,TARE,ok,")
    (after,) = box.until(lambda: box.box.answered == 2)
    assert after.status is Status.NO_CONTACT

    for path in folder.rglob("*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"unloaded": None}))
    capsys.readouterr()
    model = exported(folder, tmp_path / "unknown")
    said = capsys.readouterr().out.splitlines()
    (line,) = [line for line in said if line.startswith("no-contact cannot")]
    assert "send TARE" in line
    assert (model.manifest.thresholds.contact, model.manifest.contact, model.manifest.unloaded) == (
        None,
        None,
        (),
    )
    (verdict,) = answered(rigged, [act("", None, rng)], model=model)
    assert verdict.status is not Status.NO_CONTACT

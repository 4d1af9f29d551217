"""A skin that reads thousands without contact, from its recording to the box: what nothing touches
is `no-contact`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appliance.bundle import bundle
from appliance.core.types import Status, SweepFormat, Verdict
from appliance.recording.recording import Labels, RecordingSession
from appliance.sim import devices, rig, skin
from appliance.sim.skins.sweeps import SCALES, view
from tests.factories.simulated_box import Rigged
from train.cli.main import main
from train.data.sets import Dataset
from train.export import contact_limit

FORM = SweepFormat(4, 4, 100.0, 200, "uint16", 3)
SEEN, REST = view("xela-can", FORM), SCALES["xela-can"].rest
MATERIALS = "metal", "plastic rough"
PLACES = skin.placements("T-REAL", 3)[:4]
EACH = 3


def act(
    material: str, place: skin.Placement | None, rng: np.random.Generator, more: int = 0
) -> rig.Act:
    """A sweep of three seconds between half seconds without contact; without a place nothing is
    touched. more: counts that the skin reads above its usual rest."""
    off = SEEN.idle(50, rng, skin.WORLD)
    on = SEEN.idle(320, rng, skin.WORLD)
    if place:
        on = SEEN.sweep(material, place, rng, skin.WORLD, rest_s=0.1, slide_s=3.0, after_s=0.1)
    return rig.Act(np.concatenate([off, on, off]) + np.uint16(more), 60, 360, material)


def answered(
    rigged: Callable[..., Rigged], acts: Sequence[rig.Act], **how: object
) -> list[Verdict]:
    """The answers of a box whose robot plays these acts."""
    simulated = devices.build(FORM, acts, rig.VirtualClock(), "sim")
    if folder := how.pop("folder", None):
        session = RecordingSession(
            folder, FORM, how.pop("labels"), simulated.clock, lambda line: None
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


def exported(source: Path, out: Path) -> bundle.Bundle:
    """The bundle of a set, by command."""
    fit = str(out.with_suffix(".npz"))
    assert main(["fit", "--set", str(source), "--seed", "1", "--steps", "0", "--out", fit]) == 0
    assert (
        main(["export", fit, "--out", str(out), "--name", "x", "--version", "1", "--pitch-mm", "4"])
        == 0
    )
    return bundle.load(out)


@pytest.mark.slow
def test_the_whole_way(
    rigged: Callable[..., Rigged], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """record, fit, export, box: an untouched window is `no-contact`, a touched one has its label
    and is in place. A skin that rests elsewhere today is so after TARE. Without what the recordings
    know of the unloaded skin, export says that `no-contact` cannot be told, and the box never
    does."""
    model = exported(folder, tmp_path / "known")
    assert "no-contact cannot be told" not in capsys.readouterr().out
    m = model.manifest
    assert m.tare == pytest.approx(np.full(FORM.shape, REST), abs=40)
    assert m.place
    assert m.thresholds.contact < 0.2 * REST
    rng = np.random.default_rng(5)
    touched = [act(material, place, rng) for place in PLACES[:2] for material in MATERIALS]
    verdicts = answered(rigged, [act("", None, rng), *touched], model=model)
    assert verdicts[0].status is Status.NO_CONTACT
    assert sum(v.label == a.label for v, a in zip(verdicts[1:], touched, strict=True)) >= 3
    assert Status.NO_CONTACT not in [v.status for v in verdicts[1:]]
    assert sum(not v.moved for v in verdicts[1:]) >= 3

    more = 4000
    simulated = devices.build(
        FORM, [act("", None, rng, more), act("", None, rng, more)], rig.VirtualClock(), "sim"
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
    (line,) = [
        line
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("no-contact cannot be told: ")
    ]
    assert (
        "what the unloaded skin gives is not known; record with palpate record, and send TARE"
        in line
    )
    assert (model.manifest.thresholds.contact, model.manifest.place, model.manifest.unloaded) == (
        None,
        None,
        (),
    )
    (verdict,) = answered(rigged, [act("", None, rng)], model=model)
    assert verdict.status is not Status.NO_CONTACT


def known(drift: float = 0.0, load: float = 1000.0) -> Dataset:
    """Eight sweeps [50, 2, 2] whose strongest taxel reads `load` above the unloaded skin, which
    rises by `drift` from each to the next."""
    rng, n = np.random.default_rng(7), 8
    rest = REST + drift * np.arange(n).reshape(-1, 1, 1, 1)
    samples = rest + rng.normal(0, 3, (n, 50, 2, 2))
    samples[:, :, 0, 0] += load
    unloaded = np.concatenate(
        [np.broadcast_to(rest, (n, 1, 2, 2)), np.full((n, 1, 2, 2), 3.0)], axis=1
    )
    return Dataset(
        np.rint(samples).astype(np.uint16),
        np.arange(n) % 2,
        ("a", "b"),
        50.0,
        {},
        "known",
        unloaded,
    )


def test_a_load_is_above_the_unloaded_skin():
    """A tenth of the weakest contact; at least what the unloaded skin differs by, between
    recordings and by its noise. Sweeps of which it is not known do not count."""
    found = contact_limit.find(known())
    assert found.contact == pytest.approx(100, abs=1)
    assert found.tare.tolist() == np.full((2, 2), REST).tolist()
    assert contact_limit.find(known(load=100)).contact == 5 * 3.0
    assert contact_limit.find(known(drift=40)).contact == pytest.approx(3.5 * 40 + 5 * 3)
    some = known()
    some.samples[0] = round(REST)
    some.unloaded[0] = np.nan
    assert contact_limit.find(some).contact == pytest.approx(100, abs=1)


@pytest.mark.parametrize(
    "how", [{"load": 12.0}, {"drift": 400.0}, {"load": -1000.0}], ids=["weak", "drift", "falling"]
)
def test_what_does_not_separate_is_said(how: dict[str, float]):
    """Contacts as weak as noise, a rest that moves by more than a contact, counts that fall: no
    threshold, and why."""
    found = contact_limit.find(known(**how))
    assert found.contact is None
    assert not found.tare.any()
    assert re.fullmatch(
        r"the weakest sweep reads -?[\d.]+ counts above .* differs by up to [\d.]+; send TARE .*",
        found.why,
    )


def test_a_baseline_of_which_nothing_is_known_is_said():
    """Where counts can be loads they are taken for them, as ever; where no taxel is ever near 0
    nothing is guessed. One taxel alone has none to compare it with."""
    high = replace(known(), unloaded=None)
    found = contact_limit.find(high)
    assert found.contact is None
    assert "no taxel reads less than 199" in found.why
    assert "; record with palpate record, and send TARE" in found.why
    every = np.full_like(known().unloaded, np.nan)
    assert contact_limit.find(replace(high, unloaded=every)).why == found.why
    low = replace(high, samples=high.samples - np.uint16(REST - 100))
    assert contact_limit.find(low).contact == pytest.approx(110, abs=1)
    one = replace(high, samples=high.samples[:, :, :1, :1])
    assert contact_limit.find(one).contact == pytest.approx((REST + 1000) / 10, rel=0.01)

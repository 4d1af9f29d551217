"""Kept sweeps classified again: the same verdict bit for bit, and each way in which it can
differ."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.bundle.manifest import Early
from palpate.core import config
from palpate.core.errors import FormatError
from palpate.core.types import Frames, Status, Sweep, load, save, sidecar
from palpate.inference.classifier import Classifier
from palpate.inference.early_exit import EarlyExit
from palpate.runtime.replay import replay
from palpate.signal.broken_taxels import Bridging, BrokenTaxels
from palpate.sim import devices, rig, script, skin
from palpate.sweeps.black_box import BlackBox
from tests.factories import toy_bundle
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import Rigged

SWEEPS = 30
PER_OBJECT = 3
HERE = config.load(None, site=NO_SITE)
OTHERWISE = config.load(
    None, ("classifier.fuse=vote", "classifier.min_probability=1"), site=NO_SITE
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Cache of the recorded folder and sentences for all tests."""
    return {"folder": tmp_path_factory.mktemp("kept")}


@pytest.fixture
def in_service(
    run: dict[str, Any], rigged: Callable[..., Rigged], tmp_path: Path
) -> tuple[Path, list[str]]:
    """A copy of a folder of 30 sweeps, some answered early; and the sentences that were sent. Five
    sweeps of each material, NEW OBJECT before each third sweep: some objects are of two materials,
    and end with the first."""
    if "heard" not in run:
        in_runs = sorted(script.tubes(1020, SWEEPS), key=lambda act: act.label)
        acts = [replace(act, new_object=i % PER_OBJECT == 0) for i, act in enumerate(in_runs)]
        simulated = devices.build(skin.FORMAT, acts, rig.VirtualClock(), "replay")
        black_box = BlackBox(run["folder"], skin.FORMAT, SWEEPS)
        box = rigged(
            simulated,
            sets=("classifier.early=true", "classifier.min_probability=0.9999"),
            observers=[black_box],
        )
        box.until(lambda: simulated.finished(box.box.answered), limit_s=300)
        black_box.close()
        run["heard"] = [line for line in box.heard if ",RES," in line]
    return Path(shutil.copytree(run["folder"], tmp_path / "kept")), run["heard"]


def played(
    path: Path, model: bundle.Bundle, settings: config.Config = HERE
) -> tuple[int, list[str], list[str]]:
    """Exit code, sentences, and the outcome of each sweep."""
    printed: list[str] = []
    code = replay(path, settings, model, printed.append)
    lines = "".join(printed).splitlines()
    return (
        code,
        [line for line in lines if line.startswith("$")],
        [line for line in lines if line[0] != "$"],
    )


def change(path: Path, **values: object) -> None:
    """Write other values into a sidecar."""
    beside = path.with_suffix(".json")
    beside.write_text(json.dumps(json.loads(beside.read_text()) | values))


@pytest.mark.slow
def test_all_verdicts_are_the_same_bit_for_bit(in_service, default_bundle: bundle.Bundle):
    """With any present settings, fused and early answers give the sentences that were sent,
    including times."""
    folder, heard = in_service
    abouts = [sidecar(path) for path in sorted(folder.glob("*.npy"))]
    assert max(about["verdict"]["fused"] for about in abouts) == PER_OBJECT
    assert any("another object: " in about["verdict"]["detail"] for about in abouts)
    assert 3 < sum(about["share"] < 1 for about in abouts) < SWEEPS - 3
    code, sentences, outcomes = played(folder, default_bundle, OTHERWISE)
    assert code == 0
    assert sentences == heard
    assert outcomes == [f"sweep-{n:06d}.npy: the same" for n in range(1, SWEEPS + 1)] + [
        "30 sweeps: 30 the same"
    ]


@pytest.mark.slow
def test_one_sweep_is_judged_after_those_of_its_object(in_service, default_bundle: bundle.Bundle):
    """A single file is fused with the earlier sweeps of its object alone."""
    folder, heard = in_service
    change(
        folder / "sweep-000002.npy", bundle="0badcafe"
    )  # of the first object; it would end the others' replay
    for n in (1, 11, 30):
        code, sentences, outcomes = played(folder / f"sweep-{n:06d}.npy", default_bundle)
        assert (code, sentences) == (0, [heard[n - 1]])
        assert outcomes == [f"sweep-{n:06d}.npy: the same"]


def test_sweeps_whose_object_is_cut_off_are_compared_by_themselves(
    in_service, default_bundle: bundle.Bundle
):
    """The black box has removed an object's first sweep: the scores of the others are compared by
    themselves, and the output says so."""
    folder, _ = in_service
    counts = {
        n: sidecar(folder / f"sweep-{n:06d}.npy")["verdict"]["fused"] for n in range(1, SWEEPS + 1)
    }
    threes = [
        n for n in counts if counts[n] == PER_OBJECT
    ]  # the last sweeps of objects of which all were fused
    for n in (threes[0] - 2, threes[1] - 1):  # of one the first is gone, of another the second
        (folder / f"sweep-{n:06d}.npy").unlink()
    fused = [threes[0] - 1, threes[0], threes[1]]
    code, _, outcomes = played(folder, default_bundle)
    assert code == 0
    alone = [
        line.split(":")[0] for line in outcomes if "the same by itself (earlier sweeps" in line
    ]
    assert alone == [f"sweep-{n:06d}.npy" for n in fused]
    own = sidecar(folder / f"sweep-{fused[0]:06d}.npy")["verdict"]
    change(
        folder / f"sweep-{fused[0]:06d}.npy",
        verdict=own | {"own": [np.nextafter(own["own"][0], 2), *own["own"][1:]]},
    )
    code, _, outcomes = played(folder, default_bundle)
    assert code == 1
    assert next(line for line in outcomes if "DIFFERENT" in line).startswith(
        f"sweep-{fused[0]:06d}.npy"
    )


def test_an_early_answer_that_only_earlier_sweeps_made_sure(tmp_path: Path):
    """Without the earlier sweeps the answer would not be early: the scores are compared, and no
    sentence is written."""
    model = toy_bundle.load(
        tmp_path / "bundle", early=Early((0.5,) * 3, 1), outputs=("logits", "embedding", "early")
    )
    classifier = Classifier(model, rig.VirtualClock(), min_probability=0.97)
    whole = toy_bundle.sweep(2.5, 0.5, object=1)
    frames = Frames(
        *(values[:10] for values in (whole.frames.t_ns, whole.frames.seq, whole.frames.taxels))
    )
    early = replace(whole, id=2, frames=frames, share=0.5)
    verdicts = classifier(whole), EarlyExit(classifier)(early)
    assert [(str(v.status), v.fused) for v in verdicts] == [("unsure", 1), ("ok", 2)]
    for sweep, verdict in zip((whole, early), verdicts, strict=True):
        about = {"rule": classifier.rule, "bundle": model.id, "verdict": verdict.as_dict()}
        save(tmp_path / f"sweep-{sweep.id:06d}.npy", sweep, toy_bundle.FORMAT, about)
    assert played(tmp_path, model)[2][-1] == "2 sweeps: 2 the same"
    (tmp_path / "sweep-000001.npy").unlink()
    code, sentences, outcomes = played(tmp_path, model)
    assert (code, sentences) == (0, [])
    assert outcomes[-1] == "1 sweeps: 1 the same by itself"


@pytest.mark.parametrize("conflict", ["new", "refuse", "fuse"])
def test_objects_end_in_a_replay_as_they_did(tmp_path: Path, conflict: str):
    """NEW OBJECT once, then sweeps that contradict, a pause, and more than max_sweeps: the same
    verdicts. With any sweep missing, the sweeps that depended on it are compared by themselves."""
    model = toy_bundle.load(tmp_path / "bundle")
    it = Classifier(model, rig.VirtualClock(), max_sweeps=3, conflict=conflict, object_s=60.0)
    folder, start_s, statuses = tmp_path / "kept", 0, []
    folder.mkdir()
    for n, letter in enumerate("aabbbbab aba?aab", 1):
        start_s += 100 if letter == " " else 10
        z = {"a": (0, 0), "b": (6, 0), " ": (0, 0), "?": (30, 30)}[letter]
        sweep = toy_bundle.sweep(*z, number=n, object=1)
        sweep = replace(sweep, start_ns=start_s * 10**9, stop_ns=start_s * 10**9 + 1)
        verdict = it(sweep)
        statuses.append(str(verdict.status))
        about = {"rule": it.rule, "bundle": model.id, "verdict": verdict.as_dict()}
        save(folder / f"sweep-{n:06d}.npy", sweep, toy_bundle.FORMAT, about)
    assert statuses.count("unknown") == 1
    assert ("conflict" in statuses) == (conflict == "refuse")
    code, _, outcomes = played(folder, model)
    assert (code, outcomes[-1]) == (0, "16 sweeps: 16 the same")
    for missing in folder.glob("*.npy"):
        rest = Path(shutil.copytree(folder, tmp_path / missing.stem))
        (rest / missing.name).unlink()
        code, _, outcomes = played(rest, model)
        assert code == 0
        last = missing.stem.endswith("16") or missing.stem.endswith("13")
        assert ("the same by itself" in outcomes[-1]) != last
        if (conflict, missing.stem) == ("new", "sweep-000002"):  # the third begins another object
            assert outcomes[-1] == "15 sweeps: 14 the same, 1 the same by itself"


def test_every_other_bit_is_told(in_service, default_bundle: bundle.Bundle):
    """For a score one bit off, another label or another tare the output names the difference, and
    the exit code is 1."""
    folder, _ = in_service
    verdict = sidecar(folder / "sweep-000001.npy")["verdict"]
    change(
        folder / "sweep-000001.npy",
        verdict=verdict
        | {"scores": [np.nextafter(verdict["scores"][0], 2), *verdict["scores"][1:]]},
    )
    change(
        folder / "sweep-000002.npy",
        verdict=sidecar(folder / "sweep-000002.npy")["verdict"] | {"label": "velvet"},
    )
    change(folder / "sweep-000004.npy", tare=np.full((4, 4), 200).tolist())
    code, _, outcomes = played(folder, default_bundle)
    assert code == 1
    assert outcomes[0] == "sweep-000001.npy: DIFFERENT (other scores)"
    assert "sweep-000002.npy: DIFFERENT (label 'velvet' is now " in outcomes[1]
    assert "DIFFERENT" in outcomes[3]
    assert outcomes[-1].startswith("30 sweeps: ")


def test_a_changed_byte_is_told(in_service, default_bundle: bundle.Bundle):
    """At any position in the file. The lowest bit of a raw count may change no score, but it
    changes the checksum."""
    folder, _ = in_service
    path = folder / "sweep-000003.npy"
    data = path.read_bytes()
    for at in np.random.default_rng(0).integers(0, len(data), 20):
        changed = bytearray(data)
        changed[at] ^= 1
        path.write_bytes(changed)
        with pytest.raises(FormatError, match="sweep-000003"):
            played(path, default_bundle)
    code, _, outcomes = played(folder, default_bundle)
    assert code == 1
    assert "sweep-000003.npy: not readable" in outcomes[2]
    assert "29 the same" in outcomes[-1] or "the same by itself" in outcomes[-1]


def test_another_bundle_is_named(in_service, tmp_path: Path, default_bundle: bundle.Bundle):
    """For one sweep the error has both ids and says what to try. In a folder the sweeps of the
    bundle are classified, and the others are listed."""
    folder, _ = in_service
    other = replace(default_bundle, id="0badcafe")
    with pytest.raises(
        FormatError,
        match=f"classified by bundle {default_bundle.id}, this is 0badcafe; .*--set "
        "classifier.bundle=DIR",
    ):
        played(folder / "sweep-000001.npy", other)
    code, sentences, outcomes = played(folder, other)
    assert (code, sentences, outcomes[-1]) == (1, [], "30 sweeps: 30 of another bundle")
    change(folder / "sweep-000030.npy", bundle="0badcafe")
    code, _, outcomes = played(folder, default_bundle)
    assert code == 0
    assert (
        "sweep-000030.npy: of another bundle (sweep 30 was classified by bundle 0badcafe"
        in outcomes[-2]
    )
    assert outcomes[-1] == "30 sweeps: 29 the same, 1 of another bundle"


def test_the_next_run_begins_anew(tmp_path: Path):
    """Objects are counted anew in each run: object 1 of a later run in the same folder is not fused
    with object 1 of an earlier run."""
    model = toy_bundle.load(tmp_path / "bundle")
    for n, run in ((1, 0), (2, 1)):
        save(
            tmp_path / f"sweep-{n:06d}.npy",
            toy_bundle.sweep(0, 0, object=1),
            toy_bundle.FORMAT,
            {"run": run},
        )
    _, sentences, outcomes = played(tmp_path, model)
    assert [line.split(",")[8] for line in sentences] == ["1", "1"]
    assert outcomes[-1] == "2 sweeps: 2 no verdict to compare with"


def test_a_sweep_that_is_not_answered_early_any_more(tmp_path: Path):
    """Without an early answer of this bundle the output says so, and no sentence is written."""
    frames = Frames(np.arange(10), np.arange(10), toy_bundle.window(1, 0)[:10])
    early = Sweep(1, 0, 0, Status.OK, frames, share=0.5)
    save(tmp_path / "s.npy", early, toy_bundle.FORMAT)
    kinds = {"does": 0.5, "not": 2.0}
    does, not_ = (
        toy_bundle.load(
            tmp_path / name, early=Early((least,) * 3, 1), outputs=("logits", "embedding", "early")
        )
        for name, least in kinds.items()
    )
    code, (sentence,), _ = played(tmp_path / "s.npy", does)
    assert code == 0
    assert ",ok,a," in sentence
    code, sentences, outcomes = played(tmp_path / "s.npy", not_)
    assert (code, sentences) == (1, [])
    assert outcomes == ["s.npy: DIFFERENT (it was answered early, which this bundle does not do)"]


def test_a_recording_without_a_tare_is_judged_with_the_bundle_s(tmp_path: Path):
    """As the box would do it. A recording with a tare is classified with its own tare."""
    model = toy_bundle.load(tmp_path / "bundle")
    high = replace(model, manifest=replace(model.manifest, unloaded=(1e4,) * 4))
    save(tmp_path / "s.npy", toy_bundle.sweep(0, 0), toy_bundle.FORMAT)
    assert ",ok,a," in played(tmp_path / "s.npy", model)[1][0]
    assert ",no-contact," in played(tmp_path / "s.npy", high)[1][0]
    save(tmp_path / "s.npy", toy_bundle.sweep(0, 0), toy_bundle.FORMAT, {"tare": [[0.0] * 2] * 2})
    assert ",ok,a," in played(tmp_path / "s.npy", high)[1][0]


def test_taxels_that_were_broken_over_the_stream_are_bridged_again(tmp_path: Path):
    """The sidecar names them, and the verdict is the same. Without the entry it differs."""
    rule = Bridging(taxels=1, row=False, column=False, noise=4.0, quietest=2.0, still=False)
    loaded = toy_bundle.load(tmp_path / "bundle")
    model = replace(loaded, manifest=replace(loaded.manifest, bridging=rule))
    it, kinds = Classifier(model, rig.VirtualClock()), np.zeros((2, 2, 2), bool)
    kinds[0, 0, 0] = True
    it.taxels.broken = BrokenTaxels.of(kinds)
    sweep, kept = toy_bundle.sweep(6, 0), tmp_path / "s.npy"
    about = {**it.about(), "verdict": it(sweep).as_dict()}
    save(kept, sweep, toy_bundle.FORMAT, about)
    code, (sentence,), outcomes = played(kept, model)
    assert (code, outcomes) == (0, ["s.npy: the same"])
    assert ",ok,a," in sentence
    assert "degraded: silent taxel 1.1" in sentence
    save(kept, sweep, toy_bundle.FORMAT, {k: v for k, v in about.items() if k != "broken"})
    assert played(kept, model)[0] == 1


@pytest.mark.parametrize(
    ("about", "hint"),
    [
        ({"tare": [[1, 2, 3]]}, "sidecar cannot be used"),
        ({"tare": "heavy"}, "sidecar cannot be used"),
        ({"broken": [[1, 2, 3]]}, "sidecar cannot be used"),
        ({"broken": [[1], [2, 3]]}, "sidecar cannot be used"),
        ({"rule": {"fuse": "product"}}, "sidecar cannot be used"),
        (
            {"rule": {"fuse": "guess", "min_probability": 0.5, "max_sweeps": 0}},
            "sidecar cannot be used",
        ),
        (
            {
                "rule": {
                    "fuse": "vote",
                    "min_probability": 0.5,
                    "max_sweeps": 0,
                    "conflict": "guess",
                    "object_s": 0.0,
                }
            },
            "conflict 'guess' is not one of new, refuse, fuse",
        ),
        ({"rule": 3}, "sidecar cannot be used"),
        ({"run": "first"}, "sidecar cannot be used"),
        ({"verdict": 7}, "sidecar cannot be used"),
        ({"verdict": {"fused": "two"}}, "sidecar cannot be used"),
        ({"verdict": {"after": "two"}}, "sidecar cannot be used"),
        ({"verdict": {"time_ns": None}}, "sidecar cannot be used"),
        ({"verdict": {"time_ns": "now"}}, "sidecar cannot be used"),
    ],
)
def test_sidecars_that_make_no_sense(tmp_path: Path, about: dict[str, object], hint: str):
    """The error names the file and has no traceback."""
    model = toy_bundle.load(tmp_path / "bundle")
    save(tmp_path / "s.npy", toy_bundle.sweep(0, 0), toy_bundle.FORMAT, about)
    with pytest.raises(FormatError, match=f"s.npy: .*{hint}"):
        played(tmp_path / "s.npy", model)


@pytest.mark.parametrize(("n", "share"), [(3, 1.0), (20, 0.5), (0, 0.5), (0, 1.0)])
def test_sweeps_of_another_length(tmp_path: Path, n: int, share: float):
    """Frames that are too few for a window, or too many for an early answer."""
    model = toy_bundle.load(
        tmp_path / "bundle", early=Early((0.5,) * 3, 1), outputs=("logits", "embedding", "early")
    )
    frames = Frames(np.arange(n), np.arange(n), toy_bundle.window(1, 0)[:n])
    save(tmp_path / "s.npy", Sweep(1, 0, 0, Status.OK, frames, share=share), toy_bundle.FORMAT)
    with pytest.raises(FormatError, match=f"has {n} frames"):
        played(tmp_path / "s.npy", model)


def test_a_sweep_without_a_window(tmp_path: Path):
    """Its verdict is its status, as in service."""
    model = toy_bundle.load(tmp_path / "bundle")
    save(
        tmp_path / "s.npy",
        Sweep(1, 0, 0, Status.GAP, Frames.empty(toy_bundle.FORMAT)),
        toy_bundle.FORMAT,
    )
    _, (sentence,), _ = played(tmp_path / "s.npy", model)
    assert ",gap," in sentence


def test_another_skin_and_an_empty_folder(tmp_path: Path, default_bundle: bundle.Bundle):
    """The error has both formats. A folder without sweeps is an error, too."""
    with pytest.raises(FormatError, match="no kept sweep is there"):
        played(tmp_path, default_bundle)
    save(tmp_path / "s.npy", toy_bundle.sweep(0, 0), toy_bundle.FORMAT)
    with pytest.raises(
        FormatError, match=r"2x2 int16 at 100 Hz.*4x4 uint8 at 750 Hz.*classifier.bundle=DIR"
    ):
        played(tmp_path / "s.npy", default_bundle)
    assert load(tmp_path / "s.npy")[1] == toy_bundle.FORMAT

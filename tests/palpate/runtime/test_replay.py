"""Kept sweeps classified again: the same verdict bit for bit, and each difference."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.early import Early
from palpate.answer.taxels import Bridging, BrokenTaxels
from palpate.bundle.bundle import DEFAULT, Bundle
from palpate.core import config
from palpate.core.config import UNTIL_NEW_OBJECT, ClassifierConfig
from palpate.core.errors import FormatError
from palpate.core.sweep_file import save, sidecar
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.deployment import release_trial
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.runtime.replay import changed, main, replay
from palpate.sim import devices, rig, script, skin
from palpate.sweeps.black_box import BlackBox
from tests.factories import toy_bundle
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import Rigged

SWEEPS, PER_OBJECT = 30, 3
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
        sets = ("classifier.early=true", "classifier.min_probability=0.9999")
        box = rigged(simulated, sets=sets, observers=[black_box])
        box.until(lambda: simulated.finished(box.box.answered), limit_s=300)
        black_box.close()
        run["heard"] = [line for line in box.heard if ",RES," in line]
    return Path(shutil.copytree(run["folder"], tmp_path / "kept")), run["heard"]


@pytest.fixture
def toy(tmp_path: Path) -> Bundle:
    """The toy bundle."""
    return toy_bundle.load(tmp_path / "bundle")


def early_toy(folder: Path, least: float = 0.5) -> Bundle:
    """The toy bundle with early answers."""
    outputs = ("logits", "embedding", "early")
    return toy_bundle.load(folder, early=Early((least,) * 3, 1), outputs=outputs)


def played(
    path: Path, model: Bundle, settings: config.Config = HERE
) -> tuple[int, list[str], list[str]]:
    """Exit code, sentences, and the outcome of each sweep."""
    printed: list[str] = []
    code = replay(path, settings, model, printed.append)
    lines = "".join(printed).splitlines()
    told = [line for line in lines if line[0] != "$"]
    return code, [line for line in lines if line[0] == "$"], told


def counted(outcomes: list[str]) -> list[tuple[int, str]]:
    """How many sweeps there were, and how many of them ended how, in one word."""
    found = re.findall(r"(\d+) (?:of |no |the (?:same by )?)?([a-z]+)", outcomes[-1])
    return [(int(n), word) for n, word in found]


def at(folder: Path, number: int) -> Path:
    """The path of a kept sweep."""
    return folder / f"sweep-{number:06d}.npy"


def change(path: Path, **values: object) -> None:
    """Write other values into a sidecar."""
    beside = path.with_suffix(".json")
    beside.write_text(json.dumps(json.loads(beside.read_text()) | values))


def one_bit_off(path: Path, scores: str) -> None:
    """Change the last bit of the first of a verdict's scores."""
    verdict = sidecar(path)["verdict"]
    first, *others = verdict[scores]
    change(path, verdict=verdict | {scores: [np.nextafter(first, 2), *others]})


def keep(folder: Path, it: Classifier, sweep: Sweep, verdict: Verdict) -> None:
    """Store a sweep the way the box does it."""
    about = {"rule": it.rule, "bundle": it.bundle.id, "verdict": verdict.as_dict()}
    save(at(folder, sweep.id), sweep, toy_bundle.FORMAT, about)


def kept_toy(path: Path, sweep: Sweep | None = None, **about: object) -> Path:
    """One sweep of the toy with this sidecar."""
    save(path / "s.npy", sweep or toy_bundle.sweep(0, 0), toy_bundle.FORMAT, about)
    return path / "s.npy"


@pytest.mark.slow
def test_all_verdicts_are_the_same_bit_for_bit(in_service, default_bundle):
    """Fused and early answers, with any present settings."""
    folder, heard = in_service
    abouts = [sidecar(path) for path in sorted(folder.glob("*.npy"))]
    assert max(about["verdict"]["fused"] for about in abouts) == PER_OBJECT
    assert any("another" in about["verdict"]["detail"] for about in abouts)
    assert 3 < sum(about["share"] < 1 for about in abouts) < SWEEPS - 3
    code, sentences, outcomes = played(folder, default_bundle, OTHERWISE)
    assert (code, sentences) == (0, heard)
    assert outcomes[:-1] == [f"{at(folder, n).name}: the same" for n in range(1, SWEEPS + 1)]
    assert counted(outcomes) == [(30, "sweeps"), (30, "same")]


@pytest.mark.slow
def test_one_sweep_is_judged_after_those_of_its_object(in_service, default_bundle):
    """Sweeps of other objects and bundles do not matter."""
    folder, heard = in_service
    change(at(folder, 2), bundle="0badcafe")
    for n in (1, 11, 30):
        told = [f"{at(folder, n).name}: the same"]
        assert played(at(folder, n), default_bundle) == (0, [heard[n - 1]], told)


@pytest.mark.slow
def test_sweeps_whose_object_is_cut_off_are_compared_by_themselves(in_service, default_bundle):
    """And the output says so."""
    folder, _ = in_service
    fused = {n: sidecar(at(folder, n))["verdict"]["fused"] for n in range(1, SWEEPS + 1)}
    one, two, *_ = (n for n, count in fused.items() if count == PER_OBJECT)
    for n in (one - 2, two - 1):
        at(folder, n).unlink()
    code, _, outcomes = played(folder, default_bundle)
    assert code == 0
    alone = [line.split(":")[0] for line in outcomes if "itself (" in line]
    assert alone == [at(folder, n).name for n in (one - 1, one, two)]
    one_bit_off(at(folder, one - 1), "own")
    code, _, outcomes = played(folder, default_bundle)
    assert code == 1
    different = next(line for line in outcomes if "DIFFERENT" in line)
    assert different.startswith(at(folder, one - 1).name)


def test_an_early_answer_that_only_earlier_sweeps_made_sure(tmp_path):
    """Without them: scores are compared, no sentence."""
    model = early_toy(tmp_path / "bundle")
    classifier = Classifier(
        model, rig.VirtualClock(), replace(UNTIL_NEW_OBJECT, min_probability=0.97)
    )
    whole = toy_bundle.sweep(2.5, 0.5, object=1)
    frames = replace(whole.frames, taxels=whole.frames.taxels[:10])
    frames = Frames(whole.frames.t_ns[:10], whole.frames.seq[:10], frames.taxels)
    early = replace(whole, id=2, frames=frames, share=0.5)
    verdicts = classifier(whole), EarlyExit(classifier)(early)
    assert [(str(v.status), v.fused) for v in verdicts] == [("unsure", 1), ("ok", 2)]
    for sweep, verdict in zip((whole, early), verdicts, strict=True):
        keep(tmp_path, classifier, sweep, verdict)
    assert counted(played(tmp_path, model)[2]) == [(2, "sweeps"), (2, "same")]
    at(tmp_path, 1).unlink()
    code, sentences, outcomes = played(tmp_path, model)
    assert (code, sentences, counted(outcomes)[1:]) == (0, [], [(1, "itself")])


@pytest.mark.parametrize(
    "conflict", ["new", *(pytest.param(one, marks=pytest.mark.slow) for one in ("refuse", "fuse"))]
)
def test_objects_end_in_a_replay_as_they_did(tmp_path, toy, conflict):
    """NEW OBJECT once, then sweeps that contradict, a pause, and more than max_sweeps: the same
    verdicts. With any sweep missing, the sweeps that depended on it are compared by themselves."""
    rule = ClassifierConfig(max_sweeps=3, conflict=conflict)
    it = Classifier(toy, rig.VirtualClock(), rule)
    folder, start_s, statuses = tmp_path / "kept", 0, []
    folder.mkdir()
    places = {"a": (0, 0), "b": (6, 0), " ": (0, 0), "?": (30, 30)}
    for n, letter in enumerate("aabbbbab aba?aab", 1):
        start_s += 100 if letter == " " else 10
        sweep = toy_bundle.sweep(*places[letter], number=n, object=1)
        sweep = replace(sweep, start_ns=start_s * 10**9, stop_ns=start_s * 10**9 + 1)
        verdict = it(sweep)
        statuses.append(str(verdict.status))
        keep(folder, it, sweep, verdict)
    assert statuses.count("unknown") == 1
    assert ("conflict" in statuses) == (conflict == "refuse")
    code, _, outcomes = played(folder, toy)
    assert (code, counted(outcomes)[1:]) == (0, [(16, "same")])
    for missing in folder.glob("*.npy"):
        rest = Path(shutil.copytree(folder, tmp_path / missing.stem))
        (rest / missing.name).unlink()
        code, _, outcomes = played(rest, toy)
        assert code == 0
        last = missing.stem.endswith(("16", "13"))
        assert ("itself" in outcomes[-1]) != last
        if (conflict, missing.stem) == ("new", "sweep-000002"):  # the third begins another object
            assert counted(outcomes) == [(15, "sweeps"), (14, "same"), (1, "itself")]


@pytest.mark.parametrize(
    "conflict", ["new", *(pytest.param(one, marks=pytest.mark.slow) for one in ("refuse", "fuse"))]
)
def test_sweeps_that_are_judged_together_are_replayed_so(tmp_path, conflict):
    """Doubtful sweeps (n: known alone, f: not), known and unknown ones. With any sweep missing none
    is called different, and one that was judged with it is compared by itself."""
    rule = ClassifierConfig(max_sweeps=4, conflict=conflict)
    wide = replace(toy_bundle.KNOWN, strict=4.0, loose=25.0)
    model = toy_bundle.load(tmp_path / "bundle", known=wide)
    it, folder = Classifier(model, rig.VirtualClock(), rule), tmp_path / "kept"
    folder.mkdir()
    places = {"a": (0, 0), "b": (6, 0), "n": (0, -2.4), "m": (0, -3.4), "f": (0, -4.4)}
    # y is known by x alone, and begins another object after b and e
    places |= {"e": (4.3, 0), "x": (2.5, 0), "y": (1.7, -2.6)}
    answers, number = [], 0
    for n, letters in enumerate(("fn", "nm", "mnmaf", "afn", "bmn", "anfnm", "bexyn"), 1):
        for letter in letters:
            number += 1
            sweep = toy_bundle.sweep(*places[letter], number=number, object=n)
            sweep = replace(sweep, start_ns=number * 10**10, stop_ns=number * 10**10 + 1)
            answers.append(it(sweep))
            keep(folder, it, sweep, answers[-1])
    assert [one.label for one in answers[:4]] == ["", "", "a", "a"]
    code, _, outcomes = played(folder, model)
    assert (code, counted(outcomes)[1:]) == (0, [(number, "same")])
    for missing in folder.glob("*.npy"):
        rest = Path(shutil.copytree(folder, tmp_path / missing.stem))
        (rest / missing.name).unlink()
        code, _, outcomes = played(rest, model)
        assert code == 0, outcomes
        needed = any(v.after == int(missing.stem[-6:]) for v in answers)
        assert any("sweeps of its object" in line for line in outcomes) == needed


def test_a_difference_is_told_once(tmp_path, toy):
    """Not of the next sweep of the object, too, which was the first that had probabilities."""
    it = Classifier(toy, rig.VirtualClock(), replace(UNTIL_NEW_OBJECT, min_probability=0.9))
    first, second = (toy_bundle.sweep(2.5, 0.5, number=n, object=1) for n in (1, 2))
    failed = Verdict.of(first, Status.FAILED, 0, toy.id, detail="no memory")
    for sweep, verdict in ((first, failed), (second, it(second))):
        keep(tmp_path, it, sweep, verdict)
    code, _, outcomes = played(tmp_path, toy)
    assert (code, outcomes[-1]) == (1, "2 sweeps: 1 DIFFERENT, 1 the same")


def test_every_difference_is_told(in_service, default_bundle):
    """A score one bit off, another label or tare: exit code 1."""
    folder, _ = in_service
    one_bit_off(at(folder, 1), "scores")
    change(at(folder, 2), verdict=sidecar(at(folder, 2))["verdict"] | {"label": "velvet"})
    change(at(folder, 4), tare=np.full((4, 4), 200).tolist())
    code, _, outcomes = played(folder, default_bundle)
    assert code == 1
    for n, told in ((1, "(other scores)"), (2, "(label 'velvet' is now "), (4, "")):
        assert outcomes[n - 1].startswith(f"{at(folder, n).name}: DIFFERENT {told}")
    assert outcomes[-1].startswith("30 sweeps: ")


def read_higher(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """From now on the program reads higher counts."""
    outputs = Classifier.outputs

    def worse(self: Classifier, taxels: np.ndarray, *names: str) -> Any:
        return outputs(self, np.clip(taxels * factor, 0, 255).astype(taxels.dtype), *names)

    monkeypatch.setattr(Classifier, "outputs", worse)


def test_a_release_that_answers_otherwise_is_found_by_the_kept_sweeps(
    in_service, default_bundle, monkeypatch
):
    """The same program changes nothing, nor does a last bit. Counts that are read 10 % too high are
    found. Sweeps of another bundle are left out."""
    folder, _ = in_service
    one_bit_off(at(folder, 4), "own")
    count, found = changed(folder, OTHERWISE, default_bundle)
    assert (count, found) == (SWEEPS, [])
    change(at(folder, 3), bundle="00000000")
    assert changed(folder, OTHERWISE, default_bundle)[0] == SWEEPS - 1
    asked = [str(folder), str(DEFAULT), "0"]
    assert main(asked) == 0
    read_higher(monkeypatch, 1.1)
    assert changed(folder, OTHERWISE, default_bundle)[1]
    assert main(asked) == release_trial.OTHERWISE
    assert changed(folder, OTHERWISE, default_bundle, SWEEPS - 2)[0] == 2
    assert main([*asked[:2], str(SWEEPS)]) == 0


def test_a_release_is_not_blamed_for_sweeps_that_are_missing(tmp_path):
    """Nor for a last bit with them: a sweep that was unknown, another object's, or answered early
    by them alone. Other probabilities are found, and an unknown sweep that has none any more is
    not."""
    wide = replace(toy_bundle.KNOWN, strict=4.0, loose=25.0)
    heads = {"early": Early((0.5,) * 3, 1), "outputs": ("logits", "embedding", "early")}
    model = toy_bundle.load(tmp_path / "bundle", known=wide, **heads)
    rule = ClassifierConfig(conflict="refuse", min_probability=0.97)
    it, folder = Classifier(model, rig.VirtualClock(), rule), tmp_path / "kept"
    folder.mkdir()
    places = ((0, -4.4), (0, -2.4)), ((0, 0), (6, 0)), ((2.5, 0.5), (2.5, 0.5)), ((0, 0), (0, -4.4))
    statuses = []
    for number, (x, y) in enumerate((one for both in places for one in both), 1):
        sweep = toy_bundle.sweep(x, y, number=number, object=(number + 1) // 2)
        if number == 6:
            frames = toy_bundle.frames_of(sweep.frames.taxels[:10])
            sweep = replace(sweep, frames=frames, share=0.5)
        verdict = EarlyExit(it)(sweep) if sweep.share < 1 else it(sweep)
        statuses.append(str(verdict.status))
        keep(folder, it, sweep, verdict)
    given = "unknown, unknown, ok, conflict, unsure, ok, ok, unknown"
    assert ", ".join(statuses) == given
    change(at(folder, 8), verdict=sidecar(at(folder, 8))["verdict"] | {"own": []})
    assert changed(folder, HERE, model) == (8, [])
    for n in (2, 4, 6):
        at(folder, n - 1).unlink()
        one_bit_off(at(folder, n), "own")
    assert changed(folder, HERE, model) == (5, [])
    for n in (2, 4, 6):
        change(at(folder, n), verdict=sidecar(at(folder, n))["verdict"] | {"own": [0.1, 0.8, 0.1]})
    count, found = changed(folder, HERE, model)
    assert count == 5
    assert [one[:13] for one in found] == ["sweep-000002.", "sweep-000004.", "sweep-000006."]


def test_a_release_that_shifts_most_sweeps_a_little_is_found(
    in_service, default_bundle, monkeypatch
):
    """Counts that are read 2 % too high, also where each answer stays; of a few sweeps it is no
    proof."""
    folder, _ = in_service
    read_higher(monkeypatch, 1.02)
    monkeypatch.setattr("palpate.runtime.replay._beyond", lambda was, now: "")
    count, found = changed(folder, OTHERWISE, default_bundle)
    assert count / 2 < len(found) <= count
    assert changed(folder, OTHERWISE, default_bundle, SWEEPS - 4)[1] == []


def test_a_changed_byte_is_told(in_service, default_bundle):
    """Anywhere in the file: by a score, else by the checksum."""
    folder, _ = in_service
    path = at(folder, 3)
    data = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(data), 20):
        changed = bytearray(data)
        changed[place] ^= 1
        path.write_bytes(changed)
        with pytest.raises(FormatError, match="sweep-000003"):
            played(path, default_bundle)
    code, _, outcomes = played(folder, default_bundle)
    assert code == 1
    assert "sweep-000003.npy" in outcomes[2]
    assert re.search("29 the same|by itself", outcomes[-1])


def test_another_bundle_is_named(in_service, default_bundle):
    """Both ids for one sweep; in a folder the others are listed."""
    folder, _ = in_service
    other = replace(default_bundle, id="0badcafe")
    with pytest.raises(FormatError, match=f"{default_bundle.id}.*0badcafe"):
        played(at(folder, 1), other)
    code, sentences, outcomes = played(folder, other)
    assert (code, sentences, counted(outcomes)[1:]) == (1, [], [(30, "another")])
    change(at(folder, 30), bundle="0badcafe")
    code, _, outcomes = played(folder, default_bundle)
    assert code == 0
    assert re.match(r"sweep-000030.*0badcafe", outcomes[-2])
    assert counted(outcomes)[1:] == [(29, "same"), (1, "another")]


def test_the_next_run_begins_anew(tmp_path, toy):
    """Object 1 of a later run is not fused with that of an earlier one."""
    for n, run in ((1, 0), (2, 1)):
        save(at(tmp_path, n), toy_bundle.sweep(0, 0, object=1), toy_bundle.FORMAT, {"run": run})
    _, sentences, outcomes = played(tmp_path, toy)
    assert [line.split(",")[8] for line in sentences] == ["1", "1"]
    assert counted(outcomes) == [(2, "sweeps"), (2, "verdict")]


def test_a_sweep_that_is_not_answered_early_any_more(tmp_path):
    """Without an early answer of this bundle the output says so, and no sentence is written."""
    frames = Frames(np.arange(10), np.arange(10), toy_bundle.window(1, 0)[:10])
    path = kept_toy(tmp_path, Sweep(1, 0, 0, Status.OK, frames, share=0.5))
    code, (sentence,), _ = played(path, early_toy(tmp_path / "does"))
    assert code == 0
    assert ",ok,a," in sentence
    code, sentences, outcomes = played(path, early_toy(tmp_path / "not", 2.0))
    assert (code, sentences) == (1, [])
    assert "answered" in outcomes[0]


def test_a_recording_without_a_tare_is_judged_with_the_bundle_s(tmp_path, toy):
    """Else by its own; no window: its status."""
    high = replace(toy, manifest=replace(toy.manifest, unloaded=(1e4,) * 4))
    bare = kept_toy(tmp_path)
    assert ",ok,a," in played(bare, toy)[1][0]
    assert ",no-contact," in played(bare, high)[1][0]
    assert ",ok,a," in played(kept_toy(tmp_path, tare=[[0.0] * 2] * 2), high)[1][0]
    gap = Sweep(1, 0, 0, Status.GAP, Frames.empty(toy_bundle.FORMAT))
    assert ",gap," in played(kept_toy(tmp_path, gap), toy)[1][0]


def test_taxels_that_were_broken_over_the_stream_are_bridged_again(tmp_path, toy):
    """The sidecar has them, and the verdict is the same. Without the entry it differs."""
    rule = Bridging(taxels=1, row=False, column=False, noise=4.0, quietest=2.0, still=False)
    model = replace(toy, manifest=replace(toy.manifest, bridging=rule))
    it, kinds = Classifier(model, rig.VirtualClock()), np.zeros((2, 2, 2), bool)
    kinds[0, 0, 0] = True
    it.taxels.broken = BrokenTaxels.of(kinds)
    sweep = toy_bundle.sweep(6, 0)
    about = {**it.about(), "verdict": it(sweep).as_dict()}
    code, (sentence,), outcomes = played(kept_toy(tmp_path, sweep, **about), model)
    assert (code, outcomes) == (0, ["s.npy: the same"])
    assert ",ok,a," in sentence
    assert "1.1" in sentence
    del about["broken"]
    assert played(kept_toy(tmp_path, sweep, **about), model)[0] == 1


RULE = {"fuse": "vote", "min_probability": 0.5, "max_sweeps": 0}


@pytest.mark.parametrize(
    "about",
    [
        {"tare": [[1, 2, 3]]},
        {"tare": "heavy"},
        {"broken": [[1, 2, 3]]},
        {"broken": [[1], [2, 3]]},
        {"rule": {"fuse": "product"}},
        {"rule": RULE | {"fuse": "guess"}},
        {"rule": RULE | {"conflict": "guess", "object_s": 0.0}},
        {"rule": 3},
        {"run": "first"},
        {"verdict": 7},
        {"verdict": {"fused": "two"}},
        {"verdict": {"after": "two"}},
        {"verdict": {"time_ns": None}},
        {"verdict": {"time_ns": "now"}},
    ],
)
def test_sidecars_that_make_no_sense(tmp_path, toy, about):
    """The error has the file and no traceback."""
    with pytest.raises(FormatError, match=r"s\.npy: "):
        played(kept_toy(tmp_path, **about), toy)


@pytest.mark.parametrize(("n", "share"), [(3, 1.0), (20, 0.5), (0, 0.5), (0, 1.0)])
def test_sweeps_of_another_length(tmp_path, n, share):
    """Frames that are too few for a window, or too many for an early answer."""
    frames = Frames(np.arange(n), np.arange(n), toy_bundle.window(1, 0)[:n])
    path = kept_toy(tmp_path, Sweep(1, 0, 0, Status.OK, frames, share=share))
    with pytest.raises(FormatError, match=f"has {n} frames"):
        played(path, early_toy(tmp_path / "bundle"))


def test_another_skin_and_an_empty_folder(tmp_path, default_bundle):
    """The error has both formats. A folder without sweeps is an error, too."""
    with pytest.raises(FormatError, match="sweep"):
        played(tmp_path, default_bundle)
    with pytest.raises(FormatError, match=r"2x2.*4x4"):
        played(kept_toy(tmp_path), default_bundle)


def test_a_name_of_a_file_forges_no_line(tmp_path, default_bundle):
    """Escape sequences and line breaks are shown as one printable line."""
    (tmp_path / "sweep-1\x1b[2J\r\n2 sweeps: 2 the same.npy").touch()
    lines: list[str] = []
    replay(tmp_path, HERE, default_bundle, lines.append)
    assert [line for line in "".join(lines).splitlines() if not line.isprintable()] == []
    assert len(lines) == 2

"""Enrolment: one label more by arithmetic, warnings where sweeps do not serve, a bundle that is whole or not at all."""

from __future__ import annotations

import errno
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appliance.bundle import bundle
from appliance.bundle.bundle import Bundle, Early
from appliance.cli.main import main
from appliance.core import storage
from appliance.core.errors import ApplianceError, BundleError, ConfigError, FormatError
from appliance.core.types import Status
from appliance.inference import enrolment
from appliance.inference.classifier import Classifier
from appliance.inference.novelty import Means
from appliance.sim import devices
from appliance.sim.rig import VirtualClock
from tests.factories import toy_bundle

FELT = [(7.0, 8.0), (8.0, 9.0), (6.5, 7.5), (7.5, 8.5), (6.0, 7.0)]
"""Embeddings of five sweeps; their mean is (7, 8), (6.5, 7.5) and (7.5, 8.5) are the next to it."""


@pytest.fixture
def old(tmp_path: Path) -> Bundle:
    """The toy bundle."""
    return toy_bundle.load(tmp_path / "old")


def digits(*at: tuple[float, float]) -> np.ndarray:
    """Windows [n, T, R, C] with these embeddings."""
    return np.stack([toy_bundle.window(*z) for z in at])


def test_a_label_more_by_arithmetic(old: Bundle, tmp_path: Path):
    """Mean, bias, count; the version, the golden sweeps, what was made; the old rows as they were."""
    new = enrolment.enrol(old, "felt", digits(*FELT))
    assert new.warnings == ()
    c, m = new.bundle.classes, new.bundle.manifest
    assert c is not None
    assert c.means[:3].tolist() == toy_bundle.MEANS.tolist()
    assert c.means[3] == pytest.approx([7, 8], abs=1e-5)
    assert c.bias[3] == pytest.approx(-(49 + 64) / 2 + 2 / 10, abs=1e-4)
    assert c.sweeps.tolist() == [0, 0, 0, 5]
    assert c.spread.tolist() == [1, 1, 1, 1]
    assert (m.labels, m.version, m.figures, m.early, m.known) == (
        ("a", "b", "c", "felt"),
        "1+felt",
        {},
        None,
        toy_bundle.KNOWN,
    )
    assert m.made == {"seed": 1, "enrolled": {"felt": 5}}
    assert new.bundle.enrolled == {"felt": 5}
    assert new.bundle.golden[:2].tolist() == old.golden.tolist()
    assert new.bundle.golden_logits.shape == (3, 4)
    assert new.files[bundle.MODEL] == old.model


def test_the_new_bundle_runs(old: Bundle, tmp_path: Path):
    """Written, read, self-tested: it is what `enrol` gave; it names the new label and the old ones, and unknown."""
    new = enrolment.enrol(old, "felt", digits(*FELT))
    enrolment.write(new.files, tmp_path / "new", False)
    read = bundle.load(tmp_path / "new")
    assert (read.id, read.manifest) == (new.bundle.id, new.bundle.manifest)
    for name in ("golden", "golden_logits"):
        assert getattr(read, name).tolist() == getattr(new.bundle, name).tolist()
    it = Classifier(read, VirtualClock())
    assert it.self_test() < 1e-5
    assert [it(toy_bundle.sweep(*z)).label for z in [(7, 8), (0, 0), (6, 0), (0, 6)]] == ["felt", "a", "b", "c"]
    assert Classifier(old, VirtualClock())(toy_bundle.sweep(7, 8)).status is Status.UNKNOWN
    assert it(toy_bundle.sweep(-30, 0)).status is Status.UNKNOWN


def test_same_sweeps_same_bytes(old: Bundle):
    """Nothing of the clock or of chance is in the files."""
    assert enrolment.enrol(old, "felt", digits(*FELT)).files == enrolment.enrol(old, "felt", digits(*FELT)).files


def test_a_material_that_scatters_is_kept(old: Bundle):
    """Its spread is that of its sweeps and of one more at the trained distance: (2 + 4 * 9) / (2 * 4)."""
    new = enrolment.enrol(old, "felt", digits((23, 20), (17, 20), (20, 23), (20, 17)))
    assert new.bundle.classes is not None
    assert new.bundle.classes.spread[3] == pytest.approx(38 / 8, abs=1e-4)
    it = Classifier(new.bundle, VirtualClock())
    edge = np.sqrt(9 * 38 / 8 * 5 / 4)
    assert it(toy_bundle.sweep(20 + edge - 0.1, 20)).label == "felt"
    assert it(toy_bundle.sweep(20 + edge + 0.1, 20)).status is Status.UNKNOWN


def test_the_golden_sweep_is_the_median_of_those_recognised(old: Bundle):
    """By the probability of the new label, without the sweeps that get another one."""
    near = [(3.0, 5.0), (3.0, 5.5), (4.0, 8.0), (3.2, 6.0), (0.5, 6.0)]
    new = enrolment.enrol(old, "felt", digits(*near))
    it = Classifier(new.bundle, VirtualClock())
    scores = [it(toy_bundle.sweep(*z)) for z in near]
    assert scores[4].label == "c"
    mine = sorted((s.probability, i) for i, s in enumerate(scores[:4]))
    assert new.bundle.golden[2].tolist() == toy_bundle.window(*near[mine[2][1]]).tolist()


def test_one_sweep_is_enough_and_labels_add_up(old: Bundle):
    """From one sweep the mean is that sweep; a second label goes on top of the first."""
    first = enrolment.enrol(old, "felt", digits((7, 8)))
    assert first.warnings == ()
    second = enrolment.enrol(first.bundle, "cork", digits((-8, 0), (-9, 0))).bundle
    assert second.enrolled == {"felt": 1, "cork": 2}
    assert second.manifest.labels == ("a", "b", "c", "felt", "cork")
    assert second.manifest.version == "1+felt+cork"
    assert second.manifest.made["enrolled"] == {"felt": 1, "cork": 2}
    it = Classifier(second, VirtualClock())
    assert it.self_test() < 1e-5
    assert [it(toy_bundle.sweep(*z)).label for z in [(7, 8), (-8.5, 0), (0, 0)]] == ["felt", "cork", "a"]


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_the_limit_keeps_as_many_sweeps_of_an_enrolled_label_as_of_a_trained_one(n: int):
    """Of two normal deviates 1 - exp(-limit / 2) lie within the limit, about a mean that was known or is one of n."""
    rng, known = np.random.default_rng(1), replace(toy_bundle.KNOWN, limit=4.0)
    kept = []
    for _ in range(100):
        mean = rng.normal(size=(n, 2)).mean(axis=0)
        classes = bundle.Classes(
            np.vstack([toy_bundle.MEANS + 100, mean]), np.zeros(4), np.array([0, 0, 0, n]), np.ones(4)
        )
        means = Means(classes, known, ("a", "b", "c", "felt"))
        kept += [not means.novelty(means.distances(z)) for z in rng.normal(size=(40, 2))]
    assert np.mean(kept) == pytest.approx(1 - np.exp(-2), abs=0.025)


def test_a_bundle_that_decides_early_does_so_no_more(tmp_path: Path):
    """Its heads do not know the label; the command says so."""
    quick = toy_bundle.load(tmp_path / "q", early=Early((0.9,) * 3, 1), outputs=("logits", "embedding", "early"))
    new = enrolment.enrol(quick, "felt", digits(*FELT))
    assert new.bundle.manifest.early is None
    assert len(new.warnings) == 1
    assert "early answers end" in new.warnings[0]
    Classifier(new.bundle, VirtualClock())


@pytest.mark.parametrize(
    ("at", "hints"),
    [
        ([(1, 0)] * 3, ["close to 'a': squared distance 0.3, limit 9.0"]),
        ([(6, 2.9)] * 100, ["close to 'b': squared distance 8.4"]),
        ([(6, 3.1)] * 100, []),
        ([(20, 20), (20, 24.2)], []),  # 4.2^2 / 2 = 8.8
        ([(20, 20), (20, 24.3)], ["disagree: they lie 9.2 from their mean"]),
        ([(20, 20), (20, 20), (30, 20), (20, 20)], ["number 3 most of all"]),
        ([(0, 0), (6.2, 0)], ["disagree", "close to"]),
    ],
)
def test_sweeps_that_do_not_serve_are_warned_of(old: Bundle, at: list[tuple[float, float]], hints: list[str]):
    """Like a trained material, or unlike one another: said, with numbers, and enrolled all the same."""
    new = enrolment.enrol(old, "felt", digits(*at))
    assert len(new.warnings) == len(hints), new.warnings
    assert all(hint in warning for hint, warning in zip(hints, new.warnings, strict=True))
    assert "felt" in new.bundle.manifest.labels


def test_materials_that_lie_close_anyway_make_no_warning(tmp_path: Path):
    """Closer than the limit, but no closer than two trained materials are: the bundle lives with that already."""
    arrays = toy_bundle.means(means=np.float32([[0, 0], [6, 0], [0, 2]]), bias=np.float32([0, -18, -2]))
    made = toy_bundle.load(tmp_path / "x", arrays=arrays)
    assert enrolment.enrol(made, "felt", digits((8.2, 0), (8.2, 0), (8.2, 0))).warnings == ()
    assert len(enrolment.enrol(made, "felt", digits((7.8, 0), (7.8, 0), (7.8, 0))).warnings) == 1


@pytest.mark.parametrize(
    ("label", "hint"),
    [("b", "label 'b' is taken"), ("a,b", "cannot be sent"), ("", "cannot be sent"), ("x" * 25, "cannot be sent")],
)
def test_labels_that_cannot_be_enrolled(old: Bundle, label: str, hint: str):
    """Taken, or not fit for a sentence; told before a sweep is taken."""
    with pytest.raises(BundleError, match=hint):
        enrolment.admit(old, label)
    with pytest.raises(BundleError, match=hint):
        enrolment.enrol(old, label, digits((7, 8)))


def test_a_bundle_without_embedding(tmp_path: Path):
    """Without class means there is nothing to add to."""
    plain = toy_bundle.load(tmp_path / "p", known=None, outputs=("logits",))
    with pytest.raises(BundleError, match=r"toy 1 has no embedding .*palpate-train"):
        enrolment.enrol(plain, "felt", digits((7, 8)))


@pytest.mark.parametrize(
    "sweeps", [digits((7, 8))[0], digits((7, 8))[:0], digits((7, 8))[:, 1:], digits((7, 8)).astype(np.uint8)]
)
def test_sweeps_of_another_form(old: Bundle, sweeps: np.ndarray):
    """One dimension short, none, another window, another type."""
    with pytest.raises(FormatError, match="cannot be enrolled; the bundle wants"):
        enrolment.enrol(old, "felt", sweeps)


def test_sweeps_that_give_no_number(tmp_path: Path):
    """A mean that is none would make every later answer none."""
    fmt = replace(toy_bundle.FORMAT, dtype="float32")
    made = toy_bundle.load(tmp_path / "f", fmt=fmt)
    with pytest.raises(FormatError, match="no number"):
        enrolment.enrol(made, "felt", np.full((1, 20, 2, 2), 3e38, np.float32))


@pytest.fixture
def made(old: Bundle) -> dict[str, bytes]:
    """Files of a bundle with "felt"."""
    return enrolment.enrol(old, "felt", digits(*FELT)).files


def content(folder: Path) -> dict[str, bytes]:
    """What is in a folder."""
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def test_an_old_bundle_gives_way_only_when_told(tmp_path: Path, made: dict[str, bytes]):
    """Refused without `swap`; with it the folder holds the new files and no other, and nothing is left beside it."""
    target = toy_bundle.put(tmp_path / "there", toy_bundle.files())
    (target / "extra").write_text("")
    before = content(target)
    with pytest.raises(BundleError, match="is there already"):
        enrolment.write(made, target, False)
    assert content(target) == before
    enrolment.write(made, target, True)
    assert content(target) == made
    assert sorted(p.name for p in tmp_path.iterdir()) == ["old", "there"]


def test_what_is_no_bundle_is_never_replaced(tmp_path: Path, made: dict[str, bytes]):
    """A folder of something else, a file, a folder in a folder that is not there."""
    (tmp_path / "home").mkdir()
    (tmp_path / "file").write_text("")
    for place, hint in (("home", "is no bundle"), ("file", "is no bundle"), ("none/new", "is no folder that you may")):
        with pytest.raises(BundleError, match=hint):
            enrolment.write(made, tmp_path / place, True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "home", "old"]
    assert content(tmp_path / "home") == {}


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("call", ["fsync", "exchange"])
def test_whole_or_not_at_all(
    tmp_path: Path, made: dict[str, bytes], there: bool, call: str, monkeypatch: pytest.MonkeyPatch
):
    """A full disk at a sync, a filesystem that cannot swap: the target is what it was, and nothing is left beside it."""
    target = tmp_path / "t"
    if there:
        toy_bundle.put(target, toy_bundle.files())
    elif call == "exchange":
        monkeypatch.setattr(Path, "rename", lambda *args: storage.exchange(*args))
    before = content(target) if there else None
    left = 3

    def fails(*args: object) -> None:
        nonlocal left
        left -= 1
        if left <= 0 or call == "exchange":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os if call == "fsync" else storage, call, fails)
    with pytest.raises(BundleError, match=r"cannot be written to .*No space left on device"):
        enrolment.write(made, target, there)
    assert (content(target) if target.exists() else None) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == (["old", "t"] if there else ["old"])


def test_the_disk_has_it_before_the_name(tmp_path: Path, made: dict[str, bytes], monkeypatch: pytest.MonkeyPatch):
    """Each file and its folder are synced, then the name changes in one step, then the folder above is synced."""
    target, steps = toy_bundle.put(tmp_path / "t", toy_bundle.files()), []
    sync, swap = os.fsync, storage.exchange

    def synced(at: int) -> None:
        steps.append(Path(os.readlink(f"/proc/self/fd/{at}")).name)
        sync(at)

    def swapped(one: Path, other: Path) -> None:
        assert content(one) == made
        assert content(other) == toy_bundle.files()
        swap(one, other)
        assert content(other) == made
        steps.append("swap")

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(storage, "exchange", swapped)
    enrolment.write(made, target, True)
    assert sorted(steps[:4]) == sorted(made)
    assert steps[4:] == ["new", "swap", tmp_path.name]


def test_a_link_to_a_bundle_stays_one(tmp_path: Path, made: dict[str, bytes]):
    """What is replaced is the folder that the link names."""
    target = toy_bundle.put(tmp_path / "v1", toy_bundle.files())
    (tmp_path / "current").symlink_to(target)
    enrolment.write(made, tmp_path / "current", True)
    assert (tmp_path / "current").is_symlink()
    assert content(target) == made


def test_what_does_not_run_is_not_put_there(tmp_path: Path, old: Bundle):
    """A bundle that fails its golden sweeps never takes the name."""
    files = toy_bundle.files()
    other = toy_bundle.npz(samples=old.golden, logits=-old.golden_logits)
    manifest = bundle.Manifest.parse(files[bundle.MANIFEST])
    entries = manifest.files | {bundle.GOLDEN: bundle.file_entry(other)}
    files |= {bundle.GOLDEN: other, bundle.MANIFEST: replace(manifest, files=entries).json()}
    with pytest.raises(BundleError, match="get another label"):
        enrolment.write(files, tmp_path / "t", False)
    assert not (tmp_path / "t").exists()


@pytest.fixture
def rig(tmp_path: Path, old: Bundle):
    """`palpate enrol felt` on the rig: plays these windows with the toy bundle; its exit code."""

    def play(windows: np.ndarray, *more: str, out: str = "new") -> int:
        n = len(windows)
        np.savez(tmp_path / "s.npz", samples=windows, labels=np.zeros(n, int), materials=np.array(["x"]), rate_hz=100.0)
        chosen = ["--set", f"classifier.bundle={tmp_path / 'old'}", "--sim", f"replay:{tmp_path / 's.npz'}"]
        return main(["enrol", "felt", "--out", str(tmp_path / out), *chosen, "--virtual", *more])

    return play


def test_the_command_enrols(rig, old: Bundle, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Spoiled sweeps are told, not counted; good ones make the bundle that `enrol` makes; every sweep is answered."""
    silent = np.zeros((1, 20, 2, 2), np.int16)
    assert rig(np.concatenate([digits(*FELT[:2]), silent, digits(*FELT[2:], (0, 0))])) == 0
    said = capsys.readouterr()
    assert content(tmp_path / "new") == enrolment.enrol(old, "felt", digits(*FELT)).files
    assert said.out.count(",RES,") == 6
    assert "sweep 2 taken: 2 of 5" in said.err
    assert "sweep 3 not taken: no-contact strongest taxel 0.0 digits" in said.err
    assert "sweep 6 taken: 5 of 5" in said.err
    assert "toy 1+felt, " in said.err
    assert "warning" not in said.err
    assert main(["check", "--set", f"classifier.bundle={tmp_path / 'new'}", "--virtual", "--sim",
                 f"replay:{tmp_path / 's.npz'}"]) == 0  # fmt: skip
    assert "4 labels, felt enrolled from 5" in capsys.readouterr().out


def test_the_command_takes_as_many_sweeps_as_it_is_told(rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """--sweeps 1; what looks like a trained material is warned of and enrolled."""
    assert rig(digits((1, 0), (50, 50)), "--sweeps", "1") == 0
    assert "warning: 'felt' lies close to 'a'" in capsys.readouterr().err
    assert bundle.load(tmp_path / "new").enrolled == {"felt": 1}


def test_too_few_sweeps_write_nothing(rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The script ends, or SIGTERM comes, before enough were good: exit code 1 and no folder."""
    assert rig(digits(*FELT[:3])) == 1
    assert "3 of 5 good sweeps" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_sigterm_ends_an_enrolment(rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As it ends a run; nothing is written."""
    keep = enrolment.SweepCollector.sweep

    def kept(self: enrolment.SweepCollector, *what) -> None:
        keep(self, *what)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(enrolment.SweepCollector, "sweep", kept)
    assert rig(digits(*FELT)) == 1
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("more", "trouble", "hint"),
    [
        (["--set", "classifier.bundle=/nowhere"], BundleError, "no bundle at /nowhere"),
        (["--out", "/nowhere/new"], BundleError, "/nowhere is no folder that you may write to"),
        (["--sim", "world"], ConfigError, "--sim world is unknown"),
    ],
)
def test_trouble_is_told_before_the_robot_sweeps(
    rig, more: list[str], trouble: type[ApplianceError], hint: str, capsys
):
    """A bundle that is not there, a place that is none, a world that is none: one line, no sweep."""
    assert rig(digits(*FELT), *more) == trouble.exit_code
    said = capsys.readouterr()
    assert hint in said.err
    assert said.out == ""
    assert len(said.err.strip().splitlines()) == 1


def test_the_running_bundle_is_replaced_only_when_told(rig, old: Bundle, tmp_path: Path, capsys):
    """--out of the bundle in use: refused before a sweep, done with --replace."""
    assert rig(digits(*FELT), out="old") == BundleError.exit_code
    said = capsys.readouterr()
    assert "give --replace" in said.err
    assert said.out == ""
    assert rig(digits(*FELT), "--replace", out="old") == 0
    assert bundle.load(tmp_path / "old").enrolled == {"felt": 5}


@pytest.mark.parametrize("n", ["0", "11", "five"])
def test_one_to_ten_sweeps(rig, n: str):
    """Other numbers are usage errors."""
    with pytest.raises(SystemExit) as e:
        rig(digits(*FELT), "--sweeps", n)
    assert e.value.code == 2


def test_sweeps_are_whole_where_the_box_decides_early(rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """classifier.early does not hold while it enrols, though `run` would stop at a quarter of this sweep."""
    toy_bundle.put(
        tmp_path / "old", toy_bundle.files(early=Early((0.01,) * 3, 1), outputs=("logits", "embedding", "early"))
    )
    early = ["--set", "classifier.early=true"]
    assert rig(digits((7, 8)), *early, "--sweeps", "1") == 0
    assert ",1.00," in capsys.readouterr().out
    assert bundle.load(tmp_path / "new").golden[2].tolist() == toy_bundle.window(7, 8).tolist()
    chosen = ["--set", f"classifier.bundle={tmp_path / 'old'}", "--sim", f"replay:{tmp_path / 's.npz'}", "--virtual"]
    assert main(["run", *chosen, *early]) == 0
    assert ",ok,c,0.95" in capsys.readouterr().out


def test_a_bundle_that_cannot_is_told_before_the_robot_sweeps(rig, tmp_path: Path, capsys):
    """No embedding: told at once, and no sweep was asked for."""
    toy_bundle.put(tmp_path / "old", toy_bundle.files(known=None, outputs=("logits",)))
    assert rig(digits(*FELT)) == BundleError.exit_code
    said = capsys.readouterr()
    assert "has no embedding" in said.err
    assert said.out == ""


def test_lines_that_cannot_tell_the_new_label(rig, monkeypatch: pytest.MonkeyPatch, capsys):
    """Two class bits hold three labels and 0, not four: told now, since `run` would refuse the new bundle."""
    monkeypatch.setattr(devices, "BITS", devices.BITS[:2])
    assert rig(digits(*FELT)) == ConfigError.exit_code
    said = capsys.readouterr()
    assert "4 labels and the code 0 do not fit output.class_bits" in said.err
    assert said.out == ""


def test_taken_takes_what_it_wants(old: Bundle, logged: list[str]):
    """No more than it was told, though one turn of the box may answer several; nothing is made of too few."""
    taken, it = enrolment.SweepCollector(2), Classifier(old, VirtualClock())
    with pytest.raises(ApplianceError, match="0 of 2 good sweeps"):
        taken.windows()
    for i, z in enumerate(FELT[:3]):
        sweep = toy_bundle.sweep(*z, number=i)
        taken.sweep(sweep, it(sweep), {})
    assert taken.windows().tolist() == digits(*FELT[:2]).tolist()
    assert logged == ["sweep 0 taken: 1 of 2", "sweep 1 taken: 2 of 2"]

"""enrolment.npz adds labels to a bundle, and with any content can add nothing else."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from palpate.bundle import arrays, bundle, enrolled
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment
from tests.factories import toy_bundle

SWEEPS = np.stack([toy_bundle.window(7, 8), toy_bundle.window(8, 9)])


@pytest.fixture
def base() -> dict[str, bytes]:
    """The files of the toy bundle."""
    return toy_bundle.files()


@pytest.fixture
def made(base: dict[str, bytes]) -> dict[str, bytes]:
    """The files after the enrolment of felt and then cork."""
    return grown(grown(base, "felt"), "cork", SWEEPS[:, ::-1])


def grown(files: dict[str, bytes], label: str, sweeps: np.ndarray = SWEEPS) -> dict[str, bytes]:
    """The files after the enrolment of another label."""
    return enrolment.files(
        files, enrolment.enrol(bundle.from_files(files, "toy"), label, sweeps), None
    )


def content(files: dict[str, bytes]) -> dict[str, np.ndarray]:
    """The arrays of enrolment.npz."""
    with np.load(io.BytesIO(files[bundle.ENROLMENT])) as z:
        return dict(z.items())


def changed(files: dict[str, bytes], **arrays: np.ndarray) -> dict[str, bytes]:
    """The files with other arrays in enrolment.npz; None removes an array."""
    held = {
        name: values for name, values in (content(files) | arrays).items() if values is not None
    }
    return files | {bundle.ENROLMENT: toy_bundle.npz(**held)}


def test_the_bundle_stays_as_it_is(base, made, tmp_path):
    """One file is added; trained tensors are the same, and the id is another."""
    assert {name: data for name, data in made.items() if name != bundle.ENROLMENT} == base
    old, new = bundle.from_files(base, "old"), bundle.load(toy_bundle.put(tmp_path / "b", made))
    assert old.classes
    assert new.classes
    assert old.manifest.known
    assert (new.model, new.manifest.thresholds, new.manifest.known) == (
        old.model,
        old.manifest.thresholds,
        replace(old.manifest.known, enrolled=enrolment.LEAST),
    )
    for name, values in old.classes.arrays().items():
        assert new.classes.arrays()[name][:3].tobytes() == values.tobytes(), name
    assert new.golden[:2].tobytes() == old.golden.tobytes()
    assert new.manifest.labels == (*old.manifest.labels, "felt", "cork")
    assert new.manifest.files == old.manifest.files
    assert new.enrolled == {"felt": 2, "cork": 2}
    assert (new.base, new.id) == (bundle.digest(base[bundle.MANIFEST]), bundle.name(made)[:8])
    assert new.id != old.id


def check_refused(files: dict[str, bytes], why: str) -> None:
    """The files give no bundle, for this reason, in one line."""
    with pytest.raises(BundleError, match=why) as e:
        bundle.from_files(files, "toy")
    assert str(e.value).isprintable()


WRONG = {
    "another bundle": ({"base": np.array("0" * 64)}, "bundle '00000000'"),
    "no bundle": ({"base": np.zeros(64, np.uint8)}, "names no bundle"),
    "no labels": ({"labels": np.array([], "U1")}, "names no bundle"),
    "another number of names": ({"displays": np.array(["Filz"])}, "names no bundle"),
    "names as numbers": ({"displays": np.zeros(2)}, "names no bundle"),
    "a name that shows nothing": ({"displays": np.array(["Filz", "\u3164"])}, "display name"),
    "labels as bytes": ({"labels": np.array([b"felt", b"cork"])}, "names no bundle"),
    "a label that is taken": ({"labels": np.array(["felt", "a"])}, "two different names"),
    "a label twice": ({"labels": np.array(["felt", "felt"])}, "two different names"),
    "a label that cannot be sent": ({"labels": np.array(["felt", "$,*"])}, "cannot be sent"),
    "more labels than means": (
        {"labels": np.array(["felt", "cork", "silk"]), "displays": np.array([""] * 3)},
        r"\[3, 2\]",
    ),
    "means of another rank": ({"means": np.zeros((2, 3), np.float32)}, r"float32 \[2, 3\]"),
    "means as doubles": ({"means": np.zeros((2, 2))}, "means float64"),
    "a mean that is nan": ({"means": np.float32([[7, 8], [np.nan, 0]])}, "means that"),
    "a mean without end": ({"means": np.float32([[7, 8], [3e38, 3e38]])}, "bias that"),
    "no sweep": ({"sweeps": np.array([2, 0])}, "number of sweeps"),
    "sweeps below none": ({"sweeps": np.array([2, -5])}, "number of sweeps"),
    "sweeps without end": ({"sweeps": np.array([2, 1 << 62])}, "too many"),
    "a small spread": ({"spread": np.float32([1, 0.5])}, "spread below 1"),
    "a spread without end": ({"spread": np.float32([1, np.inf])}, "spread that"),
    "other golden sweeps": ({"changes": np.zeros((1, 2, 20, 2, 2), np.uint8)}, "changes uint8"),
    "logits of fewer labels": ({"logits": np.zeros((4, 4), np.float32)}, r"float32 \[4, 5\]"),
    "logits that are nan": ({"logits": np.full((4, 5), np.nan, np.float32)}, "logits that"),
    "no logits": ({"logits": None}, "logits"),
    "no rule": ({"least": None}, "least"),
    "no means": ({"means": None}, "means"),
    "a rule of another type": ({"least": np.array([0.7])}, r"float64 \[1\]; float64 \[\]"),
    "a rule that is nan": ({"least": np.array(np.nan)}, "least that"),
    "a rule that prefers new labels": ({"least": np.array(0.4)}, "known.enrolled 0.4"),
    "a rule that lets none pass": ({"least": np.array(1.0)}, "known.enrolled 1.0"),
    "objects": ({"spread": np.array([1, "x"], object)}, "cannot be read"),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_enrolment_that_is_not_as_it_must_be_is_refused(made, case):
    """Of another bundle, with wrong types or shapes, out of range."""
    changes, why = WRONG[case]
    check_refused(changed(made, **changes), why)


@pytest.mark.parametrize("name", [bundle.ENROLMENT, bundle.GOLDEN, bundle.MEANS])
def test_a_member_that_is_no_array_is_refused(made, name):
    """numpy returns such a member as bytes. The error names it before its type is used."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(made[name])) as whole, zipfile.ZipFile(file, "w") as damaged:
        for member in whole.namelist():
            damaged.writestr(
                member, b"nothing" if member == whole.namelist()[0] else whole.read(member)
            )
    with pytest.raises(BundleError, match="array"):
        arrays.read(file.getvalue(), name)


def test_a_file_that_is_no_npz_is_refused(made):
    """A cut or empty file, other bytes, or a zip file that unpacks without end."""
    whole = made[bundle.ENROLMENT]
    for data in (b"", b"PK", whole[:200], b"\0" * 1000):
        check_refused(made | {bundle.ENROLMENT: data}, "cannot be read")
    name, extra = (int.from_bytes(whole[at : at + 2], "little") for at in (26, 28))
    packed, central = 30 + name + extra, whole.index(b"PK\1\2")
    # no deflate, encrypted, method 99
    for at, value in ((packed, 0xFF), (central + 8, 1), (central + 10, 99)):
        damaged = whole[:at] + bytes([value]) + whole[at + 1 :]
        check_refused(made | {bundle.ENROLMENT: damaged}, "cannot be read")
    bomb = io.BytesIO()
    np.savez_compressed(bomb, **content(made) | {"zeros": np.zeros(70 << 20, np.uint8)})
    check_refused(made | {bundle.ENROLMENT: bomb.getvalue()}, "unpacks to .* bytes")


def test_bias_and_shape_are_computed_from_class_means(made):
    """From mean and number of a label; without class means no label is added."""
    plain = toy_bundle.files(known=None, outputs=("logits",))
    base = np.array(bundle.digest(plain[bundle.MANIFEST]))
    check_refused(
        plain | {bundle.ENROLMENT: changed(made, base=base)[bundle.ENROLMENT]}, "has no class means"
    )
    assert set(content(made)) == set(enrolled.ARRAYS)
    louder = changed(made, bias=np.float32([1e6, 1e6]), means_of_wood=np.zeros((3, 2), np.float32))
    new, old = bundle.from_files(louder, "louder"), bundle.from_files(made, "made")
    assert new.classes
    assert old.classes
    for name, values in old.classes.arrays().items():
        assert new.classes.arrays()[name].tobytes() == values.tobytes()


def test_labels_leave_the_order_of_others(base, made):
    """A forged label can only win itself; class codes stay in the order of enrolment."""
    forged = changed(made, means=np.float32([[6, 0], [0, 0]]), spread=np.float32([1e6, 1e6]))
    it, before = (
        Classifier(bundle.from_files(files, "toy"), SystemClock()) for files in (forged, base)
    )
    for z in ((0, 0), (6, 0), (0, 6), (3, 1)):
        scores = [run.logits(toy_bundle.window(*z))[:3] for run in (it, before)]
        assert np.argsort(scores[0]).tolist() == np.argsort(scores[1]).tolist()
    one, other = grown(grown(base, "felt"), "cork"), grown(grown(base, "cork"), "felt")
    first, second = (bundle.from_files(files, "toy") for files in (one, other))
    assert (first.manifest.labels[3:], second.manifest.labels[3:]) == (
        ("felt", "cork"),
        ("cork", "felt"),
    )
    assert one == grown(grown(base, "felt"), "cork")

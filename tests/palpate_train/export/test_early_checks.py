"""The check of unknown materials in unfinished sweeps is added to bundles that lack it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from palpate.bundle import bundle
from palpate.core.errors import FormatError
from palpate.inference.novelty import EarlyDistances
from palpate_train.calibration import early_exit
from palpate_train.data import sets
from palpate_train.export import bridging, displacement_limit, early_checks
from tests.factories import toy_bundle


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """The packaged bundle as one of an earlier version: without limits of unfinished and of
    displaced sweeps, and without the output for them."""
    folder = tmp_path / "bundle"
    shutil.copytree(bundle.DEFAULT, folder)
    loaded = bundle.load(folder)
    m, model = loaded.manifest, onnx.load_from_string(loaded.model)
    kept = [output for output in model.graph.output if output.name != "early_embedding"]
    del model.graph.output[:]
    model.graph.output.extend(kept)
    assert m.early
    assert m.displacement
    assert loaded.classes
    files = {bundle.MODEL: model.SerializeToString()}
    files[bundle.MEANS] = toy_bundle.npz(**replace(loaded.classes, early=None).arrays())
    entries = {name: bundle.file_entry(data) for name, data in files.items()}
    manifest = replace(
        m,
        early=replace(m.early, limits=()),
        displacement=replace(m.displacement, farthest_mm=None),
        files=m.files | entries,
    )
    for name, data in (files | {bundle.MANIFEST: manifest.json()}).items():
        (folder / name).write_bytes(data)
    return folder


def test_known_sweeps_are_within_the_limits_and_others_are_not():
    """Of 400 sweeps that the classes have not seen, a share of KEPT; of those of another material
    none."""
    rng = np.random.default_rng(0)
    means = np.array([[[0, 0, 0], [8, 0, 0]], [[0, 0, 0], [9, 0, 0]]])  # [D, K, r]
    labels = rng.integers(2, size=800)
    z = means[:, labels].swapaxes(0, 1) + rng.standard_normal((800, 2, 3)) * [2, 1, 0.5]
    seen, new = slice(0, 400), slice(400, 800)
    classes = early_exit.early_classes(z[seen], labels[seen])
    assert np.allclose(classes.means, means, atol=0.5)
    limits = early_exit.early_limits(classes, z[new])
    distances = EarlyDistances(classes, limits)
    known = np.stack([distances.known(sweep) for sweep in z[new]])
    assert known.mean(axis=0) == pytest.approx(early_exit.KEPT, abs=0.01)
    assert not distances.known(np.array([[0, 0, 6], [0, 0, 6]])).any()


def test_an_older_bundle_gets_the_check_and_keeps_its_answers(older: Path):
    """Logits and embedding of the model are those of before; the limit for a displaced contact is
    that of the training copies."""
    was = bundle.load(older)
    train, fresh = (sets.load(f"sim:T-REAL/level-blind:{n}:2") for n in (41, 42))
    manifest = early_checks.write(older, train, fresh)
    now = bundle.load(older)
    assert now.manifest == manifest
    assert manifest.early
    assert len(manifest.early.limits) == len(manifest.early.least)
    assert now.classes
    assert now.classes.early
    assert early_checks.text(was.manifest).endswith("not detected before the end of a sweep")
    assert early_checks.text(manifest).endswith("at each of 9 steps")
    some = train.samples[:2]
    for name in ("logits", "embedding"):
        before, after = (
            early_checks.run_output(onnx.load_from_string(of.model), name, some)
            for of in (was, now)
        )
        assert before.tolist() == after.tolist()
    manifest = bridging.rewritten(
        older, train, lambda held: displacement_limit.limited(held, train)
    )
    assert manifest.displacement
    assert manifest.contact
    copies_mm = manifest.displacement.farthest_mm - manifest.contact.limit_mm
    assert copies_mm == pytest.approx(1.9, abs=0.4)  # of a pitch of 4 mm
    assert "named up to" in displacement_limit.text(manifest)
    assert displacement_limit.text(was.manifest).endswith("named at any distance")


def test_a_bundle_without_early_answers_is_refused(older: Path):
    """The manifest or the model lacks them."""
    loaded = bundle.load(older)
    manifest = replace(loaded.manifest, early=None)
    model = onnx.load_from_string(loaded.model)
    kept = [output for output in model.graph.output if output.name != "early"]
    del model.graph.output[:]
    model.graph.output.extend(kept)
    data = model.SerializeToString()
    manifest = replace(manifest, files=manifest.files | {bundle.MODEL: bundle.file_entry(data)})
    (older / bundle.MODEL).write_bytes(data)
    (older / bundle.MANIFEST).write_bytes(manifest.json())
    sweeps = sets.load("sim:T-REAL/level-blind:41:1")
    with pytest.raises(FormatError, match="lacks early answers"):
        early_checks.write(older, sweeps, sweeps)
    with pytest.raises(FormatError, match="gives no early answers; export it from a fit"):
        early_checks.exposed(model)


def test_without_a_rule_nothing_is_said_and_nothing_is_changed():
    """Of a bundle that does not know displaced contacts or early answers."""
    manifest = bundle.load(bundle.DEFAULT).manifest
    bare = replace(manifest, early=None, displacement=None)
    assert early_checks.text(bare) == displacement_limit.text(bare) == ""
    sweeps = sets.load("sim:T-REAL/level-blind:41:1")
    assert displacement_limit.limited(bare, sweeps) is bare

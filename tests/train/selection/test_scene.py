"""Scenes: the content of scene.toml, its errors, and the sweeps that it selects."""

from __future__ import annotations

import math
import tomllib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from appliance.core.errors import FormatError
from tests.factories.paths import ROOT
from train.data.sets import Dataset
from train.selection import scene, select

WHOLE = """
name = "drawer"
version = "2.1"
sets = ["a.npz", "sim:T-LAB:1001:1"]
only = ["force<=180"]
materials = ["a", "b"]
varies = ["force"]
folds = 4
accuracy = 0.9
seeds = 2
methods = ["L-gauss", "compact"]
reduce = ["window", "rate"]
apply = ["rate"]
full_scale = 4095
[merge]
"a or c" = ["a", "b"]
[stress]
noise = 0.3
dead = 1
[budget]
ms = 5
kb = 96.5
mb = 64
slower = 3.0
"""


def written(folder: Path, text: str) -> Path:
    """A scene.toml with this text."""
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def three(folder: Path) -> Path:
    """A set of three materials in a file, with two forces and two sweeps of each."""
    labels = np.repeat([0, 1, 2], 4)
    samples = (10 * labels[:, None, None, None] + np.arange(5)[:, None, None]).astype(
        np.int16
    ) * np.ones((2, 1), np.int16)
    groups = {"force": np.tile([100, 200], 6)}
    Dataset(samples, labels, ("a", "b", "c"), 50.0, groups).save(folder / "a.npz")
    return folder


def test_every_key_is_read(tmp_path: Path):
    """The scene holds the values of the file, and defaults for all others."""
    found = scene.read(written(tmp_path, WHOLE))
    assert (found.name, found.version, found.folds, found.seeds) == ("drawer", "2.1", 4, 2)
    assert found.merge == {"a or c": ("a", "b")}
    assert found.stress == {"noise": 0.3, "dead": 1.0}
    assert (found.budget.ms, found.budget.kb, found.budget.mb, found.budget.slower) == (
        5,
        96.5,
        64,
        3.0,
    )
    assert (found.reduce, found.apply, found.full_scale) == (("window", "rate"), ("rate",), 4095)
    least = scene.read(written(tmp_path, 'sets = ["a.npz"]'))
    assert (least.name, least.varies, least.accuracy, least.apply) == ("scene", (), 0, ("window",))
    assert least.budget.ms == math.inf


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("sets = [", "scene.toml: not TOML"),
        ("", "scene.toml: no sets; name some"),
        ('sets = ["a"]\nvarys = ["x"]', "scene.toml: key varys is unknown; did you mean 'varies'"),
        ('sets = ["a"]\nqqq = 1', "key qqq is unknown; use name, version, sets"),
        ('sets = ["a"]\n[budget]\nkB = 3', r"key budget\.kB is unknown; did you mean 'kb'"),
        (
            'sets = ["a"]\n[budget]\nms = "5"',
            r"budget\.ms = '5' is not allowed; use a number from 0\.001",
        ),
        ('sets = ["a"]\n[budget]\nms = 0', r"budget\.ms = 0 is not allowed"),
        ('sets = ["a"]\n[budget]\nslower = nan', r"budget\.slower = nan is not allowed"),
        ('sets = ["a"]\nbudget = 3', "budget = 3 is not allowed; write a table"),
        ('sets = "a"', "sets = 'a' is not allowed; use a list of different texts"),
        ('sets = ["a", "a"]', "is not allowed; use a list of different texts"),
        ('sets = ["a", 1]', "is not allowed; use a list of different texts"),
        ('sets = ["a"]\naccuracy = 90', "accuracy = 90 is not allowed; use a number from 0 to 1"),
        ('sets = ["a"]\naccuracy = true', "accuracy = True is not allowed"),
        (
            'sets = ["a"]\nseeds = 1.5',
            "seeds = 1.5 is not allowed; use a whole number from 1 to 20",
        ),
        ('sets = ["a"]\nfolds = 2', "folds = 2 is not allowed; use a whole number from 3"),
        (
            'sets = ["a"]\nname = "a,b"',
            "name = 'a,b' is not allowed; use a text of 1 to 24 letters",
        ),
        (
            'sets = ["a"]\nreduce = ["windows"]',
            "reduce = .* is not allowed; use a list of some of window, rate",
        ),
        (
            'sets = ["a"]\napply = ["bits"]',
            "apply = .* is not allowed; use a list of some of window, rate, taxels$",
        ),
        (
            'sets = ["a"]\nreduce = ["rate"]\napply = ["taxels"]',
            "apply names 'taxels', which is not in reduce",
        ),
        (
            'sets = ["a"]\nmethods = ["L-gaus"]',
            "method 'L-gaus' is unknown; did you mean 'L-gauss'",
        ),
        (
            'sets = ["a"]\n[stress]\nnoize = 0.1',
            "stress 'noize' is unknown, .*; did you mean 'noise'",
        ),
        (
            'sets = ["a"]\n[stress]\nshift-rows = 1',
            "stress 'shift-rows' is unknown, or only for simulated sweeps",
        ),
        (
            'sets = ["a"]\n[stress]\nnoise = 3',
            r"stress\.noise = 3 is out of range; use up to 0.5 deviations",
        ),
        ('sets = ["a"]\n[stress]\nnoise = 0', "stress = .* is not allowed; use numbers above 0"),
        ('sets = ["a"]\n[merge]\nx = "a"', "merge = .* is not allowed; use lists of materials"),
        ('sets = ["a"]\n[merge]\n"x,y" = ["a"]', "merge = .* is not allowed"),
        ('sets = ["a"]\n[merge]\nx = ["a"]\ny = ["a"]', "merge names 'a' twice"),
        (
            'sets = ["a"]\nmaterials = ["b", "c"]\n[merge]\nx = ["a"]',
            "merge names 'a', which is not among materials",
        ),
    ],
)
def test_what_is_wrong_is_named(text: str, why: str, tmp_path: Path):
    """The message has the file, the key, the value, and the allowed or nearest value, before any
    sweep is read."""
    with pytest.raises(FormatError, match=why):
        scene.read(written(tmp_path, text))


def test_a_file_that_is_not_text_is_refused(tmp_path: Path):
    """Bytes that are not UTF-8."""
    path = tmp_path / "scene.toml"
    path.write_bytes(b'name = "\xff"')
    with pytest.raises(FormatError, match="not TOML"):
        scene.read(path)


def test_sets_lie_beside_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A relative path starts at scene.toml, variables are replaced, and a variable that is not set
    is named."""
    three(tmp_path)
    monkeypatch.chdir("/")
    assert len(scene.read(written(tmp_path, 'sets = ["a.npz"]')).sweeps()) == 12
    monkeypatch.setenv("SWEEPS_AT", str(tmp_path))
    there = written(tmp_path, 'sets = ["$SWEEPS_AT/a.npz"]')
    assert len(scene.read(there).sweeps()) == 12
    monkeypatch.delenv("SWEEPS_AT")
    with pytest.raises(FormatError, match="names a variable that is not set"):
        scene.read(there).sweeps()


def test_materials_are_narrowed_and_merged(tmp_path: Path):
    """The selected materials have their new names in their old order; labels and groups agree."""
    three(tmp_path)
    found = scene.read(
        written(tmp_path, 'sets = ["a.npz"]\nmaterials = ["a", "c"]\nonly = ["force=100"]')
    ).sweeps()
    assert (found.materials, found.labels.tolist()) == (("a", "c"), [0, 0, 1, 1])
    assert found.samples[:, 0, 0, 0].tolist() == [0, 0, 20, 20]
    merged = scene.read(written(tmp_path, 'sets = ["a.npz"]\n[merge]\nboth = ["c", "a"]')).sweeps()
    assert merged.materials == ("both", "b")
    assert merged.labels.tolist() == [0] * 4 + [1] * 4 + [0] * 4


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('materials = ["a", "d"]', "scene.toml: material 'd' is unknown; use a, b, c"),
        ('[merge]\nx = ["a", "bb"]', "material 'bb' is unknown; did you mean 'b'"),
        ('materials = ["a"]', "only one class, 'a'"),
        ('[merge]\nx = ["a", "b", "c"]', "only one class, 'x'"),
        ('varies = ["forces"]', "varies 'forces' is unknown; did you mean 'force'"),
        ('only = ["force=1"]', "no sweep fulfils force=1"),
    ],
)
def test_what_does_not_fit_the_sweeps_is_named(text: str, why: str, tmp_path: Path):
    """A material, group or value that the sets do not have."""
    three(tmp_path)
    with pytest.raises(FormatError, match=why):
        scene.read(written(tmp_path, f'sets = ["a.npz"]\n{text}')).sweeps()


def test_a_label_that_the_box_cannot_send_is_refused_at_once(tmp_path: Path):
    """It is refused before hours of training; [merge] renames it."""
    samples = np.arange(40, dtype=np.int16).reshape(4, 10, 1, 1)
    Dataset(samples, np.array([0, 0, 1, 1]), ("wood, oiled", "b"), 50.0).save(tmp_path / "a.npz")
    with pytest.raises(
        FormatError,
        match=r"cannot send 'wood, oiled' \(11 characters\); .* name each anew in \[merge\]",
    ):
        scene.read(written(tmp_path, 'sets = ["a.npz"]')).sweeps()
    renamed = scene.read(
        written(tmp_path, 'sets = ["a.npz"]\n[merge]\n"oiled wood" = ["wood, oiled"]')
    ).sweeps()
    assert renamed.materials == ("oiled wood", "b")


def test_the_examples_are_scenes_and_name_every_key():
    """The documented examples can be read, and the long one shows every key."""
    docs = ROOT / "docs" / "choose"
    found = {path.name: scene.read(path) for path in docs.glob("*.toml")}
    assert {"tubes.toml", "fabrics.toml"} <= found.keys()
    table = tomllib.loads((docs / "tubes.toml").read_text())
    assert table.keys() == {f.name for f in fields(scene.Scene)} - {"path"}
    assert table["budget"].keys() == {f.name for f in fields(scene.Budget)}
    usual = select.candidates(replace(found["tubes.toml"], methods=()))
    assert list(found["tubes.toml"].methods) == usual

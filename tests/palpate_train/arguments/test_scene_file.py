"""Options of `fit` in a file: the words that it becomes, and its errors."""

import argparse
from pathlib import Path

import pytest

from palpate.core.errors import FormatError
from palpate_train.arguments import scene_file
from palpate_train.cli import fit
from tests.factories.paths import ROOT

WHOLE = """
set = ["a.npz", "sim:T-LAB:1001:1"]
only = ["force<=180"]
rename = ["c=a"]
budget-ms = 5
budget-kb = 96.5
accuracy = 0.9
slower = 3.0
reduce = ["window", "rate"]
reattached = true
size = "64"
"""


def command() -> argparse.ArgumentParser:
    """The parser of `fit`."""
    parser = argparse.ArgumentParser()
    fit.register(lambda name, run: parser)
    return parser


def written(folder: Path, text: str) -> Path:
    """A scene.toml with this text."""
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def parsed(folder: Path, text: str, *more: str) -> argparse.Namespace:
    """The options of the scene, and `more` on the command line."""
    parser = command()
    words = scene_file.words(written(folder, text), parser)
    return parser.parse_args([*words, "--seed", "1", "--out", "x.npz", *more])


def test_every_option_can_stand_in_the_file(tmp_path: Path):
    """Texts, numbers, flags, lists, a set beside the scene; bytes beyond UTF-8 are refused."""
    found = parsed(tmp_path, WHOLE)
    assert found.sets == [str(tmp_path / "a.npz"), "sim:T-LAB:1001:1"]
    assert (found.only, found.rename) == (["force<=180"], ["c=a"])
    assert (found.budget_ms, found.budget_kb, found.accuracy, found.slower) == (5, 96.5, 0.9, 3)
    assert (found.reduce, found.reattached, found.size) == (["window", "rate"], True, "64")
    path = tmp_path / "scene.toml"
    path.write_bytes(b'size = "\xff"')
    with pytest.raises(FormatError, match="not TOML"):
        scene_file.words(path, command())


def test_the_command_line_and_variables_change_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its value counts, and false is as if the flag were not there; variables are replaced."""
    found = parsed(tmp_path, WHOLE, "--budget-ms", "2")
    assert (found.budget_ms, found.budget_kb) == (2, 96.5)
    assert not parsed(tmp_path, "reattached = false").reattached
    monkeypatch.setenv("SWEEPS_AT", "/sweeps")
    found = parsed(tmp_path, 'set = ["$SWEEPS_AT/a.npz"]')
    assert found.sets == ["/sweeps/a.npz"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("set = [", "scene.toml"),
        ("budget-m = 1", "'budget-ms'"),
        ("qqq = 1", "qqq"),
        ("scene = 'a'", "key scene"),
        ("budget-ms = [1, 2]", r"\[1, 2\]"),
        ("budget-ms = true", "= True"),
        ("only = []", "use a"),
        ("only = [{}]", "only = "),
        ("[only]\nx = 1", "only = "),
        ("reattached = 1", "= 1"),
        ("set = '$SURELY_NOT_SET/a.npz'", "that is not set; set it"),
    ],
)
def test_what_is_wrong_is_named(text: str, why: str, tmp_path: Path):
    """The message has the file, the key, the value, and the allowed or nearest one."""
    with pytest.raises(FormatError, match=why):
        parsed(tmp_path, text)


@pytest.mark.parametrize("name", ["tubes.toml", "fabrics.toml"])
def test_the_examples_are_scenes(name: str, monkeypatch: pytest.MonkeyPatch):
    """The documented examples can be read; the long one has every option of the dial."""
    monkeypatch.setenv("PALPATE_DATA", "/sweeps")
    path = ROOT / "docs" / "choose" / name
    words = scene_file.words(path, command())
    found = command().parse_args([*words, "--seed", "1", "--out", "x.npz"])
    assert found.sets
    if name == "tubes.toml":
        assert None not in (found.budget_ms, found.budget_kb, found.slower, found.accuracy)
        assert found.reduce

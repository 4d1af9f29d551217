"""The commands of a box with several fingers, as a person or a script uses them."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.bundle.bundle import Bundle
from palpate.cli import run_command
from palpate.cli.common import load_settings
from palpate.cli.main import main
from palpate.cli.parser import arguments
from palpate.client.answers import Answer
from palpate.core import sentences
from palpate.core.errors import ConfigError
from palpate.core.types import sidecar
from palpate.deployment.trial import Trial
from palpate.runtime import assembly
from palpate_train.data import sets
from tests.factories import deliveries, hands, toy_bundle
from tests.factories.deliveries import Delivery
from tests.factories.settings import load
from tests.factories.simulated_box import Rigged

TWO = [word for text in hands.of(*hands.TWO) for word in ("--set", text)]
VIRTUAL = ["--sim", "skin", "--virtual", "--sweeps", "3", "--seed", "7"]


def answers(text: str) -> list[Answer]:
    """The answers in sentences: of fingers, and of the hand."""
    found = [sentences.read(line.encode()) for line in text.splitlines() if line.startswith("$")]
    return [
        Answer.of_finger(one.fields) if one.kind == "FIN" else Answer.of(one.fields)
        for one in found
        if one.kind in ("FIN", "RES")
    ]


def test_run_answers_each_finger_then_the_hand(capsys: pytest.CaptureFixture[str]):
    """Three sweeps, three sentences each, of the same material."""
    assert main(["run", *VIRTUAL, *TWO]) == 0
    found = answers(capsys.readouterr().out)
    assert [a.finger for a in found] == ["left", "right", ""] * 3
    assert [a.sweep for a in found] == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert all(len({a.label for a in found[i : i + 3]}) == 1 for i in (0, 3, 6))


def test_kept_sweeps_of_each_finger_are_replayed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The black box has a folder for each finger, whose replay gives the finger's answers."""
    kept = ["--set", f"store.folder={tmp_path}", "--set", "store.black_box=9"]
    assert main(["run", *VIRTUAL, *TWO, *kept]) == 0
    found = answers(capsys.readouterr().out)
    for finger in hands.TWO:
        assert main(["replay", str(tmp_path / "black-box" / finger)]) == 0
        again = answers(capsys.readouterr().out)
        wanted = [(a.label, a.probability) for a in found if a.finger == finger]
        assert [(a.label, a.probability) for a in again] == wanted


def test_check_goes_through_each_finger(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Bundle and skin of each; a bundle that is not there, and skins that are not there, with the
    name of the finger."""
    assert main(["check", "--sim", "skin", "--virtual", *TWO]) == 0
    lines = capsys.readouterr().out.splitlines()
    for finger in hands.TWO:
        for part in ("bundle", "golden sweeps", "skin"):
            assert sum(line.startswith(f"ok    {finger} {part}") for line in lines) == 1
    assert main(["check", *TWO, "--set", f"skins.left.bundle={tmp_path}"]) == 1
    lines = capsys.readouterr().out.splitlines()
    failed = [line for line in lines if line.startswith("FAIL")]
    for part in ("left bundle", "left skin", "right skin"):
        assert sum(line.startswith(f"FAIL  {part}") for line in failed) == 1
    assert any(line.startswith("ok    right bundle") for line in lines)


@pytest.mark.parametrize(
    "command",
    [
        ["run", *VIRTUAL, "--capture", "c"],
        ["run", *VIRTUAL, "--set", "classifier.early=true"],
        ["run", "--sim", "skin", "--skin", "matrix"],
        [
            "run",
            *VIRTUAL,
            "--set",
            "skins.left.part=1/2 rows",
            "--set",
            "skins.right.part=2/2 rows",
        ],
    ],
)
def test_what_does_not_work_with_several_skins_is_refused(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """Exit code 78, with the names of the fingers and what to do; no file is left."""
    monkeypatch.chdir(tmp_path)
    assert main([*command, *TWO]) == 78
    said = capsys.readouterr().err
    assert "works with one skin only, and [skins] has left, right; leave it out" in said
    assert [*tmp_path.iterdir()] == []


def test_a_shadow_is_refused_and_the_box_runs(capsys: pytest.CaptureFixture[str]):
    """As any candidate that cannot run: the box serves the robot."""
    assert main(["run", *VIRTUAL, "--shadow", "x", *TWO]) == 0
    said = capsys.readouterr()
    assert "no shadow: --shadow works with one skin only" in said.err
    assert len(answers(said.out)) == 9


FOR_ONE = [
    ["record", *VIRTUAL, "--out", "o"],
    ["skin", "align", "--sim", "skin"],
    ["teach", "--web", "0"],
    ["teach", "--use"],
]


@pytest.mark.parametrize("command", FOR_ONE, ids=" ".join)
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (TWO, "one skin at a time, and [skins] has left, right; give --finger left"),
        ([*TWO, "--finger", "lft"], "'lft' is not among the fingers; [skins] has left, right"),
        ([*TWO, "--finger", ""], "'' is not among the fingers"),
        (["--finger", "left"], "--finger 'left': this box has one skin, [skin]; leave --finger"),
    ],
    ids=["none", "unknown", "empty", "one skin"],
)
def test_a_command_for_one_skin_asks_for_the_finger(
    command: list[str],
    options: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """Exit code 78 and one line with the fingers; no file is left."""
    monkeypatch.chdir(tmp_path)
    assert main([*command, *options]) == 78
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert [*tmp_path.iterdir()] == []


def test_sweeps_of_a_finger_lie_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Each finger has a folder and a count of its own below that of the box, and its name in the
    sidecars, so that a set of all has a group of them. Another finger, or a box with one skin, does
    not record among them."""
    to = ["--set", f"store.folder={tmp_path}"]
    for finger, material in (("left", "wood"), ("right", "foam")):
        words = ["record", *VIRTUAL, *TWO, *to, "--finger", finger, "--material", material]
        assert main(words) == 0
    folder = tmp_path / "sweeps"
    assert {*folder.iterdir()} == {folder / "left", folder / "right"}
    for finger in hands.TWO:
        paths = sorted((folder / finger).glob("*.npy"))
        assert [path.stem[-1] for path in paths] == ["1", "2", "3"]
        assert {sidecar(path)["finger"] for path in paths} == {finger}
    found = sets.load(str(folder))
    assert found.groups["finger"].tolist() == ["left"] * 3 + ["right"] * 3
    capsys.readouterr()
    mixed = ["record", *VIRTUAL, "--out", str(folder / "left")]
    for options in ([*TWO, "--finger", "right"], []):
        assert main([*mixed, *options]) == 78
        assert "sweep-000001.npy is of the finger left; name another folder with --out" in (
            capsys.readouterr().err
        )
    assert main(["record", *VIRTUAL, "--out", str(tmp_path / "one")]) == 0
    assert (
        main(["record", *VIRTUAL, *TWO, "--finger", "left", "--out", str(tmp_path / "one")]) == 78
    )
    assert "is of a box with one skin; name another" in capsys.readouterr().err


@pytest.mark.slow
def test_align_shows_one_finger():
    """With the bundle of a finger its contact positions."""
    words = ["skin", "align", "--sim", "rest", "--finger", "right", *TWO]
    with subprocess.Popen(
        [sys.executable, "-m", "palpate", *words], stdout=subprocess.PIPE, text=True
    ) as align:
        try:
            while "row" not in (line := align.stdout.readline()):
                assert line, "it has ended"
        finally:
            align.terminate()


def test_the_port_of_the_command_is_that_of_the_finger():
    """--port and --skin override the finger's own settings, not those that it does not use."""
    own = ["--set", "skins.left.port=/dev/a", "--set", "skins.right.port=/dev/b"]
    args = arguments("record", [*own, "--finger", "right", "--port", "/dev/c", "--skin", "matrix"])
    settings = load_settings(args)
    assert (settings.skin.port, settings.skin.profile) == ("/dev/c", "matrix")
    assert (
        load_settings(arguments("skin", ["align", *own, "--finger", "right"])).skin.port == "/dev/b"
    )


@pytest.mark.parametrize("command", [["skin", "check"], ["skin", "show"], ["replay", "x"]])
def test_a_finger_may_be_looked_at_alone(command: list[str]):
    """Its skin, and its kept sweeps by its own bundle. Without --finger the commands are as on a
    box with one skin."""
    own = ["--set", "skins.left.port=/dev/a", "--set", "skins.left.bundle=/left", *TWO]
    settings = load_settings(arguments(command[0], [*command[1:], *own, "--finger", "left"]))
    assert (settings.skin.port, str(settings.classifier.bundle)) == ("/dev/a", "/left")
    assert load_settings(arguments(command[0], [*command[1:], *own])).skin.port == ""
    with pytest.raises(ConfigError, match="'middle'"):
        load_settings(arguments(command[0], [*command[1:], *own, "--finger", "middle"]))


def test_skin_check_of_a_finger(capsys: pytest.CaptureFixture[str]):
    """On the simulated board: all parts are ok."""
    assert main(["skin", "check", "--sim", "skin", "--virtual", *TWO, "--finger", "left"]) == 0
    assert all(line.startswith("ok ") for line in capsys.readouterr().out.splitlines())


@pytest.mark.parametrize("setting", ["skins.left.bundle", "classifier.bundle"])
def test_a_bundle_of_the_settings_is_not_taught_into(
    setting: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    """The store has another bundle, which would not run: the setting is named, nothing is
    written."""
    keys = ["--set", f"store.folder={tmp_path / 'store'}", "--set", f"store.keys={tmp_path}"]
    assert (
        main(["teach", "--use", *TWO, *keys, "--set", f"{setting}=/own", "--finger", "left"]) == 78
    )
    assert f"{setting} names the bundle that runs, so a" in capsys.readouterr().err
    assert not (tmp_path / "store").exists()


def test_demo_plays_one_skin(capsys: pytest.CaptureFixture[str]):
    """The settings of a hand do not change the demo."""
    assert main(["demo", "--virtual", "--sweeps", "1", "--raw", *TWO]) == 0
    assert "FIN" not in capsys.readouterr().out


@contextlib.contextmanager
def running(folder: Path) -> Iterator[Callable[..., str]]:
    """A box that runs in real time; gives a function that runs another command beside it."""
    more = ["--set", f"store.runtime={folder}", *TWO]
    command = [sys.executable, "-m", "palpate"]
    with subprocess.Popen(
        [*command, "run", "--sim", "skin", *more], stdout=subprocess.PIPE, text=True
    ) as box:

        def ask(*words: str) -> str:
            return subprocess.run(
                [*command, *words, *more], capture_output=True, text=True, check=False, timeout=120
            ).stdout

        try:
            while ",RES,1," not in box.stdout.readline():
                pass
            yield ask
        finally:
            box.terminate()


@pytest.mark.slow
def test_status_and_watch_name_the_fingers(tmp_path: Path):
    """`status` shows what each finger says to a sweep, `watch --json` its frames and its part of
    the first line."""
    with running(tmp_path) as ask:
        time.sleep(1)
        # on a busy machine a sweep may have another status
        assert re.search(r"sweep +1 .*; left [a-z0-9 .%-]+, right [a-z]", ask("status"))
        report = json.loads(ask("status", "--json"))
        assert [of["finger"] for of in report["verdicts"][-1]["fingers"]] == [*hands.TWO]
        watch = subprocess.Popen(
            [
                *(sys.executable, "-m", "palpate", "watch", "--json"),
                *("--set", f"store.runtime={tmp_path}"),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        with watch:
            lines = [json.loads(watch.stdout.readline()) for _ in range(30)]
            watch.terminate()
    hello = next(line for line in lines if line["type"] == "hello")
    assert [*hello["fingers"]] == [*hands.TWO]
    assert {*hello["fingers"]["left"]} == {"skin", "unit", "bundle", "format", "alignment"}
    frames = [line["finger"] for line in lines if line["type"] == "frame"]
    assert {*frames} == {*hands.TWO}


def test_the_bundles_of_the_fingers_are_named_if_they_differ(
    default_bundle: Bundle, tmp_path: Path
):
    """For `status` and the feed: each with its finger; a bundle for all once, without."""
    own = toy_bundle.load(tmp_path)
    differ = run_command._model(default_bundle, {"left": default_bundle, "right": own})
    m = default_bundle.manifest
    assert differ.startswith(f"left: {m.name} {m.version}, 6 labels; right: ")
    same = f"{m.name} {m.version}, 6 labels"
    assert run_command._model(default_bundle, dict.fromkeys(hands.TWO, default_bundle)) == same
    assert run_command._model(default_bundle, {}) == same


@deliveries.NEEDED
def test_a_bundle_on_trial_is_committed_by_the_hand(tmp_path: Path):
    """The trial counts the answers of the hand that have a label."""
    box = Delivery(tmp_path)
    box.committed(1)
    two = box.installed(2)
    trial = box.store.choose().trial
    assert isinstance(trial, Trial)
    with contextlib.ExitStack() as stack:
        stack.enter_context(trial)
        hand: Rigged = hands.build(stack, hands.acts(21, 6), observers=[trial])
        hand.until(lambda: hand.box.answered == 6)
    assert box.store.choose().trial is None
    assert box.store.choose().bundle.id == two[:8]


def test_a_bundle_is_proved_with_those_of_the_fingers(default_bundle: Bundle, tmp_path: Path):
    """A delivered bundle whose labels do not fit the finger's own bundle is refused before it
    replaces the one in service."""
    toy_bundle.put(tmp_path / "toy", toy_bundle.files())
    settings = load(
        [
            *hands.of(*hands.TWO),
            f"skins.left.bundle={tmp_path / 'toy'}",
            "classifier.allow_unsigned=true",
        ]
    )
    with pytest.raises(ConfigError, match=r"skins.right has other labels"):
        assembly.prove(settings, default_bundle)
    assembly.prove(load(hands.of(*hands.TWO)), default_bundle)
    bad = replace(default_bundle, golden_logits=-default_bundle.golden_logits)
    with pytest.raises(Exception, match="golden sweeps"):
        assembly.prove(load(hands.of(*hands.TWO)), bad)

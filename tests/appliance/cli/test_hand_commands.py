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

from appliance.bundle.bundle import Bundle
from appliance.cli.main import main
from appliance.client.answers import Answer
from appliance.core import sentences
from appliance.core.errors import ConfigError
from appliance.deployment.trial import Trial
from appliance.runtime import assembly
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
        ["record", *VIRTUAL, "--out", "o"],
        ["align", "--sim", "skin"],
        ["teach", "--label", "cork"],
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


def test_demo_plays_one_skin(capsys: pytest.CaptureFixture[str]):
    """The settings of a hand do not change the demo."""
    assert main(["demo", "--virtual", "--sweeps", "1", "--raw", *TWO]) == 0
    assert "FIN" not in capsys.readouterr().out


@contextlib.contextmanager
def running(folder: Path) -> Iterator[Callable[..., str]]:
    """A box that runs in real time; gives a function that runs another command beside it."""
    more = ["--set", f"store.runtime={folder}", *TWO]
    command = [sys.executable, "-m", "appliance"]
    with subprocess.Popen(
        [*command, "run", "--sim", "skin", *more], stdout=subprocess.PIPE, text=True
    ) as box:

        def ask(*words: str) -> str:
            return subprocess.run(
                [*command, *words, *more], capture_output=True, text=True, check=False
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
                *(sys.executable, "-m", "appliance", "watch", "--json"),
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

"""A robot gets answers of signed bundles only, unless a setting allows others; then all outputs say
so."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.cli import devices as cli_devices
from palpate.cli.common import load_settings
from palpate.cli.main import main
from palpate.core.devices import Devices
from palpate.core.types import SweepFormat
from palpate.deployment.enrolment_key import KEY
from palpate.service.status import StatusFile
from tests.factories import deliveries, hands, toy_bundle
from tests.factories.deliveries import Delivery

pytestmark = deliveries.NEEDED
VIRTUAL = ("--sim", "skin", "--virtual", "--sweeps", "1")
ALLOWED = ("--set", "classifier.allow_unsigned=true")
SAID = "unsigned bundles are allowed: classifier.allow_unsigned = true"


@pytest.fixture
def box(tmp_path: Path) -> Delivery:
    """A box before its first delivery."""
    return Delivery(tmp_path)


def of(box: Delivery) -> list[str]:
    """The options that name the box's store, keys and status."""
    how = {
        "store.folder": box.how.folder,
        "store.keys": box.how.keys,
        "store.runtime": box.folder,
    }
    return [word for name, value in how.items() for word in ("--set", f"{name}={value}")]


@pytest.mark.parametrize(
    "command", [("run",), ("check",), ("enrol", "felt", "--out", "new"), ("run", "--shadow")]
)
def test_a_robot_is_answered_by_signed_bundles_alone(
    box: Delivery, command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
):
    """`classifier.bundle` and `--shadow DIR` with an unsigned bundle: refused, with both remedies,
    before anything else."""
    folder = toy_bundle.put(box.folder / "toy", toy_bundle.files())
    if command == ("run", "--shadow"):
        main([*command, str(folder), *of(box)])  # then it ends, because no line is wired
        assert f"no shadow: {folder} is not signed" in capsys.readouterr().err
        return
    code = main([*command, *of(box), "--set", f"classifier.bundle={folder}"])
    output = capsys.readouterr()
    text = output.out + output.err
    assert code == (1 if command == ("check",) else 78)
    assert f"{folder} is not signed; sign the bundle (palpate-train sign)" in text
    assert "classifier.allow_unsigned = true" in text
    assert SAID not in text


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_finger_is_answered_by_signed_bundles_alone(
    box: Delivery, command: str, capsys: pytest.CaptureFixture[str]
):
    """The bundle of one finger has to be signed as well as that of the box."""
    folder = toy_bundle.put(box.folder / "toy", toy_bundle.files())
    two = [*hands.of(*hands.TWO), f"skins.right.bundle={folder}"]
    sets = [word for text in two for word in ("--set", text)]
    assert main([command, *of(box), *sets]) == (1 if command == "check" else 78)
    output = capsys.readouterr()
    assert f"{folder} is not signed; sign the bundle" in output.out + output.err
    main(["check", *of(box), *sets, *ALLOWED])
    assert f"right signatures warning: {SAID}" in capsys.readouterr().out


def test_words_of_a_bundle_do_not_steer_a_terminal(
    box: Delivery, capsys: pytest.CaptureFixture[str]
):
    """A program that took the service over could sign a bundle whose words hold control characters;
    a person may look at it as root."""
    words = {"by": "anna\n\x1b[2Jok    all is well\u202e", "at": "1"}
    one = box.copied(deliveries.files(1, box.key, made={"taught": words}))
    main(["check", *of(box), "--set", f"classifier.bundle={one}"])
    text = capsys.readouterr().out
    assert "taught here by anna??[2Jok    all is well?, 1 UTC" in text
    assert text.replace("\n", "").isprintable()


def test_a_signed_bundle_may_be_named(box: Delivery, capsys: pytest.CaptureFixture[str]):
    """By a person or by this box: `check` loads it, whatever else is missing here."""
    one = box.copied(deliveries.files(1, box.key))
    two = box.copied(deliveries.enrolled(deliveries.files(1, box.key), box.enrolment_key))
    for folder, said in ((one, "6 labels"), (two, "7 labels, cork enrolled from 1")):
        main(["check", *of(box), "--set", f"classifier.bundle={folder}"])
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].startswith("ok    bundle")
        assert f", {said}" in lines[0]


def test_what_answers_no_robot_takes_any_bundle(box: Delivery, capsys: pytest.CaptureFixture[str]):
    """With simulated devices, whose sentences say so."""
    folder = toy_bundle.put(box.folder / "toy", toy_bundle.files())
    sim = ["--sim", "skin", "--virtual", "--set", f"classifier.bundle={folder}"]
    main(["check", *of(box), *sim])
    output = capsys.readouterr()
    assert "ok    bundle         toy 1" in output.out
    assert "signed" not in output.out


def test_the_setting_is_said_at_each_start_by_check_and_by_status(
    box: Delivery, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """While it is on, whatever runs; the status file has it for `palpate status`, and the feed for
    the page."""
    monkeypatch.setattr(StatusFile, "stopping", lambda self: None)
    for options, said in ((ALLOWED, True), ((), False)):
        assert main(["run", *VIRTUAL, *of(box), *options]) == 0
        assert (SAID in capsys.readouterr().err) == said
        main(["status", *of(box)])
        assert (SAID in capsys.readouterr().out) == said
        assert bool(json.loads((box.folder / "status.json").read_text())["unsigned"]) == said
        main(["check", *VIRTUAL[:3], *of(box), *options])
        assert (f"ok    signatures     warning: {SAID}" in capsys.readouterr().out) == said


def test_a_bench_may_allow_unsigned_bundles(box: Delivery, capsys: pytest.CaptureFixture[str]):
    """With the setting an unsigned bundle starts, after a warning. Here the start fails, because no
    trigger line is wired."""
    folder = toy_bundle.put(box.folder / "toy", toy_bundle.files())
    assert main(["run", *of(box), *ALLOWED, "--set", f"classifier.bundle={folder}"]) == 78
    warning, *_, end = capsys.readouterr().err.splitlines()
    assert SAID in warning
    assert "trigger.start has no GPIO line" in end


@pytest.fixture
def sliding(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulator replaces the real devices; the command does not know it."""

    def played(args: argparse.Namespace, format: Callable[[], SweepFormat]) -> Devices:
        args.virtual = True
        return cli_devices.simulated(
            "skin:wood", format(), args, load_settings(args), remember=False
        )

    monkeypatch.setattr("palpate.cli.enrol_command.open_devices", played)


@pytest.mark.slow
def test_an_enrolled_label_comes_into_the_store(
    box: Delivery, sliding: None, capsys: pytest.CaptureFixture[str]
):
    """The new bundle is signed by the box and on trial; the list shows the signers."""
    before = box.committed(1)
    assert main(["enrol", "cork", *of(box)]) == 0
    assert (
        "7 labels; it runs on trial from the next start on: systemctl restart palpate"
        in capsys.readouterr().err
    )
    running = box.store.running()
    assert running.bundle.enrolled == {"cork": 5}
    assert main(["bundles", *of(box)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:2] == ["on", "trial"]
    assert "anna@lab, enrolled here" in lines[1]
    assert before[:8] in lines[2]


@pytest.mark.slow
def test_an_enrolled_folder_is_signed(
    box: Delivery, sliding: None, capsys: pytest.CaptureFixture[str]
):
    """--out DIR: `palpate bundles install DIR` takes it."""
    box.committed(1)
    out = box.folder / "with-cork"
    assert main(["enrol", "cork", "--out", str(out), *of(box)]) == 0
    assert f"use it with palpate bundles install {out}" in capsys.readouterr().err
    assert (out / bundle.ENROLMENT_SIGNATURE).is_file()
    assert main(["bundles", "verify", str(out), *of(box)]) == 0
    assert "signed by anna@lab, enrolled here; all is well" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ((), "key: No such file or directory, so nothing can be enrolled"),
        (("--set", "classifier.early=true"), "early answers cannot name enrolled labels"),
        (ALLOWED, "with classifier.allow_unsigned the enrolment is not signed"),
        (
            VIRTUAL[:3],
            "with --sim the enrolment is not signed, and a box refuses it; give --out DIR",
        ),
    ],
)
def test_what_cannot_be_enrolled_is_told_before_the_robot_sweeps(
    box: Delivery, options: tuple[str, ...], why: str, capsys: pytest.CaptureFixture[str]
):
    """Without a key, with early answers, or unsigned without a folder: one line, exit code 78, no
    sweep."""
    (box.enrolment_key.folder / KEY).unlink()
    assert main(["enrol", "cork", *of(box), *options]) == 78
    output = capsys.readouterr()
    assert why in output.err
    assert len(output.err.splitlines()) == 1
    assert output.out == ""

"""A robot gets answers of signed bundles only, unless a setting allows others and is said."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from palpate.cli.main import main
from palpate.service.status_file import StatusFile
from tests.factories import deliveries, toy_bundle
from tests.factories.deliveries import Delivery

pytestmark = deliveries.NEEDED
ALLOWED = ("--set", "classifier.allow_unsigned=true")
SAID = "unsigned bundles are allowed: classifier.allow_unsigned = true"


@pytest.fixture
def box(tmp_path: Path) -> Delivery:
    """A box before its first delivery."""
    return Delivery(tmp_path)


def of(box: Delivery) -> list[str]:
    """The options that name the box's store, keys and status."""
    how = {"store.folder": box.how.folder, "store.keys": box.how.keys, "store.runtime": box.folder}
    return [word for name, value in how.items() for word in ("--set", f"{name}={value}")]


@pytest.mark.parametrize("command", [("run",), ("check",), ("run", "--shadow")])
def test_a_robot_is_answered_by_signed_bundles_alone(box, command, capsys):
    """In service or as shadow: refused, with both remedies."""
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
    assert "classifier.allow_unsigned" in text
    assert SAID not in text


def test_words_of_a_bundle_do_not_steer_a_terminal(box, capsys):
    """A program that took the service over could sign a bundle whose words hold control characters;
    a person may look at it as root."""
    words = {"by": "anna\n\x1b[2Jok    all is well\u202e", "at": "1"}
    one = box.copied(deliveries.files(1, box.key, made={"taught": words}))
    main(["check", *of(box), "--set", f"classifier.bundle={one}"])
    text = capsys.readouterr().out
    assert "anna??[2Jok" in text
    assert text.replace("\n", "").isprintable()


def test_a_signed_bundle_may_be_named(box, capsys):
    """By a person or by this box: `check` loads it, whatever else is missing here."""
    one = box.copied(deliveries.files(1, box.key))
    two = box.copied(deliveries.enrolled(deliveries.files(1, box.key), box.enrolment_key))
    for folder, said in ((one, "6 labels"), (two, "7 labels, cork enrolled from 1")):
        main(["check", *of(box), "--set", f"classifier.bundle={folder}"])
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].startswith("ok    bundle")
        assert f", {said}" in lines[0]


def test_simulations_take_any_bundle(box, capsys):
    """Sentences say so; with the setting after a warning, here without a trigger line."""
    folder = toy_bundle.put(box.folder / "toy", toy_bundle.files())
    sim = ["--sim", "skin", "--virtual", "--set", f"classifier.bundle={folder}"]
    main(["check", *of(box), *sim])
    output = capsys.readouterr()
    assert "bundle" in output.out
    assert "signed" not in output.out
    folder = toy_bundle.put(box.folder / "toy", toy_bundle.files())
    assert main(["run", *of(box), *ALLOWED, "--set", f"classifier.bundle={folder}"]) == 78
    warning, *_, end = capsys.readouterr().err.splitlines()
    assert SAID in warning
    assert "trigger.start" in end


def test_the_setting_is_said_at_each_start_by_check_and_by_status(box, monkeypatch, capsys):
    """While it is on; status file and feed have it."""
    virtual = ("--sim", "skin", "--virtual", "--sweeps", "1")
    monkeypatch.setattr(StatusFile, "stopping", lambda self: None)
    for options, said in ((ALLOWED, True), ((), False)):
        assert main(["run", *virtual, *of(box), *options]) == 0
        assert (SAID in capsys.readouterr().err) == said
        main(["status", *of(box)])
        assert (SAID in capsys.readouterr().out) == said
        assert bool(json.loads((box.folder / "status.json").read_text())["unsigned"]) == said
        main(["check", *virtual[:3], *of(box), *options])
        assert (f"ok    signatures     warning: {SAID}" in capsys.readouterr().out) == said

"""`palpate demo` with and without a terminal."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle.bundle import Bundle
from palpate.cli.main import main
from palpate.sim import script
from tests.factories import terminals

VIRTUAL = ["--virtual", "--sweeps", "3", "--seed", "7"]


def test_demo_prints_plain_lines_or_sentences_alone(capsys):
    """Truth, answer, sum, next step; raw the same with the same seed."""
    assert main(["demo", *VIRTUAL]) == 0
    out = capsys.readouterr().out
    assert "$PPLP" not in out
    assert out.count("-> ") == 3
    assert out.splitlines()[1].split() == ["felt", "answer", "sure"]
    assert "--raw" in out
    assert "0 of" in out
    assert "--virtual" in out
    assert "\033" not in out
    assert main(["demo", "--raw", *VIRTUAL]) == 0
    first = capsys.readouterr().out
    assert all(line.startswith("$PPLP,") for line in first.splitlines())
    assert first.count(",RES,") == 3
    main(["demo", "--raw", *VIRTUAL])
    assert capsys.readouterr().out == first


@pytest.mark.slow
def test_the_tour_has_each_special_sweep_with_its_right_answer(capsys):
    """A stuck taxel is bridged; an untaught material is unknown; a sweep over two materials is
    unknown; a pulled cable is sensor-lost, and the next sweep is named again. If a new default
    bundle is sure about two materials, demo_script.SEED has to be drawn again."""
    assert main(["demo", "--virtual"]) == 0
    out = capsys.readouterr().out
    rows = [line for line in out.splitlines() if "-> " in line]
    shown = [(row[5:21].strip(), row[25:41].strip(), "✓" in row) for row in rows]
    assert shown == [
        ("wood", "wood", True),
        ("plastic rough", "plastic rough", True),
        ("foam", "foam", True),
        ("cork", "unknown", True),
        ("metal", "metal", True),
        ("metal, then wood", "unknown", True),
        ("paper", "sensor-lost", True),
        ("paper", "paper", True),
    ]
    for about in ("a taxel is stuck", "nobody taught it", "somebody pulled the cable"):
        assert out.count(about) == 1
    assert "8 of 8" in out


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 0, marks=pytest.mark.slow)],
)
def test_ctrl_c_ends_with_its_exit_code(number, code):
    """As the table of exit codes says; SIGTERM is an orderly end."""
    with subprocess.Popen(
        [sys.executable, "-m", "palpate", "demo", "--raw"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as run:
        assert run.stdout
        run.stdout.readline()
        run.send_signal(number)
        run.stdout.read()
        assert run.wait(timeout=30) == code


@pytest.mark.parametrize(("each", "more"), [(4, []), (1, ["--sweeps", "50"])])
def test_demo_of_a_set(each, more, tmp_path, default_bundle, capsys):
    """Each of three materials is shown once, also where the set ends before the sweeps."""

    def played_set(folder: Path, bundle: Bundle, each: int = 4) -> str:
        """A set of three materials, one after the other: the name of its script."""
        samples = np.repeat(bundle.golden[:1], 3 * each, axis=0)
        np.savez(
            folder / "s.npz",
            samples=samples,
            labels=np.repeat(np.arange(3), each),
            materials=["a", "b", "c"],
            rate_hz=bundle.format.rate_hz,
            group_recording=np.repeat(np.arange(3), each),
        )
        return f"replay:{folder / 's.npz'}"

    which = ["--sim", played_set(tmp_path, default_bundle, each)]
    assert main(["demo", *VIRTUAL, *which, *more]) == 0
    out = capsys.readouterr().out
    assert sorted(line.split()[1] for line in out.splitlines() if "-> " in line) == ["a", "b", "c"]
    assert "bundle" in out


def test_a_user_who_may_not_read_the_store_sees_the_packaged_bundle(
    tmp_path, default_bundle, monkeypatch, capsys
):
    """A message says so with the remedy, and the demo plays."""

    def refused(path: object) -> str:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(os, "readlink", refused)
    assert main(["demo", *VIRTUAL, "--set", f"store.folder={tmp_path}"]) == 0
    output = capsys.readouterr()
    assert f"{tmp_path}/current: " in output.err
    assert "palpate" in output.err
    assert output.out.count("-> ") == 3


def test_the_order_of_a_set_depends_on_the_seed_alone():
    """Each sweep once; in each round each material that has one left."""
    labels = np.array([0, 0, 0, 0, 1, 1, 2])
    order = script.in_turn(labels, 1)
    assert sorted(order) == list(range(7))
    assert [sorted(labels[order[:3]]), sorted(labels[order[3:5]]), labels[order[5:]].tolist()] == [
        [0, 1, 2],
        [0, 1],
        [0, 0],
    ]
    assert order == script.in_turn(labels, 1)
    assert order != script.in_turn(labels, 2)


@pytest.mark.slow
def test_a_terminal_gets_colours():
    """The answer has the colour of its status."""
    far, near = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "palpate", "demo", "--virtual", "--sweeps", "1"],
        stdout=near,
        stderr=subprocess.DEVNULL,
    ) as run:
        os.close(near)
        shown = terminals.read(far, run)
        assert terminals.ended(run, shown) == 0
    os.close(far)
    assert b"\033[32mwood" in shown

"""The command palpate-train: options, messages and exit codes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from appliance.core.errors import FormatError
from tests.factories.sweep_sets import easy
from train.cli.main import main
from train.data import sets
from train.models.compact.fit import Fit


@pytest.mark.slow
def test_the_command_splits_and_keeps_the_rest(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """What was not trained on is written as a set, recordings kept; together it is everything."""
    easy(20, pieces=2).save(tmp_path / "easy.npz")
    args = ["fit", "--set", str(tmp_path / "easy.npz"), "--seed", "1", "--steps", "4", "--only", "speed<=2"]
    args += [
        "--split",
        "recording:0.7",
        "--rest",
        str(tmp_path / "rest.npz"),
        "--out",
        str(tmp_path / "new" / "fit.npz"),
    ]
    assert main(args) == 0
    made, rest = Fit.load(tmp_path / "new" / "fit.npz"), sets.load(str(tmp_path / "rest.npz"))
    parts = [set(s.groups["recording"]) for s in (made.train, made.held, rest)]
    whole = easy(20, pieces=2).select(["speed<=2"])
    assert sum(map(len, parts)) == len(set.union(*parts)) == len(np.unique(whole.groups["recording"]))
    assert len(made.train) + len(made.held) + len(rest) == len(whole)
    out = capsys.readouterr().out
    assert "held-out recording, as the box answers: " in out
    assert "held-out recording, network alone: " in out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--set", "none.npz"], "none.npz: not a sweep set"),
        (["--set", "sim:T-LAB:1:1", "--only", "force=1"], "no group 'force'"),
        (["--set", "sim:T-LAB:1:1", "--split", "recording"], "split 'recording' cannot be read"),
        (["--set", "sim:T-LAB:1:1", "--rest", "rest.npz"], "--rest needs --split"),
    ],
)
def test_an_error_of_the_project_is_one_line(
    args: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The exit code of a FormatError and its message on the error stream."""
    assert main(["fit", "--seed", "1", "--out", str(tmp_path / "fit.npz"), *args]) == FormatError.exit_code
    err = capsys.readouterr().err
    assert err.startswith("palpate-train: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_a_reader_that_closes_the_pipe_ends_the_command_quietly():
    """`palpate-train methods | head -1`: exit code 1, and nothing on the error stream."""
    command = [sys.executable, "-m", "train", "methods"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        error = process.stderr.read()
    assert (process.returncode, error) == (1, "")

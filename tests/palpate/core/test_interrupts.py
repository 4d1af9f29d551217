"""Ctrl-C during the imports of both programs, as real processes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

LOADING = """
import os, time
os.write(1, b"loading")
try:
    time.sleep(600)
except BaseException as e:  # as extension modules do
    raise ImportError("initialization failed") from e
"""


def _loading(
    module: str, argv: list[str], library: str, folder: Path, ignored: bool = False
) -> subprocess.Popen[str]:
    """A process of `python -m module` that imports `library`; its errors go to the file `errors`.
    ignored: with SIGINT ignored, else as a terminal starts it, whatever this process has inherited.
    """

    def start() -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])

    (folder / f"{library}.py").write_text(LOADING)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    with (folder / "errors").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *argv],
            env=env,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            preexec_fn=start,
        )
    assert process.stdout
    assert process.stdout.read(len("loading")) == "loading"
    return process


def _ended(process: subprocess.Popen[str], folder: Path) -> tuple[int, str]:
    """The exit code of the process, and its errors."""
    return process.wait(timeout=60), (folder / "errors").read_text()


@pytest.mark.parametrize(
    ("program", "module", "argv", "library"),
    [
        ("palpate", "palpate", ["skin", "list"], "numpy"),
        ("palpate", "palpate", ["check"], "onnxruntime"),
        (
            "palpate-train",
            "palpate_train",
            ["evaluate", "--list"],
            "numpy",
        ),  # while the program is imported
        ("palpate-train", "palpate_train", ["evaluate", "--list"], "onnx"),  # while the command is
    ],
)
def test_ctrl_c_during_the_imports_is_one_line(program, module, argv, library, tmp_path):
    """Exit code 130, although the library makes another error of an exception."""
    process = _loading(module, argv, library, tmp_path)
    process.send_signal(signal.SIGINT)
    code, err = _ended(process, tmp_path)
    assert code == 130
    assert re.fullmatch(f"{program}: interrupted .*\n", err)


@pytest.mark.slow
def test_ctrl_c_during_a_late_import_is_one_line(tmp_path):
    """Exit code 130, although it looks like a missing library."""
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "cork.parquet").write_bytes(b"PAR1")
    argv = ["import", "tables", "--pattern", "{material}.parquet", "--rate", "9", "--out", "s.npz"]
    process = _loading("palpate_train", argv, "pyarrow", tmp_path)
    process.send_signal(signal.SIGINT)
    line = "palpate-train: interrupted; the same command begins anew\n"
    assert _ended(process, tmp_path) == (130, line)


def test_ctrl_c_that_is_ignored_stays_ignored(tmp_path):
    """A program in the background of a script goes on importing; SIGTERM ends it."""
    process = _loading("palpate", ["skin", "list"], "numpy", tmp_path, ignored=True)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGTERM)
    assert _ended(process, tmp_path) == (-signal.SIGTERM, "")

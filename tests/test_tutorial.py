"""The tutorial's commands run as on the page, and print the lines that it shows."""

import os
import re
import shlex
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

PAGE = ROOT / "docs" / "tutorials" / "first-model.md"
COMMAND = re.compile(r"(?m)^    ((?:python|palpate|palpate-train) .*)$")
BOX = re.compile(r"(?m)^    mkdir -p build/box; (palpate run .*)$")


def check_page_of_box(folder: Path, environment: dict[str, str], watch: str) -> None:
    """The last step: the box runs with the new bundle, and the page gets a verdict of it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (folder / "build" / "box").mkdir()
    lines = [*BOX.findall(PAGE.read_text("utf-8")), watch.replace("--web", f"--web {port}")]
    environment = environment | {"PWD": str(folder)}
    with ExitStack() as stack:
        for line in lines:
            run = subprocess.Popen(
                ["sh", "-c", f"exec {line}"],
                cwd=folder,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(run.wait)
            stack.callback(run.terminate)
        until_answers(port)
        with urllib.request.urlopen(f"http://localhost:{port}/events", timeout=60) as events:
            text = ""
            while '"model":"first 1' not in text or "event: verdict" not in text:
                text += events.readline().decode()


def until_answers(port: int) -> None:
    """Wait until a server listens at the port; fails after a minute."""
    end = time.monotonic() + 60
    while True:
        with suppress(OSError), socket.create_connection(("localhost", port), timeout=1):
            return
        assert time.monotonic() < end, "the page does not answer"
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.thorough
def test_the_commands_of_the_tutorial_run(tmp_path: Path):
    """In their order, in a folder of their own: recordings, import, fit, export, score, demo."""
    minutes = 15
    # Lines of the page that do not depend on the machine
    shown = (
        "162 files in build/recordings, materials: metal, wood, paper, plastic rough",
        "time,s0,s1,s2,s3,s4,s5,s6,s7,s8,s9,s10,s11,s12,s13,s14,s15",
        "classified correctly: 31 of 36: 86.1 % [71.3, 94.4], 95 % interval, by position (2)",
        "classified correctly: 35 of 36: 97.2 % [85.8, 100.0], 95 % interval, by position (2)",
    )
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "build").mkdir()
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    commands = COMMAND.findall(PAGE.read_text("utf-8"))
    assert [shlex.split(command)[:2][-1] for command in commands] == [
        *("docs/tutorials/csv_sweeps.py", "import", "fit", "export", "score", "export"),
        *("score", "demo", "report", "watch"),
    ]
    output = ""
    begun = time.monotonic()
    for command in commands[:-1]:
        done = subprocess.run(
            shlex.split(command),
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
        assert done.returncode == 0, done.stderr
        output += done.stdout
    assert time.monotonic() - begun < 60 * minutes
    assert "<h1" in (tmp_path / "build" / "first-fit.html").read_text()
    check_page_of_box(tmp_path, environment, commands[-1])
    output += (tmp_path / "build" / "recordings" / "wood_p3_2.csv").read_text()
    for line in shown:
        assert line in PAGE.read_text("utf-8")
        assert line in output

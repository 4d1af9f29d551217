"""The bridge to ROS 2 and a second node: two processes over loopback, in the Python with ROS 2."""

import json
import os
import subprocess
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

from tests.factories.bridges import LONG_S, eventually
from tests.factories.paths import ROOT, SOURCES

PYTHON = ROOT / os.environ.get("PALPATE_ROS", "build/ros") / "bin" / "python"
"""The Python of `python -m tests.campaigns ros`. PALPATE_ROS names another environment; then a
missing ROS 2 is a failure.
"""


def required() -> None:
    """Skip the test without ROS 2, or fail if PALPATE_ROS is set."""
    if not PYTHON.exists():
        if "PALPATE_ROS" in os.environ:
            pytest.fail(f"{PYTHON} is not there; python -m tests.campaigns ros installs it")
        pytest.skip("no ROS 2 here; python -m tests.campaigns ros installs it (255 MB)")


def messages_required() -> None:
    """Fail if ROS 2 is installed without palpate_msgs."""
    package = PYTHON.parent.parent / "share" / "palpate_msgs" / "package.xml"
    assert package.exists(), f"{package} is not there; python -m tests.campaigns ros builds it"


def environment() -> dict[str, str]:
    """Variables for loopback only and a ROS domain of this process."""
    here = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONPATH": SOURCES}
    return os.environ | here | {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}


class RosPeer:
    """The second node: its messages by topic, and the results of its calls."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.heard: list[dict[str, Any]] = []
        self._process = process
        threading.Thread(target=self._listen, daemon=True).start()
        eventually(lambda: self.on("ready") != [])

    def on(self, topic: str) -> list[dict[str, Any]]:
        """The messages of a topic."""
        return [line for line in [*self.heard] if line.get("topic") == topic]

    def last(self, topic: str) -> Mapping[str, Any]:
        """Wait for a message of a topic; returns the last."""
        eventually(lambda: self.on(topic) != [])
        return self.on(topic)[-1]

    def call(self, name: str) -> dict[str, Any]:
        """Call a service or a transition; returns its answer."""
        before = self._answers(name)
        self._write(name)
        eventually(lambda: len(self._answers(name)) > len(before))
        return self._answers(name)[-1]

    def sweep(self, **terms: float | bool) -> None:
        """Send a goal to the action. Its feedback and results come as topics."""
        self._write(json.dumps(terms))

    def cancel(self) -> None:
        """Cancel the goal that was accepted last."""
        self._write("cancel")

    def _write(self, line: str) -> None:
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def _answers(self, name: str) -> list[dict[str, Any]]:
        return [line for line in [*self.heard] if line.get("service") == name]

    def _listen(self) -> None:
        for line in self._process.stdout:
            self.heard.append(json.loads(line))


@contextmanager
def peer() -> Iterator[RosPeer]:
    """Run the second node."""
    script = ROOT / "tests" / "robots" / "ros_peer.py"
    command = [PYTHON, str(script)]
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
    pipes["stderr"] = subprocess.DEVNULL
    with subprocess.Popen(command, env=environment(), text=True, **pipes) as process:
        try:
            yield RosPeer(process)
        finally:
            process.kill()


@contextmanager
def bridge(
    *parameters: str, log: int = subprocess.DEVNULL, **variables: str
) -> Iterator[subprocess.Popen[bytes]]:
    """Run the bridge as a node. log: file for its log. variables: environment variables."""
    command = [PYTHON, "-m", "palpate.bridges", "ros", "--ros-args", *parameters]
    with subprocess.Popen(command, cwd=ROOT, env=environment() | variables, stderr=log) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(LONG_S)
            finally:  # otherwise the test waits forever for a node that does not end
                process.kill()

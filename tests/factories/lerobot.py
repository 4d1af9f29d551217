"""LeRobot: a Python that has it, stand-ins for its names elsewhere, and a feed for its plug-in."""

import contextlib
import importlib.util
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar
from unittest import mock

import pytest

from tests.factories import feed_lines
from tests.factories.paths import ROOT

PYTHON = ROOT / os.environ.get("PALPATE_LEROBOT", "build/lerobot") / "bin" / "python"
"""The Python of an environment with LeRobot and the plug-in. PALPATE_LEROBOT names another; then a
missing LeRobot is a failure.
"""
PLUGIN = ROOT / "appliance" / "plugins" / "lerobot"
NAME = "lerobot_camera_palpate"


def required() -> None:
    """Skip the test without LeRobot, or fail if PALPATE_LEROBOT is set."""
    if PYTHON.exists():
        return
    if "PALPATE_LEROBOT" in os.environ:
        pytest.fail(f"{PYTHON} is not there")
    pytest.skip(
        "no LeRobot here (6 GB); python3 -m venv build/lerobot, then "
        "build/lerobot/bin/pip install -e .[lerobot] -e appliance/plugins/lerobot"
    )


def run(script: str, *arguments: str | Path) -> Any:
    """Run a script in the Python with LeRobot; the JSON of its last line."""
    variables = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    done = subprocess.run(
        [PYTHON, "-c", script, *map(str, arguments)],
        env=variables, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


class StandInConfig:
    """The base of configurations, which registers them by name."""

    known: ClassVar[dict[str, type]] = {}

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        return lambda made: cls.known.setdefault(name, made)


class StandInCamera:
    """The base of cameras."""

    def __init__(self, config: Any) -> None:
        self.fps, self.width, self.height = config.fps, config.width, config.height


def plugin() -> ModuleType:
    """The plug-in, with stand-ins for the names of LeRobot that it uses."""
    names = ("lerobot", "lerobot.cameras", "lerobot.utils", "lerobot.utils.errors")
    modules = {name: ModuleType(name) for name in names}
    vars(modules["lerobot.cameras"]).update(Camera=StandInCamera, CameraConfig=StandInConfig)
    vars(modules["lerobot.utils.errors"]).update(
        DeviceAlreadyConnectedError=type("DeviceAlreadyConnectedError", (ConnectionError,), {}),
        DeviceNotConnectedError=type("DeviceNotConnectedError", (ConnectionError,), {}),
    )
    spec = importlib.util.spec_from_file_location(NAME, PLUGIN / f"{NAME}.py")
    assert spec
    assert spec.loader
    made = importlib.util.module_from_spec(spec)
    with mock.patch.dict(sys.modules, modules | {NAME: made}):
        spec.loader.exec_module(made)
    return made


class PlayedFeed:
    """A box's feed at `path`: `greeting`, then the test's lines. asked: requests."""

    def __init__(self, path: Path, *greeting: Mapping[str, Any]) -> None:
        self.asked: list[dict[str, Any]] = []
        self._greeting, self._readers = greeting, list[socket.socket]()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        threading.Thread(target=self._accept, daemon=True).start()

    def say(self, *lines: Mapping[str, Any]) -> None:
        """Send lines to all readers."""
        for reader in [*self._readers]:
            with contextlib.suppress(OSError):  # a reader that has gone
                reader.sendall(b"".join(json.dumps(line).encode() + b"\n" for line in lines))

    def close(self) -> None:
        for one in (self._listener, *self._readers):
            one.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # the test has ended
            while True:
                reader, _ = self._listener.accept()
                self.asked.append(json.loads(reader.recv(1000)))
                reader.sendall(b"".join(json.dumps(x).encode() + b"\n" for x in self._greeting))
                self._readers.append(reader)


@contextlib.contextmanager
def played(path: Path, **hello: Any) -> Iterator[PlayedFeed]:
    """A feed of a streaming box with a skin of 4x4 taxels and trained positions."""
    feed = PlayedFeed(path, feed_lines.hello(**hello), feed_lines.health(1))
    try:
        yield feed
    finally:
        feed.close()

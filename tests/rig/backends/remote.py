"""The virtual box as a backend: the drivers run in the guest, the devices are outside.

Requests over a character device control the devices: JSON lines, one request, one reply. Outside,
`serve` answers them with an object that has the controls in CONTROLS. `able` returns its
capabilities, as in `can`. `reset` does not touch the cable.
"""

import json
import os
import select
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from typing import IO, Any

import usb.core

from palpate.core import config
from tests.rig.backends import BackendMissing, Skin, real

PORT = "/dev/virtio-ports/palpate.bench"
CONTROLS = ["able", "reset", "plug", "unplug", "garble", "silence"]
CONTROLS += ["drive", "storm", "level", "say", "hear", "pull", "put"]
ANSWER_S = 60


def serve(stream: IO[bytes], bench: Any) -> None:
    """Carry out the requests of `stream` on `bench` until it ends. Errors go back as text."""
    for line in stream:
        asked = json.loads(line)
        try:
            if asked["do"] not in CONTROLS:
                raise ValueError(
                    f"{asked['do']!r} is not a control; known are {', '.join(CONTROLS)}"
                )
            reply = {"did": _pack(getattr(bench, asked["do"])(*map(_unpack, asked["with"])))}
        except Exception as e:
            reply = {"failed": f"{type(e).__name__}: {e}"}
        stream.write(json.dumps(reply).encode() + b"\n")
        stream.flush()


def _pack(value: Any) -> Any:
    """A value with bytes and skins in JSON types."""
    if isinstance(value, bytes):
        return {"bytes": value.hex()}
    return {"skin": asdict(value)} if isinstance(value, Skin) else value


def _unpack(value: Any) -> Any:
    """The inverse of `_pack`."""
    if isinstance(value, dict) and "bytes" in value:
        return bytes.fromhex(value["bytes"])
    return Skin(**value["skin"]) if isinstance(value, dict) else value


class Asker:
    """The guest's end. Raises TimeoutError without an answer, AssertionError for a failure."""

    def __init__(self, file: int) -> None:
        self._file, self._one, self._rest = file, threading.Lock(), b""

    def ask(self, control: str, *given: Any) -> Any:
        """Have a control carried out outside; returns its result."""
        request = (
            json.dumps({"do": control, "with": [_pack(value) for value in given]}).encode() + b"\n"
        )
        with self._one:
            while request:
                request = request[os.write(self._file, request) :]
            while b"\n" not in self._rest:
                if not select.select([self._file], [], [], ANSWER_S)[0]:
                    raise TimeoutError(
                        f"no answer to {control} from outside within {ANSWER_S} s; "
                        "is `serve` running?"
                    )
                self._rest += os.read(self._file, 65536)
            line, _, self._rest = self._rest.partition(b"\n")
        reply = json.loads(line)
        assert "failed" not in reply, f"{control} failed outside: {reply['failed']}"
        return _unpack(reply["did"])


class Remote(real.Real):
    """The guest's kernel. An emulated processor reads a line long after its interrupt."""

    name = "remote"
    slack_s = 20.0
    pulse_s = 0.25

    def __init__(self, stack: ExitStack, asker: Asker) -> None:
        super().__init__(stack)
        settings = config.load(None)
        self.sensor, self.trigger, self.output = settings.skin, settings.trigger, settings.output
        self.serial = settings.serial
        self._ask = asker.ask
        for name in ("garble", "silence", "drive", "storm", "level", "say", "hear", "pull", "put"):
            setattr(self, name, partial(asker.ask, name))
        self.can = frozenset(self._ask("able")) | {"hold"}

    def reset(self) -> None:
        self.settle()
        self._ask("reset")
        self.plug(Skin())

    def plug(self, what: Skin) -> None:
        """Plug in outside, and wait until the guest's kernel and udev have found the skin."""
        self.unplug()
        self._ask("plug", what)
        self._until_there(True)

    def unplug(self) -> None:
        """Unplug outside, and wait until the guest has noticed it."""
        self._ask("unplug")
        self._until_there(False)

    def _until_there(self, wanted: bool) -> None:
        ids = {"idVendor": self.sensor.vendor_id, "idProduct": self.sensor.product_id}
        end_ns = self.clock.now_ns() + ANSWER_S * 1_000_000_000
        while (usb.core.find(**ids) is not None) != wanted:
            assert self.clock.now_ns() < end_ns, "the kernel does not notice the skin's cable"
            self.wait(0.01)


@contextmanager
def opened() -> Iterator[Remote]:
    """The machine of this process. Raises BackendMissing if it has no bench outside."""
    try:
        file = os.open(PORT, os.O_RDWR)
    except OSError as e:
        raise BackendMissing(
            f"no bench at {PORT} ({e.strerror}); "
            "this runs in the virtual box: python -m tests.campaigns test-rig"
        ) from e
    with ExitStack() as stack:
        stack.callback(os.close, file)
        yield Remote(stack, Asker(file))

"""Bridges as separate processes, as they run beside a box, and their clients."""

from __future__ import annotations

import re
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

LONG_S = 30.0


def page_blocks(page: str, language: str) -> list[str]:
    """The code blocks in this language on a page in docs/robots."""
    return re.findall(
        rf"```{language}\n(.*?)```", (ROOT / "docs" / "robots" / page).read_text(), re.S
    )


def eventually(there: Callable[[], bool]) -> None:
    """Wait until another process has made `there` true; fails after LONG_S."""
    for _ in range(round(LONG_S / 0.02)):
        if there():
            return
        threading.Event().wait(0.02)
    pytest.fail(f"the condition did not hold within {LONG_S} s")


@contextmanager
def bridge(kind: str, *options: str | Path) -> Iterator[tuple[str, int]]:
    """Run a bridge; yields its address."""
    command = [sys.executable, "-m", "palpate.bridges", kind, "--listen", "127.0.0.1:0"]
    command += map(str, options)
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = []
            for line in process.stderr:
                said.append(line)
                found = re.search(r"listening on ([\d.]+):(\d+)", line)
                if found:
                    break
            else:
                pytest.fail("".join(said))
            threading.Thread(target=process.stderr.read, daemon=True).start()
            yield found[1], int(found[2])
            assert process.poll() is None, "the bridge has ended before the test did"
        finally:
            process.terminate()
            try:
                process.wait(LONG_S)
            except subprocess.TimeoutExpired:  # otherwise closing its pipe waits forever
                process.kill()
                raise


class RawModbus:
    """A Modbus TCP client that builds its bytes from the specification alone."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.socket = socket.create_connection(address, timeout=LONG_S)

    def __enter__(self) -> RawModbus:
        return self

    def __exit__(self, *reason: object) -> None:
        self.socket.close()

    def send(self, pdu: bytes, transaction: int = 1, unit: int = 255) -> None:
        self.socket.sendall(struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu)

    def receive(self) -> bytes:
        """The bytes of the next reply."""
        head = self._exactly(6)
        return head + self._exactly(int.from_bytes(head[4:], "big"))

    def ask(self, pdu: bytes) -> bytes:
        """Send a request. Returns the function code and the data of the reply."""
        self.send(pdu)
        return self.receive()[7:]

    def registers(self, address: int, count: int) -> list[int]:
        data = self.ask(struct.pack(">BHH", 4, address, count))
        assert data[:2] == bytes([4, 2 * count]), data.hex()
        return list(struct.unpack(f">{count}H", data[2:]))

    def _exactly(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            more = self.socket.recv(n - len(data))
            if not more:
                raise ConnectionError("the bridge has closed")
            data += more
        return data

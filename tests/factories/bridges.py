"""Bridges in threads, and their clients."""

from __future__ import annotations

import argparse
import asyncio
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from pathlib import Path

import pytest

from palpate.bridges import command, serve
from palpate.bridges.options import PORTS, add_arguments

LONG_S = 30.0


def eventually(there: Callable[[], bool]) -> None:
    """Wait until another process has made `there` true; fails after LONG_S."""
    for _ in range(round(LONG_S / 0.02)):
        if there():
            return
        threading.Event().wait(0.02)
    pytest.fail(f"the condition did not hold within {LONG_S} s")


@contextmanager
def bridge(kind: str, *options: str | Path) -> Iterator[tuple[str, int]]:
    """Run a bridge in a thread; yields its address, ("", 0) where it does not listen."""
    listen = ("--listen", "127.0.0.1:0") if kind in PORTS else ()
    parser = argparse.ArgumentParser("bridge")
    add_arguments(parser)
    args = parser.parse_args([kind, *listen, *map(str, options)])
    there: Future[tuple[str, int]] = Future()
    ended, ends = Future[int](), []

    def stop_code() -> asyncio.Future[int]:
        loop = asyncio.get_running_loop()
        stop = loop.create_future()
        ends.append(lambda: loop.call_soon_threadsafe(stop.set_result, 0))
        return stop

    class StopSwitch(threading.Event):
        exit_code = 0
        __call__ = threading.Event.is_set

        def __init__(self) -> None:
            super().__init__()
            ends.append(self.set)
            there.set_result(("", 0))

    def work() -> None:
        try:
            ended.set_result(command.run(args))
        except BaseException as e:
            ended.set_exception(e)
            there.cancel()

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(serve, "stop_code", stop_code)
        patched.setattr(serve, "_say", lambda args, server, box: there.set_result(server.address))
        patched.setattr(command, "StopFlag", StopSwitch)
        threading.Thread(target=work, daemon=True).start()
        try:
            address = there.result(LONG_S)
        except CancelledError:
            ended.result()
            raise
    try:
        yield address
        assert not ended.done(), "the bridge has ended before the test did"
    finally:
        ends[-1]()
        assert ended.result(LONG_S) == 0


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

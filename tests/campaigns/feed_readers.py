"""Programs at the box's feed, good and bad: `python -m tests.campaigns.feed_readers PATH KIND`,
until standard input ends.

PATH is the socket, KIND one of KINDS. Prints a line of JSON with the number of lines that they got.
All are in one process, which pauses between its rounds, so it takes less than a core. It has normal
priority, also if its parent has another.
"""

from __future__ import annotations

import json
import os
import random
import select
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack

from palpate.client.feed import parse
from palpate.core.errors import FormatError
from tests.factories.paths import ROOT

ALL = b'{"frames": 20, "sweeps": true}\n'
PAUSE_S = 0.002
STORM = 1000
"""Number of connections that are open at once while the feed is attacked. The box has refused most
of them or not accepted them yet."""
KINDS = ("0", "1", "8", "64", "attacked", "bridge")

Act = Callable[[], None]
Address = str | tuple[str, int]


def connected(address: Address) -> socket.socket | None:
    """A connection that does not wait; None if the socket has no room for it now. address: of a
    local socket or of TCP."""
    family = socket.AF_UNIX if isinstance(address, str) else socket.AF_INET
    one = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    try:
        one.connect(address)
    except BlockingIOError:
        if family == socket.AF_INET:  # the connection is being made
            return one
        one.close()
        return None
    except OSError:
        one.close()
        return None
    return one


def send(one: socket.socket, data: bytes) -> bool:
    """Send as much as possible; False if the connection has ended."""
    try:
        one.send(data)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return True


def peer(address: Address, goes_on: Callable[[socket.socket], bool], opening: bytes = b"") -> Act:
    """A program with one connection, on which it first sends `opening`. It connects again once
    `goes_on`, called in each round, has returned False or raised OSError."""
    held: list[socket.socket] = []

    def act() -> None:
        if not held:
            if one := connected(address):
                send(one, opening)
                held.append(one)
            return
        try:
            ended = not goes_on(held[0])
        except BlockingIOError:
            ended = False
        except OSError:
            ended = True
        if ended:
            held.pop().close()

    return act


def reader(path: str, seen: Counter[str]) -> Act:
    """A reader that asks for everything and reads it; the lines are counted by type."""
    rest = b""

    def goes_on(one: socket.socket) -> bool:
        nonlocal rest
        try:
            while data := one.recv(1 << 16):
                lines, rest = parse(data, rest)
                seen.update(line["type"] for line in lines)
                seen["lines lost"] += sum(line["lines"] for line in lines if line["type"] == "lost")
        except BlockingIOError:
            return True
        except (OSError, FormatError):
            seen["broken"] += 1
        rest = b""
        return False

    return peer(path, goes_on, ALL)


def silent(path: str) -> Act:
    """A reader that asks for everything and never reads."""
    return peer(path, lambda one: True, ALL)


def sluggish(path: str) -> Act:
    """A reader that asks for everything and reads a few bytes now and then."""
    return peer(path, lambda one: random.random() >= 0.002 or bool(one.recv(10)), ALL)


def talker(
    path: Address, seen: Counter[str], said: Callable[[], bytes], *, reads: bool = False
) -> Act:
    """A peer that sends without end. reads: it reads the replies."""
    known: set[int] = set()

    def goes_on(one: socket.socket) -> bool:
        seen["attempts"] += id(one) not in known
        known.clear()
        known.add(id(one))
        if reads and select.select([one], [], [], 0)[0] and not one.recv(1 << 16):
            return False
        return send(one, said())

    return peer(path, goes_on)


def storm(path: Address, seen: Counter[str], half: bytes = b'{"fra', burst: int = 20) -> Act:
    """Hundreds of connections: as many as the box lets wait, held until there are STORM; then the
    oldest end. half: incomplete request that some of them send. burst: number of connections in a
    round."""
    held: list[socket.socket] = []

    def act() -> None:
        for _ in range(burst):
            one = connected(path)
            if one is None:
                break
            seen["attempts"] += 1
            if random.random() < 0.3:
                send(one, half)
            held.append(one)
            if len(held) > STORM:
                held.pop(0).close()
        if held and random.random() < 0.5:
            held.pop(random.randrange(len(held))).close()

    return act


def noise() -> bytes:
    """Up to 3 kB of nothing."""
    return random.randbytes(random.randrange(1, 3000))


def acts(kind: str, path: str, seen: Counter[str]) -> list[Act]:
    """The programs of a kind. Of 8 and 64 readers, one never reads; attacked: eight good readers
    and all bad programs."""
    if kind != "attacked":
        n = int(kind)
        return [reader(path, seen) for _ in range(n - (n > 1))] + [silent(path)] * (n > 1)
    orders = b'{"frames": 20}\n{"sweeps": false}\n' * 200
    return [
        *(reader(path, seen) for _ in range(8)),
        *(sluggish(path) for _ in range(10)),
        *(silent(path) for _ in range(10)),
        *(talker(path, seen, lambda: orders) for _ in range(10)),
        *(talker(path, seen, noise) for _ in range(10)),
        *(talker(path, seen, lambda: b"x" * 300) for _ in range(5)),
        storm(path, seen),
    ]


def asker(address: Address, seen: Counter[str], request: bytes) -> Act:
    """A peer that asks again when it has its answer, as a controller does; its answers are
    counted."""
    asked: list[socket.socket] = []

    def goes_on(one: socket.socket) -> bool:
        if one not in asked:
            asked[:] = [one] if one.send(request) else []
            return True
        answered = bool(one.recv(1 << 12))
        seen["answers of the bridge"] += answered
        asked.clear()
        return answered

    return peer(address, goes_on)


def bridged(path: str, seen: Counter[str], stack: ExitStack) -> list[Act]:
    """A Modbus bridge on the feed, whose own port is attacked with floods of requests, garbage,
    endless frames and a storm."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "palpate", "bridge", "modbus", "--feed", path]
    command += ["--listen", f"127.0.0.1:{port}"]
    bridge = stack.enter_context(subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=ROOT))
    stack.callback(bridge.kill)
    there = ("127.0.0.1", port)
    read = b"\0\1\0\0\0\6\1\3\0\0\0\x0a"  # ten holding registers from the first
    return [
        asker(there, seen, read),
        *(talker(there, seen, lambda: read * 50) for _ in range(5)),
        *(talker(there, seen, noise) for _ in range(5)),
        *(talker(there, seen, lambda: b"\0\1\0\0\0\xff") for _ in range(3)),
        storm(there, seen),
    ]


def main(path: str, kind: str) -> None:
    """Run until standard input ends."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    seen: Counter[str] = Counter()
    with ExitStack() as stack:
        all_acts = bridged(path, seen, stack) if kind == "bridge" else acts(kind, path, seen)
        while not select.select([sys.stdin], [], [], 0)[0]:
            for act in all_acts:
                act()
            time.sleep(PAUSE_S if all_acts else 0.1)
    print(json.dumps(seen))


if __name__ == "__main__":
    main(*sys.argv[1:])

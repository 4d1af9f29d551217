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
from contextlib import ExitStack, suppress

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


def reader(path: str, seen: Counter[str]) -> Act:
    """A reader that asks for everything and reads it; the lines are counted by type."""
    one: socket.socket | None = None
    rest = b""

    def act() -> None:
        nonlocal one, rest
        if one is None:
            one, rest = connected(path), b""
            if one:
                send(one, ALL)
            return
        try:
            while data := one.recv(1 << 16):
                lines, rest = parse(data, rest)
                seen.update(line["type"] for line in lines)
                seen["lines lost"] += sum(line["lines"] for line in lines if line["type"] == "lost")
            one = None
        except BlockingIOError:
            pass
        except (OSError, FormatError):
            seen["broken"] += 1
            one = None

    return act


def silent(path: str, seen: Counter[str]) -> Act:
    """A reader that asks for everything and never reads."""
    held: list[socket.socket] = []

    def act() -> None:
        if not held and (one := connected(path)):
            send(one, ALL)
            held.append(one)

    return act


def sluggish(path: str, seen: Counter[str]) -> Act:
    """A reader that asks for everything and reads a few bytes now and then."""
    held: list[socket.socket] = []

    def act() -> None:
        if not held:
            silent_one = connected(path)
            held.extend([silent_one] if silent_one else [])
            if held:
                send(held[0], ALL)
        elif random.random() < 0.002:
            with suppress(OSError):
                if not held[0].recv(10):
                    held.clear()

    return act


def talker(
    path: Address, seen: Counter[str], said: Callable[[], bytes], *, reads: bool = False
) -> Act:
    """A peer that sends without end, and connects again when it is closed. reads: it reads the
    replies."""
    held: list[socket.socket] = []

    def goes_on() -> bool:
        if reads and select.select(held, [], [], 0)[0]:
            with suppress(OSError):
                return bool(held[0].recv(1 << 16)) and send(held[0], said())
            return False
        return send(held[0], said())

    def act() -> None:
        if not held:
            one = connected(path)
            held.extend([one] if one else [])
            seen["attempts"] += len(held)
        elif not goes_on():
            held.pop().close()

    return act


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


def acts(kind: str, path: str, seen: Counter[str]) -> list[Act]:
    """The programs of a kind. Of 8 and 64 readers, one never reads; attacked: eight good readers
    and all bad programs."""
    if kind != "attacked":
        n = int(kind)
        return [reader(path, seen) for _ in range(n - (n > 1))] + [silent(path, seen)] * (n > 1)
    bad: Counter[str] = Counter()
    floods = [
        talker(path, bad, lambda: b'{"frames": 20}\n{"sweeps": false}\n' * 200) for _ in range(10)
    ]
    garbage = [
        talker(path, bad, lambda: random.randbytes(random.randrange(1, 3000))) for _ in range(10)
    ]
    endless = [talker(path, bad, lambda: b"x" * 300) for _ in range(5)]
    good = [reader(path, seen) for _ in range(8)]
    slow = [sluggish(path, bad) for _ in range(10)] + [silent(path, bad) for _ in range(10)]

    def note() -> None:
        seen["attempts"] = bad["attempts"]

    return [*good, *slow, *floods, *garbage, *endless, storm(path, bad), note]


def asker(address: Address, seen: Counter[str], request: bytes) -> Act:
    """A peer that asks again when it has its answer, as a controller does; its answers are
    counted."""
    held: list[socket.socket] = []
    asked = False

    def act() -> None:
        nonlocal asked
        if not held:
            one, asked = connected(address), False
            held.extend([one] if one else [])
            return
        try:
            if not asked:
                asked = held[0].send(request) > 0
            elif data := held[0].recv(1 << 12):
                seen["answers of the bridge"] += bool(data)
                asked = False
            else:
                held.pop().close()
        except BlockingIOError:
            pass
        except OSError:
            held.pop().close()

    return act


def bridged(path: str, seen: Counter[str], stack: ExitStack) -> list[Act]:
    """A Modbus bridge on the feed, whose own port is attacked with floods of requests, garbage,
    endless frames and a storm."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [
        *(sys.executable, "-m", "palpate", "bridge", "modbus", "--feed", path),
        *("--listen", f"127.0.0.1:{port}"),
    ]
    bridge = stack.enter_context(subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=ROOT))
    stack.callback(bridge.kill)
    there = ("127.0.0.1", port)
    read = b"\0\1\0\0\0\6\1\3\0\0\0\x0a"  # ten holding registers from the first
    floods = [talker(there, seen, lambda: read * 50) for _ in range(5)]
    garbage = [
        talker(there, seen, lambda: random.randbytes(random.randrange(1, 3000))) for _ in range(5)
    ]
    good = asker(there, seen, read)
    return [
        good,
        *floods,
        *garbage,
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

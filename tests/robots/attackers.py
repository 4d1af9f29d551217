"""Hostile programs, and good ones, at a bridge, at the page or at the feed: `python -m
tests.robots.attackers KIND WHERE`, until standard input ends.

KIND is modbus, opcua, tcp, page or feed, WHERE its port on loopback or its local socket. Prints a
line of JSON with the number of connections and the answers that good peers got. All peers are in
one process of low priority. It pauses between its rounds, so it takes less than a core.
"""

import json
import os
import random
import select
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial

from palpate.client.feed import parse
from palpate.core.errors import FormatError
from palpate.core.sentences import sentence

READ = bytes.fromhex("000100000006ff0400000028")
"""A request of Modbus TCP for all registers."""
HELLO = b"HELF" + struct.pack("<7I", 32, 0, 65535, 65535, 1 << 20, 17, 0)
"""The first message of OPC UA, with an empty URL; it is answered."""
ASK = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
FLOODS = {
    "modbus": (READ * 50, b"\0\1\0\0\0\xff"),
    "opcua": (
        HELLO,
        HELLO * 50,
        HELLO + b"OPNF" + struct.pack("<2I", 200, 0) + b"\xff" * 192,
        b"MSGF" + struct.pack("<I", 0xFFFFFFF0) + b"\0" * 3000,
    ),
    "tcp": (
        sentence("STATE") * 20,
        sentence("START") * 20 + sentence("ABORT") * 20,
        b"x" * 300,
        b"$PPLP,START*00\r\n" * 20,
    ),
    "feed": (b'{"frames": 20}\n{"sweeps": false}\n' * 200, b"x" * 300),
    "page": (
        ASK + b"\r\n",
        ASK.replace(b"/", b"/../../etc/passwd", 1) + b"\r\n",
        ASK + b"X: " + b"y" * 2000,
        ASK.replace(b"/", b"/events", 1) + b"Authorization: Bearer wrong\r\n\r\n",
    ),
}
"""Bytes that are sent without end: valid, refused, endless and wrong requests."""
HALVES = {
    "modbus": READ[:7],
    "opcua": HELLO[:9],
    "tcp": b"$PPLP,STA",
    "page": ASK[:20],
    "feed": b'{"fra',
}
GOOD = {"modbus": READ, "opcua": HELLO, "tcp": sentence("ID"), "page": ASK + b"\r\n"}
ALL = b'{"frames": 20, "sweeps": true}\n'
BURSTS = {"feed": 20}
"""Connections of a storm in a round; elsewhere 2."""
PAUSE_S = 0.002
STORM = 1000
"""Number of connections that a storm holds open at once. The box has refused most of them or not
accepted them yet."""

Act = Callable[[], None]
Address = str | tuple[str, int]


def connected(address: Address) -> socket.socket | None:
    """A connection that does not wait; None without room. address: local or TCP."""
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
    """A connection that first sends `opening`, and again once `goes_on` is False or raises."""
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


def storm(path: Address, seen: Counter[str], half: bytes, burst: int) -> Act:
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


def asker(address: Address, seen: Counter[str], request: bytes) -> Act:
    """A peer that asks again when it has its answer; its answers are counted."""
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


def acts(kind: str, there: Address, seen: Counter[str]) -> list[Act]:
    """Good peers, and all hostile peers of a kind. Some ask and never read, or read little."""
    floods = ((said, reads) for said in FLOODS[kind] for reads in (True, True, False))
    hostile = [
        *(talker(there, seen, partial(bytes, said), reads=reads) for said, reads in floods),
        *(talker(there, seen, noise) for _ in range(3)),
        storm(there, seen, HALVES[kind], BURSTS.get(kind, 2)),
    ]
    if isinstance(there, str):
        readers = [reader(there, seen) for _ in range(8)]
        slow = [one(there) for one in (sluggish, silent) for _ in range(10)]
        return [*readers, *slow, *hostile]
    good = GOOD[kind]
    return [asker(there, seen, good), peer(there, lambda one: send(one, good)), *hostile]


def main(kind: str, where: str) -> None:
    """Run until standard input ends."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(19)
    seen: Counter[str] = Counter()
    all_acts = acts(kind, where if kind == "feed" else ("127.0.0.1", int(where)), seen)
    while not select.select([sys.stdin], [], [], 0)[0]:
        for act in all_acts:
            act()
        time.sleep(PAUSE_S)
    print(json.dumps(seen))


if __name__ == "__main__":
    main(*sys.argv[1:])

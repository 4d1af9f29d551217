"""A command with the processor time of the box's feed counted: `python -m
tests.campaigns.feed_inside FILE COMMAND...`. In: the command line of `palpate`. Out: what that
gives; FILE holds the nanoseconds that the loop has spent in the feed so far.

The whole process varies by more than the feed takes, from one turn to the next: caches and memory
are shared with others.
"""

from __future__ import annotations

import mmap
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from appliance.__main__ import main
from appliance.service.feed import FeedServer

CALLS = ("frames", "answered", "sweep", "turn")
_COUNT = struct.Struct("=q")


def spent_ns(path: Path) -> int:
    """What FILE holds."""
    return int(_COUNT.unpack(path.read_bytes())[0])


def count(path: Path, feed: type) -> None:
    """From now on, have each of CALLS of the class `feed` add its processor time to the file."""
    path.write_bytes(_COUNT.pack(0))
    with path.open("r+b") as file:
        total = mmap.mmap(file.fileno(), _COUNT.size)

    def counted(plain: Callable[..., None]) -> Callable[..., None]:
        def call(*args: Any) -> None:
            begun_ns = time.thread_time_ns()
            try:
                plain(*args)
            finally:
                _COUNT.pack_into(
                    total, 0, _COUNT.unpack_from(total)[0] + time.thread_time_ns() - begun_ns
                )

        return call

    for name in CALLS:
        setattr(feed, name, counted(getattr(feed, name)))


if __name__ == "__main__":
    count(Path(sys.argv[1]), FeedServer)
    sys.exit(main(sys.argv[3:]))  # without the program's own name

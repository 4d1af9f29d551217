"""Runs a bridge that other machines connect to: `palpate bridge tcp`, `modbus` or `opcua`."""

from __future__ import annotations

import argparse
import asyncio
import signal
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from functools import partial
from ipaddress import ip_address
from typing import Any

from palpate.bridges.options import needed
from palpate.bridges.server import TcpServer, address
from palpate.bridges.source import port_of, source_of
from palpate.core.clock import SystemClock
from palpate.core.interrupts import INTERRUPTED
from palpate.core.log import log
from palpate.core.retry import retried
from palpate.service import network

Served = tuple[Any, str, Callable[[], Awaitable[None]]]
"""A bridge: its server, with `open`, `address` and `tasks` as TcpServer has them; the name of the
box's line or feed; and what closes the bridge."""


def _tcp(args: argparse.Namespace) -> Served:
    from palpate.bridges.tcp import TcpBridge

    name, opener = port_of(args)
    options = {"writes": args.allow_writes, "short": args.short, "most": args.most}
    bridge = TcpBridge(name, opener, **options, loop=asyncio.get_running_loop())
    return bridge.server, name, partial(asyncio.to_thread, bridge.close)


def _modbus(args: argparse.Namespace) -> Served:
    from palpate.bridges.modbus import ModbusBridge

    source = source_of(args)
    bridge = ModbusBridge(source, SystemClock(), writes=args.allow_writes)
    return TcpServer(bridge.serve, args.most), source.name, partial(asyncio.to_thread, source.close)


def _opcua(args: argparse.Namespace) -> Served:
    with needed("the OPC UA server", "opcua", "anyio", "pickle", "shelve", "xml.etree.ElementTree"):
        from palpate.bridges.opcua import OpcuaBridge

    bridge = OpcuaBridge(network.box_name(args.name), args, SystemClock())
    return bridge, bridge.source.name, bridge.close


SERVERS: dict[str, Callable[[argparse.Namespace], Served]] = {
    "tcp": _tcp,
    "modbus": _modbus,
    "opcua": _opcua,
}


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM; the exit code. args: completed by `settle`. Raises ConfigError."""
    host, port = address(args.listen)

    async def serve() -> int:
        code = stop_code()
        async with AsyncExitStack() as stack:
            server, box, close = SERVERS[args.kind](args)
            stack.push_async_callback(close)
            await server.open(host, port)
            _say(args, server, box)
            own, at = server.address  # port 0 has become one of its own
            end = network.announce(args.kind, own, at, args.name)
            stack.push_async_callback(asyncio.to_thread, end)
            ends = {code, *server.tasks}
            for ended in (await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED))[0]:
                ended.result()
            log.info("stopped")
        return await code

    return retried(lambda: asyncio.run(serve()), SystemClock())


def stop_code() -> asyncio.Future[int]:
    """The exit code, once SIGTERM or SIGINT comes."""
    loop = asyncio.get_running_loop()
    stop = loop.create_future()

    def end(code: int) -> None:
        if not stop.done():
            stop.set_result(code)

    loop.add_signal_handler(signal.SIGTERM, end, 0)
    loop.add_signal_handler(signal.SIGINT, end, INTERRUPTED)
    return stop


def _say(args: argparse.Namespace, server: Any, box: str) -> None:
    at = f"{args.kind}: listening on {':'.join(map(str, server.address))}, box at {box}"
    if not args.allow_writes:
        log.info(f"{at}; commands are refused (--allow-writes)")
        return
    log.info(f"{at}; commands are passed on")
    if args.kind != "opcua" and not ip_address(server.address[0]).is_loopback:
        log.warning(f"{args.kind}: whoever reaches it can command the box: keep it in the cell")

"""The box as an OPC UA server (docs/robots/opcua.md)."""

from __future__ import annotations

import argparse
import asyncio
import json
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from asyncua import Server, ua
from asyncua.common.node import Node
from asyncua.server.event_generator import EventGenerator

from palpate import __version__
from palpate.bridges.opcua_model import (
    CODES,
    KINDS,
    METHODS,
    OBJECTS,
    REPLY,
    RESULT,
    VARIABLES,
    argument,
    numbers,
    result,
    state,
)
from palpate.bridges.opcua_security import Login, limit, own_certificate
from palpate.bridges.opcua_space import SmallServer
from palpate.bridges.options import read_login
from palpate.bridges.results import KEPT, MOST, Results
from palpate.bridges.server import CLOSE_S, not_listening
from palpate.bridges.source import source_of
from palpate.client.answers import Answer
from palpate.client.box import Heard
from palpate.core import wall_clock
from palpate.core.clock import Clock
from palpate.core.errors import ApplianceError, CommandRefused, ConfigError
from palpate.core.log import SparseLog

URI = "urn:palpate:box"
"""Namespace of the nodes. A node's identifier is its path, the same on every box."""
LOOK_S = 1.0
"""Longest time between two looks at the box."""


class OpcuaBridge:
    """Serves the box; `open` it in the loop where it was made. name: of the box. args: completed by
    `settle`."""

    def __init__(self, name: str, args: argparse.Namespace, clock: Clock) -> None:
        login = args.folder / "login"
        user, password = read_login(login) if login.exists() else ("", "")
        if not user and not args.anonymous:
            raise ConfigError(
                f"{login}: there is no such file; put a user on its first line and a password on "
                "its second, or let everybody read with --anonymous"
            )
        self.address = ("", 0)
        self._name, self._args, self._clock = name, args, clock
        self._log = SparseLog(clock.now_ns)
        self._loop = asyncio.get_running_loop()
        self._news: deque[tuple[float, Answer]] = deque(maxlen=KEPT)
        self._results = Results(args.memory)
        self._come, self._commanding = asyncio.Event(), asyncio.Lock()
        self._said: dict[str, tuple[Any, int]] = {}
        self._sweeping = False
        self._start_s: float | None = None
        self._nodes: dict[str, Node] = {}
        users = Login(user, password, clock, anonymous=args.anonymous)
        self._server, self._users = Server(SmallServer(user_manager=users)), bool(user)
        self.tasks: list[asyncio.Task[None]] = []
        self.source = source_of(args, self._take)

    async def close(self) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):  # peers that do not read their rest
                await self._server.stop()
        await asyncio.to_thread(self.source.close)

    async def open(self, host: str, port: int) -> None:
        """Make the nodes and listen. Raises AddressError or ConfigError as TcpServer does."""
        server, args, title = self._server, self._args, f"Palpate {self._name}"
        certificate, key, uri = own_certificate(args.folder, f"{URI}:{self._name}", host)
        await server.init()
        await server.set_application_uri(uri)
        server.set_server_name(title)
        await server.set_build_info(URI, "Palpate", title, __version__, "", wall_clock.utc())
        await server.load_certificate(certificate, "der")
        await server.load_private_key(key, format="pem")
        limit(server, args.most, users=self._users, anonymous=args.anonymous)
        at = await server.register_namespace(URI)
        await self._add_variables(at)
        await self._add_methods(at)
        fields = [(path.rpartition(".")[2], kind) for path, kind in RESULT.items()]
        told = await server.create_custom_event_type(at, "ResultReadyEventType", properties=fields)
        event = await server.get_event_generator(told)
        server.set_endpoint(f"opc.tcp://{f'[{host}]' if ':' in host else host}:{port}/")
        server.socket_address = host, port
        try:
            await server.start()
        except (OSError, OverflowError, ValueError) as e:
            raise not_listening(host, port, e) from e
        if not args.anonymous:  # the end without encryption then serves discovery alone
            ends = server.iserver.endpoints
            ends[:] = [end for end in ends if end.SecurityMode != ua.MessageSecurityMode.None_]
        assert server.bserver
        self.address = server.bserver.hostname, server.bserver.port
        self.tasks.append(asyncio.create_task(self._write_all(event)))

    async def _add_variables(self, at: int) -> None:
        """Add the variables and the objects that hold them. at: index of the namespace."""
        top = self._server.nodes.objects
        nodes = {"": await top.add_object(ua.NodeId("Palpate", at), f"{at}:Palpate")}
        for path in OBJECTS:
            nodes[path] = await nodes[""].add_object(ua.NodeId(path, at), f"{at}:{path}")
        for path, kind in VARIABLES.items():
            above, _, name = path.rpartition(".")
            add = nodes[above].add_property if name == "Number" else nodes[above].add_variable
            start = ua.get_default_value(kind)
            nodes[path] = await add(ua.NodeId(path, at), f"{at}:{name}", start, kind)
        self._nodes = nodes

    async def _add_methods(self, at: int) -> None:
        async def add(path: str, act: Any, takes: list[ua.Argument], *gives: ua.Argument) -> None:
            above, _, name = path.rpartition(".")
            ids = ua.NodeId(path, at), f"{at}:{name}"
            await self._nodes[above].add_method(*ids, act, takes, [*gives])

        text, date, count = ua.ObjectIds.String, ua.ObjectIds.UtcTime, ua.ObjectIds.UInt32
        since = [argument("Since", date), argument("Most", count)]
        found = argument("Results", text, rank=1)
        await add("LastResult.GetResults", self._get_results, since, found)
        for method, (command, tops) in METHODS.items() if self._args.allow_writes else ():
            takes = [argument(name, ua.ObjectIds.Float) for name in tops]
            act = partial(self._command, command, tops)
            await add(f"VisionStateMachine.{method}", act, takes)

    def _take(self, news: Heard) -> None:
        """News of the box, in the thread that reads it."""
        with suppress(RuntimeError):  # the program has ended
            self._loop.call_soon_threadsafe(self._hear, wall_clock.seconds(), news)

    def _hear(self, at_s: float, news: Heard) -> None:
        if isinstance(news, Answer):
            self._news.append((at_s, news))
        elif news.sweeping != self._sweeping:
            self._sweeping = news.sweeping
            self._start_s = at_s if news.sweeping else self._start_s
        self._come.set()

    async def _write_all(self, event: EventGenerator) -> None:
        """Write the news as they come, with an event for each result, and look whether the box is
        silent."""
        last: Mapping[str, Any] = dict.fromkeys(RESULT)
        at_s: float | None = None
        none = CODES.BadWaitingForInitialData
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    await self._come.wait()
            self._come.clear()
            view = self.source.view()
            alive = view.alive(self._clock.now_ns())
            while self._news:
                at_s, answer = self._news.popleft()
                last, none = result(answer, view, at_s, self._start_s), 0
                self._start_s = None
                self._results.add(at_s, answer)
                await self._write(last, 0, at_s)
                for path, value in last.items():
                    setattr(event.event, path.rpartition(".")[2], value)
                text = f"{answer.sweep}: {answer.status} {answer.label}"
                await event.trigger(wall_clock.utc(at_s), text)
            silent = CODES.BadNoCommunication
            await self._write(state(view), 0 if alive else silent, None)
            await self._write(last, none if alive else silent, at_s)

    async def _write(self, values: Mapping[str, Any], code: int, at_s: float | None) -> None:
        """Write the values that differ from the last ones. code: the quality; bad without a box, so
        that no old value looks new. at_s: when the box said it, None for now."""
        for path, value in values.items():
            if self._said.get(path) == (value, code):
                continue
            self._said[path] = value, code
            kind = VARIABLES[path]
            quality = code or (CODES.BadNoData if value is None else 0)
            now = wall_clock.utc()
            told = ua.DataValue(
                Value=ua.Variant(value, kind) if not quality else ua.Variant(),
                StatusCode=ua.StatusCode(quality),
                SourceTimestamp=now if at_s is None else wall_clock.utc(at_s),
                ServerTimestamp=now,
            )
            await self._server.write_attribute_value(self._nodes[path].nodeid, told)

    async def _command(
        self, command: str, tops: Mapping[str, float], parent: Any, *given: ua.Variant
    ) -> ua.StatusCode | ua.CallMethodResult:
        """A method of METHODS."""
        values = numbers(given, tops)
        if isinstance(values, ua.CallMethodResult):
            return values
        if self._commanding.locked():
            return ua.StatusCode(CODES.BadTooManyOperations)
        slide = dict(zip(("speed_mm_s", "force_n"), values, strict=False))
        slide = {name: value for name, value in slide.items() if value}
        code = 0
        async with self._commanding:
            try:
                said = await asyncio.to_thread(self.source.send, command, **slide)
            except ApplianceError as e:
                refused = isinstance(e, CommandRefused)
                code = CODES.BadInvalidState if refused else CODES.BadNoCommunication
                said = f"error: {e}"
                self._log.warning(f"opcua: {command}: {e}")
            await self._write({REPLY: f"{command}: {said}"}, 0, None)
        return ua.StatusCode(code)

    async def _get_results(self, parent: Any, *given: ua.Variant) -> Any:
        """The method GetResults: results since a time as JSON, oldest first."""
        since = given[0] if len(given) == 2 else ua.Variant()
        if since.VariantType is not KINDS.DateTime or since.is_array or not since.Value:
            return ua.StatusCode(CODES.BadInvalidArgument)
        most = numbers(given[1:], {"Most": 2**32})
        if isinstance(most, ua.CallMethodResult):
            return most
        from_s, wanted = wall_clock.seconds_of(since.Value), min(round(most[0]) or MOST, MOST)
        rows = await asyncio.to_thread(self._results.since, from_s, wanted)
        return [ua.Variant([json.dumps(row) for row in rows], KINDS.String, is_array=True)]

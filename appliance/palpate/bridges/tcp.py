"""The serial line over TCP, for controllers with sockets, for example URScript. Each peer gets all
sentences. Commands of the peers go to the box one at a time, though not behind a command that
waits for the box's disk, and the answer goes to the peer that sent the command."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from palpate.bridges.server import TcpPeer, TcpServer
from palpate.client.line import Line
from palpate.core import sentences
from palpate.core.errors import LinkLost
from palpate.core.sentences import Sentence, sentence

PACE_S = 0.02
"""Least time between two commands to the box, of all peers together: its loop answers each, so a
flood must not reach it. Also the least time between two commands of one peer, refused commands
included, so that a flooding peer leaves the others their turn."""
ANSWER_S, STORED_S = 2.0, 30.0
"""Longest wait for the box's answer to a command, and to one of STORED."""
STORED = ("DISCARD", "FORGET", "MOVE", "RENAME", "UNDO", "USE")
"""Commands that the box answers once it has written to its disk; others it answers meanwhile."""
QUESTIONS = ("ID", "STATE", "LABEL")
"""Commands that change nothing and need no permission."""


class TcpBridge:
    """Passes sentences on. writes: whether peers may send commands that change the box. short: in
    their short form."""

    def __init__(
        self,
        name: str,
        opener: Callable[[], Any],
        *,
        writes: bool,
        short: bool = False,
        most: int,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        self.server = TcpServer(self.serve, most)
        self._to_peer = sentences.short if short else sentence
        self._writes, self._loop, self._pacing = writes, loop, asyncio.Lock()
        self._asking = {stored: asyncio.Lock() for stored in (False, True)}
        self._next_s = 0.0  # earliest time of the next command to the box
        self._asked: dict[str, asyncio.Future[bytes]] = {}  # commands without an answer yet
        self._line = Line(opener, self._heard, lambda: None, name=name)

    def close(self) -> None:
        self._line.close()

    def _heard(self, heard: Sentence) -> None:
        """In the thread of the line. Damaged sentences are dropped."""
        if heard.summed and not heard.error and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._pass_on, heard)

    def _pass_on(self, heard: Sentence) -> None:
        line = self._to_peer(heard.kind, *heard.fields)
        # an answer that came too late, or that no peer has asked for, is dropped
        if heard.kind == "ANS":
            answer = self._asked.get("".join(heard.fields[:1]))
            if answer and not answer.done():
                answer.set_result(line)
            return
        for peer in [*self.server.peers]:
            peer.write(line)

    async def serve(self, peer: TcpPeer) -> None:
        rest = b""
        while data := await peer.read(None):
            found, rest = sentences.parse(data, rest)
            for command in found:
                peer.write(await self._ask(command))
                await asyncio.sleep(PACE_S)

    async def _ask(self, command: Sentence) -> bytes:
        """The box's answer to a command, or an error answer with the reason why there is none."""
        why = command.error
        if not why and not self._writes and command.kind not in QUESTIONS:
            why = "this bridge is read-only; start it with --allow-writes"
        if not why:
            stored = command.kind in STORED
            limit_s = STORED_S if stored else ANSWER_S
            async with self._asking[stored]:
                async with self._pacing:
                    await asyncio.sleep(self._next_s - self._loop.time())
                    self._next_s = self._loop.time() + PACE_S
                answer: asyncio.Future[bytes] = self._loop.create_future()
                self._asked[command.kind] = answer
                try:
                    await asyncio.to_thread(
                        self._line.write, sentence(command.kind, *command.fields)
                    )
                    async with asyncio.timeout(limit_s):
                        return await answer
                except LinkLost as e:
                    why = str(e)
                except TimeoutError:
                    why = f"the box has not answered within {limit_s:g} s; check whether it is on"
                finally:
                    del self._asked[command.kind]
        return self._to_peer("ANS", command.kind, "error", why)

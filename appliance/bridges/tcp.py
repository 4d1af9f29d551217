"""The serial line over TCP: what a controller with a socket needs, URScript for one. In: a port. Out: its sentences, to
each peer; commands of the peers go to the box.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from appliance.bridges.server import TcpPeer, TcpServer
from appliance.client.line import Line
from appliance.core import sentences
from appliance.core.errors import LinkLost
from appliance.core.sentences import Sentence, sentence

PACE_S = 0.02
"""Time between two commands to the box, of all peers together: its loop answers each, and a flood must not reach it."""
QUESTIONS = ("ID", "STATE", "LABEL")
"""Commands that change nothing, and need no permission."""


class TcpBridge:
    """Passes sentences on. writes: whether peers may send commands that change something."""

    def __init__(
        self, name: str, opener: Callable[[], Any], *, writes: bool, most: int, loop: asyncio.AbstractEventLoop
    ) -> None:
        self.server = TcpServer(self.serve, most)
        self._writes, self._loop, self._sending = writes, loop, asyncio.Lock()
        self._line = Line(opener, self._heard, lambda: None, name=name)

    @property
    def trouble(self) -> str:
        """Why the line is not open, "" if it is."""
        return self._line.trouble

    def close(self) -> None:
        """Close the line."""
        self._line.close()

    def _heard(self, heard: Sentence) -> None:
        """In the thread of the line: what is damaged ends here."""
        if heard.summed and not heard.error and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._pass_on, sentence(heard.kind, *heard.fields))

    def _pass_on(self, line: bytes) -> None:
        for peer in [*self.server.peers]:
            peer.write(line)

    async def serve(self, peer: TcpPeer) -> None:
        """Pass on the commands of one peer."""
        rest = b""
        while data := await peer.read(None):
            found, rest = sentences.parse(data, rest)
            for command in found:
                error = await self._send(command)
                if error:
                    peer.write(sentence("ANS", command.kind, "error", error))

    async def _send(self, command: Sentence) -> str:
        """Send a command to the box; why not, "" if it was sent."""
        if command.error:
            return command.error
        if not self._writes and command.kind not in QUESTIONS:
            return "this bridge is read-only; start it with --allow-writes"
        async with self._sending:
            try:
                await asyncio.to_thread(self._line.write, sentence(command.kind, *command.fields))
            except LinkLost as e:
                return str(e)
            finally:
                await asyncio.sleep(PACE_S)
        return ""

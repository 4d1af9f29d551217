"""The TCP server of the bridges: a peer that reads nothing does not hold the end."""

from __future__ import annotations

import asyncio
import socket

from palpate.bridges.server import BUFFER, TcpPeer, TcpServer

LONG_S = 60.0
"""Far longer than the end may take, even on a busy machine."""


def test_a_peer_that_never_reads_does_not_hold_the_end():
    """With bytes waiting for it: the rest is thrown away, and the task that served it ends."""

    async def peers_after_the_end() -> int:
        """How many are left when the task of one that is full was cancelled."""
        full = asyncio.Event()

        async def serve(peer: TcpPeer) -> None:
            while peer._writer.transport.get_write_buffer_size() < BUFFER // 2:
                peer.write(bytes(4096))
                await asyncio.sleep(0)
            full.set()
            await asyncio.Event().wait()

        server = TcpServer(serve, 1)
        await server.open("127.0.0.1", 0)
        with socket.socket() as mute:
            mute.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            mute.setblocking(False)
            await asyncio.get_running_loop().sock_connect(mute, server.address)
            await full.wait()
            (served,) = (task for task in asyncio.all_tasks() if "_connected" in repr(task))
            served.cancel()
            await asyncio.wait([served])
            return len(server.peers)

    assert asyncio.run(asyncio.wait_for(peers_after_the_end(), LONG_S)) == 0


def test_a_task_that_is_cancelled_as_bytes_arrive_ends():
    """In whichever turn: with 3.11's wait_for it went on for ever."""

    async def ends(turns: int) -> bool:
        reader = asyncio.StreamReader()
        peer = TcpPeer(reader, None, asyncio.get_running_loop().time)  # type: ignore[arg-type]

        async def serve() -> None:
            while True:
                await peer.read(LONG_S)

        serving = asyncio.create_task(serve())
        await asyncio.sleep(0.01)
        reader.feed_data(b"x")
        for _ in range(turns):
            await asyncio.sleep(0)
        serving.cancel()
        _, waiting = await asyncio.wait([serving], timeout=30)
        serving.cancel()
        return not waiting

    assert [turns for turns in range(6) if not asyncio.run(ends(turns))] == []

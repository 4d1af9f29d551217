"""The TCP server of the bridges: a peer that takes nothing does not keep the program from
ending."""

from __future__ import annotations

import asyncio
import socket

from appliance.bridges.server import BUFFER, TcpPeer, TcpServer

LONG_S = 60.0
"""Far more than the end may take, even on a busy machine."""


def test_a_peer_that_never_reads_does_not_hold_the_end() -> None:
    """With bytes waiting for it: the rest is thrown away, and the task that served it ends."""
    assert asyncio.run(asyncio.wait_for(_peers_after_the_end(), LONG_S)) == 0


async def _peers_after_the_end() -> int:
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

"""Which user of this machine has opened a connection over loopback.

The feed is for group `palpate`. A page on loopback shows the same and asks for no token, so it is
for the same users. The kernel lists the owner of each connection (proc_pid_net(5)).
"""

from __future__ import annotations

import grp
import os
import pwd
import socket
import sys
from contextlib import suppress
from pathlib import Path

GROUP = "palpate"
TABLES = Path("/proc/net/tcp"), Path("/proc/net/tcp6")
Place = tuple[str, int]
"""Address and port."""


def owner(peer: Place, own: Place) -> int | None:
    """The uid of the user whose socket `peer` is connected to `own` here; None if it is not
    listed."""
    # a socket of IPv6 may carry IPv4
    families = (socket.AF_INET6,) if ":" in peer[0] else (socket.AF_INET, socket.AF_INET6)
    wanted = {(_hex(peer, family), _hex(own, family)) for family in families}
    for table in TABLES:
        with suppress(OSError):
            for line in table.read_text().splitlines()[1:]:
                _, local, remote, *rest = line.split()
                if (local, remote) in wanted:
                    return int(rest[4])
    return None


def may_see(uid: int | None) -> bool:
    """Whether a user may see the box: root, the user of this program, and members of the group."""
    if uid is None:
        return False
    if uid in (0, os.geteuid()):
        return True
    try:
        group, user = grp.getgrnam(GROUP), pwd.getpwuid(uid)
    except KeyError:
        return False
    return user.pw_gid == group.gr_gid or user.pw_name in group.gr_mem


def _hex(place: Place, family: int) -> str:
    """A place as in the tables: words of the host's byte order in hexadecimal digits."""
    address = place[0]
    if family == socket.AF_INET6 and ":" not in address:
        address = f"::ffff:{address}"
    data = socket.inet_pton(family, address)
    words = (data[i : i + 4] for i in range(0, len(data), 4))
    return f"{''.join(f'{int.from_bytes(w, sys.byteorder):08X}' for w in words)}:{place[1]:04X}"

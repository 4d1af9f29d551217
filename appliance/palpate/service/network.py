"""Boxes find each other on the network (mDNS, DNS-SD): each open port is announced, and
`palpate status --network` lists all of it.

The address of the network interface makes names unique: two boxes of one name, or cloned from one
card, would else answer for each other. A port of this machine alone is not announced.
"""

from __future__ import annotations

import re
import socket
import threading
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from ipaddress import ip_address
from typing import Any

from palpate import __version__
from palpate.core.clock import Clock
from palpate.core.errors import ConfigError
from palpate.core.log import log
from palpate.core.text import printable

TYPE = "_palpate._tcp.local."
NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
LISTEN_S, ASK_S = 2.0, 10.0
"""How long `found` waits for names, and then asks for addresses: anybody may announce thousands."""


@dataclass(frozen=True, slots=True, order=True)
class Reachable:
    """An open port of a box: its kind (`page`, `tcp`, `modbus`, `opcua`) and address."""

    box: str
    kind: str
    host: str
    port: int


def box_name(given: str) -> str:
    """The box's name for other programs: as given, or the computer's. Raises ConfigError."""
    name = given or re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname())[:32]
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} is not a name of a box; use up to 32 letters, digits, hyphens, underscores"
        )
    return name


def box_id() -> str:
    """A short name of this computer, which no other has: from the address of its interface."""
    return sha256(uuid.getnode().to_bytes(6, "big")).hexdigest()[:6]


def local(host: str) -> bool:
    """Whether an address is reached from this machine alone."""
    return ip_address(host).is_loopback


def own_addresses() -> list[str]:
    """The IPv4 addresses of this computer."""
    import ifaddr

    every = [ip for card in ifaddr.get_adapters() for ip in card.ips]
    return [str(ip.ip) for ip in every if ip.is_IPv4]


def announce(kind: str, host: str, port: int, name: str = "") -> Callable[[], None]:
    """Announce a port that is open, in a thread of its own; returns a function that ends it.

    name: of the box, "" for the computer's. Nothing is announced of an address of this machine
    alone, or without zeroconf.
    """
    if local(host):
        return lambda: None
    try:
        import zeroconf
    except ImportError:
        log.info(f"{kind}: not announced; pip install 'palpate[found]'")
        return lambda: None
    box = f"{box_name(name).replace('_', '-')}-{box_id()}"  # the name of a host has no underscore
    ended, opened = threading.Event(), []

    def work() -> None:
        try:
            every = ip_address(host).is_unspecified
            one = zeroconf.Zeroconf(zeroconf.InterfaceChoice.All if every else [host])
            opened.append(one)
            hosts = own_addresses() if every else [host]
            info = zeroconf.ServiceInfo(
                *(TYPE, f"{box} {kind}.{TYPE}", port),
                parsed_addresses=[one for one in hosts if not local(one)],
                properties={"kind": kind, "version": __version__},
                server=f"palpate-{box}.local.",
            )
            one.register_service(info, allow_name_change=True)
        except (OSError, zeroconf.Error) as e:
            log.warning(f"{kind}: not announced ({e}); give its address to the clients")
        ended.wait()
        for each in opened:
            each.close()

    thread = threading.Thread(target=work, daemon=True, name="palpate-announce")
    thread.start()

    def end() -> None:
        ended.set()
        thread.join(LISTEN_S)

    return end


def found(clock: Clock, interfaces: list[str] | None = None) -> list[Reachable]:
    """The announced ports on the networks of these addresses, None: of all. Takes LISTEN_S, and up
    to ASK_S more. Raises ConfigError without zeroconf."""
    try:
        import zeroconf
    except ImportError as e:
        raise ConfigError(f"{e}; pip install 'palpate[found]'") from e
    names: set[str] = set()

    def heard(zeroconf: Any, service_type: str, name: str, state_change: Any) -> None:
        names.add(name)

    there = []
    with zeroconf.Zeroconf(interfaces or zeroconf.InterfaceChoice.All) as one:
        zeroconf.ServiceBrowser(one, TYPE, handlers=[heard])
        clock.sleep_until(clock.now_ns() + round(LISTEN_S * 1e9))
        end_ns = clock.now_ns() + round(ASK_S * 1e9)
        for name in sorted({*names}):
            if clock.now_ns() > end_ns:
                log.warning(f"too many names on the network; not all were asked in {ASK_S:g} s")
                break
            info = one.get_service_info(TYPE, name, timeout=500)
            if info is None:  # it has just ended
                continue
            kind = printable(str(info.decoded_properties.get("kind")))
            box = printable(name.partition(" ")[0])
            there += [Reachable(box, kind, h, info.port or 0) for h in info.parsed_addresses()]
    return sorted(there)

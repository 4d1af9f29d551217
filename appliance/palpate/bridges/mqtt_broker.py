"""The broker of `palpate bridge mqtt`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from paho.mqtt import client as paho
from paho.mqtt.enums import MQTTErrorCode

from palpate.bridges.options import read_login
from palpate.core.errors import ConfigError

PORTS = {"mqtt": 1883, "mqtts": 8883}
MOST_BYTES = 1024
"""Largest packet that the broker may send: commands are short."""


class BoundedClient(paho.Client):
    """Raises ValueError at a packet that is larger, or has another QoS than the bridge asks for:
    the library would keep both without a bound."""

    def _sock_recv(self, bufsize: int) -> bytes:
        if bufsize > MOST_BYTES:
            raise ValueError(f"a packet of {bufsize} bytes")
        return super()._sock_recv(bufsize)

    def _handle_publish(self) -> MQTTErrorCode:
        if self._in_packet["command"] & 0b110:
            raise ValueError("a message that asks for an acknowledgement")
        return super()._handle_publish()


@dataclass(frozen=True, slots=True)
class Broker:
    """Where the broker is. ca: file with the certificates to trust, "" for the system's.
    user: "" for none."""

    host: str
    port: int
    tls: bool = False
    ca: str = ""
    user: str = ""
    password: str = field(default="", repr=False)

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def broker(url: str, login: str, ca: str) -> Broker:
    """The broker at mqtt://HOST[:PORT] or mqtts://HOST[:PORT]. login: file with the user on its
    first line and the password on its second, "" for none. Raises ConfigError."""
    try:
        parts = urlsplit(url)
        scheme, host, port = parts.scheme, parts.hostname or "", parts.port
    except ValueError:
        scheme, host, port = "", "", None
    if scheme not in PORTS or not host or "@" in url or parts.path.strip("/"):
        raise ConfigError(
            f"--broker {url.rpartition('@')[2]}: not a broker's address; use mqtt://HOST:PORT or "
            "mqtts://HOST:PORT, and --login for user and password"
        )
    if ca and not Path(ca).is_file():
        raise ConfigError(f"--ca {ca}: there is no such file; name a file with certificates (PEM)")
    user, password = read_login(Path(login)) if login else ("", "")
    return Broker(host, port or PORTS[scheme], scheme == "mqtts", ca, user, password)

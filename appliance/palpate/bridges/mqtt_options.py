"""The broker of `palpate bridge mqtt`: its address, the file with the login, the box's name."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from palpate.core.errors import ConfigError

PORTS = {"mqtt": 1883, "mqtts": 8883}
NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")


@dataclass(frozen=True, slots=True)
class Broker:
    """Where the broker is. ca: file with the certificates to trust, "" for those of the system.
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


def read_login(path: Path) -> tuple[str, str]:
    """User and password. Raises ConfigError for a file that others may read, or without two
    lines."""
    try:
        if path.stat().st_mode & 0o007:
            raise ConfigError(
                f"{path}: everybody may read the password; chmod o= {path}, and give it to "
                "the bridge's user"
            )
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        why = str(getattr(e, "strerror", None) or "not a text").lower()
        raise ConfigError(f"{path}: {why}; name a file with user and password") from e
    if len(lines) < 2 or not lines[0]:
        raise ConfigError(
            f"{path}: it needs two lines; put the user on the first, the password on the second"
        )
    return lines[0], lines[1]


def box_name(given: str) -> str:
    """The box's name in topics: as given, or the computer's. Raises ConfigError."""
    name = given or re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname())[:32]
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"--name {name}: not a name; use up to 32 letters, digits, hyphens and underscores"
        )
    return name

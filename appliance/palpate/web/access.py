"""Access to a page: its address, the host names that browsers may use, tokens and certificate."""

from __future__ import annotations

import hmac
import ipaddress
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path

from palpate.core.config import WatchConfig
from palpate.core.errors import ConfigError, TemporaryError, passes

HERE = "127.0.0.1"
NAMES = ("localhost", HERE, "[::1]")
"""Host names of this machine. Any other name belongs to another site that points here (DNS
rebinding)."""
LEAST_TOKEN, MOST_TOKEN = 16, 256
"""Least and most characters of a token."""
ROLES = ("look", "operate", "teach")
"""What a browser may do, each with what stands before it: see everything; record sweeps; teach."""


@dataclass(frozen=True, slots=True)
class Access:
    """Address of a page, and the browsers that may read it.

    port: 0 for any free port. names: further host names that browsers may use. tokens: the secret
    of each of ROLES, empty if none is needed. certificate, key: PEM files of TLS; None serves
    without TLS.
    """

    port: int
    address: str = HERE
    names: tuple[str, ...] = ()
    tokens: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    @classmethod
    def configured(cls, settings: WatchConfig, port: int, *, secret: bool = True) -> Access:
        """The access of the settings. An address beyond this machine needs tokens and certificate.
        secret: read the tokens; without them the access only tells its address. Raises ConfigError
        if they cannot be used."""
        address, *names = settings.address.lower().split() or [""]
        try:
            local = ipaddress.ip_address(address).is_loopback
        except ValueError as e:
            raise ConfigError(
                f"watch.address: {address!r} is not an IP address; use {HERE}, or 0.0.0.0 for the"
                " network, then host names"
            ) from e
        if local:
            return cls(port, address, tuple(names))
        folder = Path(settings.folder)
        return cls(
            port,
            address,
            (*_own_names(), *names),
            tuple(_token(folder / f"token-{role}") for role in ROLES) if secret else (),
            folder / "certificate.pem",
            folder / "key.pem",
        )

    def tls(self) -> ssl.SSLContext | None:
        """The context of TLS. Raises ConfigError if certificate or key cannot be used."""
        if not self.certificate or not self.key:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        try:
            context.load_cert_chain(self.certificate, self.key)
        except (OSError, ssl.SSLError) as e:
            raise (TemporaryError if passes(e) else ConfigError)(
                f"{self.certificate} and {self.key.name} cannot be used: {e}; make install makes"
                " them"
            ) from e
        return context

    def url(self, port: int) -> str:
        """The page's address for a person. port: the port of the server."""
        name = self.address if not self.certificate else self.names[0] if self.names else HERE
        return (
            f"http{'s' if self.certificate else ''}://{f'[{name}]' if ':' in name else name}:{port}"
        )

    def is_host(self, host: str, own: str) -> bool:
        """Whether the Host of a request is this machine. own: the local address of the
        connection."""
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        own = f"[{own}]" if ":" in own else own
        return bool(name) and name.lower() in (*NAMES, *self.names, own)

    def role(self, given: str) -> str:
        """The role of a browser with the token `given`: the last where none is needed, "" for a
        wrong token. All wrong tokens take the same time."""
        fits = [hmac.compare_digest(given.encode(), one.encode()) for one in self.tokens]
        allowed = [role for role, fit in zip(ROLES, fits, strict=False) if fit]
        return allowed[-1] if allowed else "" if self.tokens else ROLES[-1]


def _own_names() -> tuple[str, ...]:
    """The machine's host name, and its name in multicast DNS."""
    name = socket.gethostname().lower()
    return (name, f"{name.partition('.')[0]}.local")


def _token(path: Path) -> str:
    """The token in a file. Raises ConfigError if it cannot be used."""
    advice = "make install makes one; or set watch.address to 127.0.0.1"
    try:
        token = path.read_text("ascii").strip()
    except PermissionError as e:
        raise ConfigError(
            f"{path} may not be read by this user; add the user to the group of {path.parent} "
            f"(usermod -aG GROUP USER), or set watch.address to {HERE}"
        ) from e
    except (OSError, ValueError) as e:
        raise (TemporaryError if passes(e) else ConfigError)(
            f"{path} cannot be read: {getattr(e, 'strerror', None) or e}; {advice}"
        ) from e
    if not LEAST_TOKEN <= len(token) <= MOST_TOKEN or not token.isalnum():
        raise ConfigError(
            f"{path} is not a token of {LEAST_TOKEN} to {MOST_TOKEN} letters and digits; {advice}"
        )
    return token

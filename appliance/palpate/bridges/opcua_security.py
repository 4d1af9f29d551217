"""Bounds for hostile clients, users and the certificate of the OPC UA server.

The library bounds sessions and queues. Bounded here: bytes of an unfinished message, requests in a
second, the pace of subscriptions.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import socket
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.crypto import cert_gen
from asyncua.crypto.permission_rules import USER_TYPES, SimpleRoleRuleset, User, UserRole
from asyncua.server import binary_server_asyncio
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from palpate.bridges.results import KEPT
from palpate.bridges.server import PACE_S
from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.errors import ConfigError
from palpate.core.log import SparseLog
from palpate.core.text import printable

MOST_MESSAGE, MOST_BYTES, MOST_WAITING = 1 << 20, 1 << 17, 64
"""Of a client: its longest message, the bytes of a part that is not complete, and the parts that
wait. Each of them holds all bytes that came with it."""
FASTEST_MS = 10.0
"""Shortest publishing interval but 0, which publishes at once."""
ACTIVATED_S = 5.0
"""A connection without a session is closed after this time."""
SUBSCRIPTIONS, SESSION_MS, UNREAD = 64, 60_000, 200
"""Limits: subscriptions in all, how long a session outlives its connection, messages that wait for
one subscription."""
DAYS = 3650
"""How long the own certificate is valid: from the box's first start, by its wall clock."""


class BoundedProtocol(binary_server_asyncio.OPCUAProtocol):  # type: ignore[misc]
    """A connection that reads no faster than it may, and keeps no more than one message."""

    def data_received(self, data: bytes) -> None:
        line = self.transport
        if line is None:  # refused: the server is full
            return
        if len(self._buffer) + len(data) > MOST_BYTES:
            line.abort()
            return
        super().data_received(data)
        line.pause_reading()
        asyncio.get_running_loop().call_later(PACE_S, _resume, line)


def _resume(line: asyncio.Transport) -> None:
    if not line.is_closing():
        line.resume_reading()


class ReadersAndUsers(SimpleRoleRuleset):  # type: ignore[misc]
    """Rights: all that the library gives to users; a client without a name only reads."""

    def __init__(self) -> None:
        super().__init__()
        known = ua.ObjectIds
        changing = {known.CallRequest_Encoding_DefaultBinary}
        changing |= {known.WriteRequest_Encoding_DefaultBinary}
        reading = {ua.NodeId(each) for each in {*USER_TYPES} - changing}
        self._permission_dict[UserRole.Anonymous] = reading


class Login:
    """The users: one with a password ("" for none), and everybody if `anonymous`."""

    def __init__(self, user: str, password: str, clock: Clock, *, anonymous: bool) -> None:
        self._user, self._password, self._anonymous = user, password, anonymous
        self._log = SparseLog(clock.now_ns)

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> User | None:
        """Called by the library; None refuses. certificate: of the client, None on a connection
        that is not encrypted."""
        if username is None:
            return User(role=UserRole.Anonymous) if self._anonymous else None
        given = f"{username}\n{password}".encode()
        wanted = f"{self._user}\n{self._password}".encode()
        if self._user and certificate and hmac.compare_digest(given, wanted):
            return User(role=UserRole.User, name=username)
        self._log.warning("opcua: a user or password was refused; compare it with the login file")
        return None


def own_certificate(folder: Path, uri: str, host: str) -> tuple[bytes, bytes, str]:
    """Certificate (DER), private key (PEM) and URI of this server in `folder`, made at its first
    start for `uri`; the URI of a box with another name since then stays, for clients compare it
    with the certificate. host: where it listens. Raises ConfigError."""
    certificate, key = folder / "certificate.der", folder / "key.pem"
    try:
        if not (certificate.exists() and key.exists()):
            secret = cert_gen.generate_private_key()
            names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(uri)]
            names += [x509.DNSName(socket.gethostname())]
            with suppress(ValueError):
                names += [x509.IPAddress(ip_address(host))]
            made = cert_gen.generate_self_signed_app_certificate(
                *(secret, uri, {}, names, [ExtendedKeyUsageOID.SERVER_AUTH]), days=DAYS
            )
            folder.mkdir(parents=True, exist_ok=True)
            storage.put(key, cert_gen.dump_private_key_as_pem(secret), mode=0o600)
            storage.put(certificate, made.public_bytes(Encoding.DER), mode=0o644)
        both = certificate.read_bytes(), key.read_bytes()
        return *both, _uri(*both) or uri
    except ValueError as e:
        raise ConfigError(
            f"{certificate} and {key.name} are no pair ({printable(str(e))[:60]}); delete both, and"
            " trust the new certificate in the clients"
        ) from e
    except OSError as e:
        raise ConfigError(
            f"{folder}: {str(e.strerror).lower()}; name a folder of your own with --folder"
        ) from e


def _uri(certificate: bytes, key: bytes) -> str:
    """The URI of a certificate, "" for none. Raises ValueError if the key does not fit."""
    made = x509.load_der_x509_certificate(certificate)
    if load_pem_private_key(key, None).public_key() != made.public_key():
        raise ValueError("the key is of another certificate")
    with suppress(x509.ExtensionNotFound):
        names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")
    return ""


def limit(server: Server, most: int, *, users: bool, anonymous: bool) -> None:
    """Set who may do what, and how much of it. most: connections at a time. users: whether there is
    a login."""
    for name, level in (("asyncua", logging.CRITICAL), ("asyncio", logging.ERROR)):
        logging.getLogger(name).setLevel(level)  # hostile bytes would fill the log
    secure = ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt
    # the second is needed for discovery; Login refuses sessions there
    server.set_security_policy([secure, ua.SecurityPolicyType.NoSecurity], ReadersAndUsers())
    tokens: list[type] = [ua.UserNameIdentityToken] * users
    server.set_identity_tokens(tokens + [ua.AnonymousIdentityToken] * anonymous)
    server.limits = TransportLimits(65_535, 65_535, 17, MOST_MESSAGE)
    inner, service = server.iserver, server.iserver.subscription_service
    inner.max_connections, inner.max_pending_activation_seconds = most, ACTIVATED_S
    inner.max_pending_messages_per_connection = MOST_WAITING
    inner.max_subscriptions, inner.max_session_timeout_ms = SUBSCRIPTIONS, SESSION_MS
    inner.max_unacked_messages_per_subscription = UNREAD
    inner.max_monitored_item_queue_size = KEPT
    binary_server_asyncio.OPCUAProtocol = BoundedProtocol
    create = service.create_subscription

    async def paced(params: Any, *more: Any, **options: Any) -> Any:
        if 0 < params.RequestedPublishingInterval < FASTEST_MS:
            params.RequestedPublishingInterval = FASTEST_MS
        return await create(params, *more, **options)

    service.create_subscription = paced

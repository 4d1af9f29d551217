"""Signs and verifies bundles with ssh-keygen.

ssh-keygen (`-Y sign`, `-Y verify`; sections SSHSIG and ALLOWED SIGNERS of its manual) works with
keys that people already have. A manifest has the hash of every other file, so its signature covers
the whole bundle.
"""

from __future__ import annotations

import base64
import binascii
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.core.errors import BundleError, ConfigError, TemporaryError, passes

if TYPE_CHECKING:
    from subprocess import CompletedProcess

NAMESPACE = "palpate-bundle"
"""Namespace of bundles' signatures. A signature for another purpose, for example git, is not
accepted."""
MOST_SIGNATURE, MOST_SIGNERS = 16 << 10, 256 << 10
"""Largest sizes in bytes. A signature by the longest usual key, RSA of 16,384 bits, takes 6 kB."""
DEADLINE_S, INTERACTIVE_S = 10.0, 120.0
"""Time limits for ssh-keygen: by itself, which takes some milliseconds on a desktop; and with a
person who types a passphrase or touches a key."""
LINE = re.compile(
    r'(?P<name>[\w.@+-]+)[ \t]+(namespaces="[^"]*"[ \t]+)?'
    r"(?P<kind>ssh-ed25519|ssh-rsa|ecdsa-sha2-nistp(256|384|521)"
    r"|sk-(ssh-ed25519|ecdsa-sha2-nistp256)@openssh\.com)"
    r"[ \t]+(?P<key>[A-Za-z0-9+/]+={0,2})([ \t].*)?",
    re.ASCII,
)
"""A line of the signers' file: one name, one key. ssh-keygen also allows patterns, certificates and
dates. Dates need a correct clock, which a box may not have."""


def verify(message: bytes, signature: bytes, signers: Path, namespace: str = NAMESPACE) -> str:
    """The name of the signer in `signers` who signed `message` for this namespace, by default as a
    bundle's manifest.

    Raises BundleError if none of the signers did. Raises ConfigError if this cannot be checked: the
    file of signers is missing, empty or has an invalid line, or ssh-keygen is missing. Raises
    TemporaryError if ssh-keygen took too long or could not be run now.
    """
    if len(signature) > MOST_SIGNATURE:
        raise BundleError(f"signature has more than {MOST_SIGNATURE} bytes; sign the bundle again")
    trusted = _trusted(signers)
    with _as_file(trusted) as allowed, _as_file(signature) as signed:
        found = _keygen("find-principals", "-f", allowed, "-s", signed)
        names = found.stdout.decode(errors="replace").splitlines()
        if found.returncode or not names:
            raise BundleError(
                f"bundle is signed by none of the signers in {signers} ({_output(found)}); sign it "
                "with a key that is there (palpate-train sign), or have the administrator add the "
                "key"
            )
        refused = []
        for name in _holders(names[0], trusted):
            checked = _keygen(
                "verify", "-f", allowed, "-I", name, "-n", namespace, "-s", signed, message=message
            )
            if not checked.returncode:
                return name
            refused.append(_output(checked))
    raise BundleError(
        f"signature of {names[0]} does not fit the manifest ({refused[0]}); copy the "
        "bundle again, or sign it again (palpate-train sign)"
    )


def sign(
    message: bytes, key: Path, namespace: str = NAMESPACE, *, interactive: bool = True
) -> bytes:
    """The signature of `message`, by default as a bundle's manifest.

    key: a private key, or the public key of a private key in an agent. interactive: ssh-keygen may
    ask for a passphrase on the terminal. Raises ConfigError if the key does not sign.
    """
    done = _keygen(
        "sign", "-f", str(key), "-n", namespace, "-q", message=message, interactive=interactive
    )
    if done.returncode or not done.stdout:
        raise ConfigError(
            f"{key} does not sign; name a key of yours, or make one with ssh-keygen -t ed25519"
        )
    return bytes(done.stdout)


def own_key() -> Path:
    """The private key of the person at a desktop, if no other is named; `make install` makes it."""
    folder = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(folder) / "palpate" / "signing-key"


def _trusted(signers: Path) -> bytes:
    """The content of the file of signers, with each line checked, because ssh-keygen skips invalid
    lines silently. A byte order mark and any ends of line are allowed. Raises ConfigError."""
    try:
        with signers.open("rb") as f:
            data = f.read(MOST_SIGNERS + 1)
        each = re.split(r"\r\n|\r|\n", data.decode("utf-8-sig"))
        lines = [line.strip(" \t") for line in each]
    except (OSError, ValueError) as e:
        raise (TemporaryError if passes(e) else ConfigError)(
            f"{signers} cannot be read: {e}; put a line `NAME KEY` there for each who signs"
        ) from e
    if len(data) > MOST_SIGNERS:
        raise ConfigError(
            f"{signers} has more than {MOST_SIGNERS} bytes; keep one line for each who signs"
        )
    entries = [(n, line) for n, line in enumerate(lines, 1) if line and not line.startswith("#")]
    if not entries:
        raise ConfigError(
            f"{signers} has no signer, so no bundle can be trusted; put a line `NAME KEY` there"
        )
    for n, line in entries:
        if not _is_signer(line):
            raise ConfigError(
                f"{signers}, line {n} is not understood; write NAME ssh-ed25519 AAAA..., the rest "
                "as in a .pub file, without dates: a box may not know the time"
            )
    return "\n".join([*lines, ""]).encode()


def _holders(name: str, trusted: bytes) -> list[str]:
    """The names of all lines with a key of `name`, which comes first. ssh-keygen finds the first
    line of a key alone, and a further line may allow what that line does not."""
    lines = [found for line in trusted.decode().split("\n") if (found := LINE.fullmatch(line))]
    keys = {line["key"] for line in lines if line["name"] == name}
    return [*dict.fromkeys([name, *(line["name"] for line in lines if line["key"] in keys)])]


def _is_signer(line: str) -> bool:
    """Whether a line is a name and a key of the kind that the line states."""
    if not (found := LINE.fullmatch(line)):
        return False
    kind = found["kind"].encode()
    try:
        key = base64.b64decode(found["key"], validate=True)
    except binascii.Error:
        return False
    return key.startswith(len(kind).to_bytes(4, "big") + kind)


@contextmanager
def _as_file(data: bytes) -> Iterator[str]:
    """Path of a file in memory with `data` that a child process can open. So the child reads the
    bytes that were checked here, and no disk is needed."""
    at = os.memfd_create("palpate", 0)  # children inherit it
    try:
        try:
            os.write(at, data)
        except OSError as e:  # a limit on the size of files (RLIMIT_FSIZE)
            raise TemporaryError(
                f"a file in memory cannot be written: {e.strerror}; end other programs"
            ) from e
        yield f"/proc/self/fd/{at}"
    finally:
        os.close(at)


def _keygen(
    action: str, *options: str, message: bytes = b"", interactive: bool = False
) -> CompletedProcess[bytes]:
    """Run `ssh-keygen -Y action` on `message`. interactive: it may ask a person on the terminal.
    Raises ConfigError, and TemporaryError if it may run at the next attempt."""
    import subprocess  # 200 kB, needed only if a bundle was deployed

    try:
        done = subprocess.run(
            ["ssh-keygen", "-Y", action, *options],
            input=message,
            timeout=INTERACTIVE_S if interactive else DEADLINE_S,
            stdout=subprocess.PIPE,
            stderr=None if interactive else subprocess.PIPE,
            close_fds=False,
            check=False,
        )
    except FileNotFoundError as e:
        raise ConfigError(
            "ssh-keygen is missing, so no signature can be checked: apt install openssh-client"
        ) from e
    except PermissionError as e:
        raise ConfigError(f"ssh-keygen may not be run: {e}; check its permissions") from e
    except (OSError, subprocess.TimeoutExpired) as e:
        raise TemporaryError(
            f"ssh-keygen cannot be run now: {e}; try again, and `ssh-keygen -Y {action}` by hand"
        ) from e
    if done.returncode < 0:  # by the kernel, when memory is short
        raise TemporaryError(f"ssh-keygen was ended by signal {-done.returncode}; try again")
    return done


def _output(done: CompletedProcess[bytes]) -> str:
    """The error output of ssh-keygen, in one line."""
    text = b" ".join((done.stderr or b"").split()).decode(errors="replace")
    return text[:200] or f"ssh-keygen ended with {done.returncode}"

"""The signing key of the person at this desktop, and the line that lets a box accept it. Both are
made when they are first needed."""

from __future__ import annotations

import getpass
import re
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Lock

from fleet import Failed
from palpate.deployment.signature import own_key

_LOCK = Lock()


def make_own(key: Path) -> None:
    """Make `key` if it is that of this person and not there. Raises Failed."""
    if key == own_key():
        line(partial(print, file=sys.stderr))


def line(report: Callable[[str], None]) -> str:
    """The line of this person in `allowed_signers`. report: gets a text if a key was made. Raises
    Failed."""
    key = own_key()
    with _LOCK:  # boxes are installed at the same time
        if not key.exists():
            _make(key)
            report(
                f"made {key}, with which you sign bundles; it has no passphrase: "
                f"ssh-keygen -p -f {key} sets one"
            )
    try:
        kind, public = key.with_suffix(".pub").read_text().split()[:2]
    except (OSError, ValueError) as e:
        raise Failed(
            f"{key}.pub cannot be read: {e}; write it with ssh-keygen -y -f {key} > {key}.pub, or "
            "name a file of signers with SIGNERS=FILE"
        ) from e
    return f"{_name()} {kind} {public}\n"


def _make(key: Path) -> None:
    command: list[str | Path] = [
        "ssh-keygen",
        "-q",
        "-t",
        "ed25519",
        "-N",
        "",
        "-C",
        "palpate",
        "-f",
        key,
    ]
    try:
        key.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError) as e:
        raise Failed(f"{key} cannot be made: {e}; name a file of signers with SIGNERS=FILE") from e


def _name() -> str:
    """The name of this user, as a signer may have it."""
    return re.sub(r"[^A-Za-z0-9._-]", "-", getpass.getuser()) or "owner"

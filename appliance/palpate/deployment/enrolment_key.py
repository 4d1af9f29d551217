"""The key with which a box signs its own lessons: enrolled labels, and taught bundles.

`make install` makes the key's folder. `key` is the private key, which only the user palpate may
read. `signer` is the public key, a line of a file of signers that belongs to root. Signatures have
namespaces of their own, so they are not valid for delivered bundles, nor one kind for the other.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

from palpate.core import storage
from palpate.core.errors import BundleError, ConfigError, TemporaryError
from palpate.deployment import signature

NAMESPACE, TAUGHT = "palpate-enrolment", "palpate-taught"
"""Namespaces of enrolled labels, and of bundles that the box has taught."""
KEY, SIGNER = "key", "signer"
OTHERS = 0o077
"""Permission bits that a private key must not have."""
MADE_S = 30.0
"""Longest wait for ssh-keygen to make a key."""
PROBE = b"palpate: does this key sign?"
WHAT = {NAMESPACE: "the labels were not enrolled", TAUGHT: "the bundle was not taught"}


@dataclass(frozen=True, slots=True)
class EnrolmentKey:
    """The key in `folder`, below the setting store.keys."""

    folder: Path

    def make(self) -> bool:
        """Make the key for a bench, as `make install` does for a box; False where there is one, or
        its signer. Raises ConfigError if it cannot be made."""
        key, public = self.folder / KEY, self.folder / f"{KEY}.pub"
        try:
            if key.exists() or (self.folder / SIGNER).exists():
                return False
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "bench", "-f", str(key)]
            subprocess.run(command, check=True, capture_output=True, timeout=MADE_S)
            words = public.read_text("ascii").split()
            allowed = f'box namespaces="{NAMESPACE},{TAUGHT}" {words[0]} {words[1]}\n'
            storage.put(self.folder / SIGNER, allowed.encode())
            public.unlink()
        except (OSError, subprocess.SubprocessError) as e:
            raise ConfigError(f"{key} cannot be made: {e}; name a folder of your own") from e
        return True

    def check(self, namespace: str = NAMESPACE) -> None:
        """Raises ConfigError unless this user can sign an enrolment, or another file of the
        namespace, so that this box accepts it."""
        try:
            self.verify(PROBE, self.sign(PROBE, namespace), namespace)
        except BundleError as e:
            raise ConfigError(
                f"{self.folder / SIGNER} does not admit what {KEY} signs as {namespace}; remove "
                "both, run make install, and teach all labels again"
            ) from e

    def sign(self, data: bytes, namespace: str = NAMESPACE) -> bytes:
        """The signature of an enrolment. Raises ConfigError if the key is missing, damaged or not
        private."""
        path = self.folder / KEY
        try:
            mode = path.stat().st_mode
            path.open("rb").close()
        except OSError as e:
            raise ConfigError(
                f"{path}: {e.strerror}, so nothing can be enrolled; teach as the user palpate "
                "(sudo -u palpate palpate teach); if the key does not exist, run make install, "
                f"which makes a key unless {SIGNER} exists; on a bench name a folder of your own, "
                "where one is made: --set store.keys=DIR"
            ) from e
        again = f"remove it and {SIGNER}, run make install again, and teach again"
        if mode & OTHERS:
            raise ConfigError(f"{path} may be read by others (mode {mode & 0o777:o}); {again}")
        try:
            return signature.sign(data, path, namespace, interactive=False)
        except ConfigError as e:
            if "does not sign" not in str(e):
                raise  # ssh-keygen itself is missing or hangs
            raise ConfigError(f"{path} is damaged; {again}") from e

    def verify(self, data: bytes, signed: bytes, namespace: str = NAMESPACE) -> None:
        """Raises BundleError if this box did not sign `data` in the namespace, ConfigError if that
        cannot be checked, and TemporaryError if it may be at the next attempt."""
        signer = self.folder / SIGNER
        try:
            signature.verify(data, signed, signer, namespace)
        except BundleError as e:
            raise BundleError(
                f"{WHAT[namespace]} on this box, or altered since ({str(e).partition(';')[0]}); "
                "teach again here (palpate teach)"
            ) from e
        except TemporaryError:
            raise  # ssh-keygen may run at the next attempt
        except ConfigError as e:
            raise ConfigError(
                "whether this box enrolled the labels cannot be checked: "
                f"{str(e).partition(';')[0]}; run make install, which makes {SIGNER} again from "
                f"{KEY} if that exists; else teach again"
            ) from e

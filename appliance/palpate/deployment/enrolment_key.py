"""The key with which a box signs its own lessons: enrolled labels, and taught bundles.

`make install` makes the key's folder. `key` is the private key, which only the user palpate may
read. `signer` is the public key, a line of a file of signers that belongs to root. Signatures have
namespaces of their own, so they are not valid for delivered bundles, nor one kind for the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from palpate.core.errors import BundleError, ConfigError, TemporaryError
from palpate.deployment import signature

NAMESPACE, TAUGHT = "palpate-enrolment", "palpate-taught"
"""Namespaces of enrolled labels, and of bundles that the box has taught."""
KEY, SIGNER = "key", "signer"
OTHERS = 0o077
"""Permission bits that a private key must not have."""
PROBE = b"palpate: does this key sign?"


@dataclass(frozen=True, slots=True)
class EnrolmentKey:
    """The key in `folder`, below the setting store.keys."""

    folder: Path

    def check(self, namespace: str = NAMESPACE) -> None:
        """Raises ConfigError unless this user can sign an enrolment, or another file of the
        namespace, so that this box accepts it."""
        try:
            self.verify(PROBE, self.sign(PROBE, namespace), namespace)
        except BundleError as e:
            if namespace == TAUGHT:
                raise ConfigError(
                    f"{self.folder / SIGNER} does not admit taught bundles; run make install, "
                    "which adds that"
                ) from e
            raise ConfigError(
                f"{self.folder / KEY} is not the key of {self.folder / SIGNER}; remove both and "
                "run make install again: then teach all labels again"
            ) from e

    def sign(self, data: bytes, namespace: str = NAMESPACE) -> bytes:
        """The signature of an enrolment. Raises ConfigError if the key is missing, damaged or not
        private."""
        path = self.folder / KEY
        again = (
            "teach as the user palpate (sudo -u palpate palpate teach); if the key does not "
            f"exist, run make install, which makes a key unless {SIGNER} exists"
        )
        try:
            mode = path.stat().st_mode
            path.open("rb").close()
        except OSError as e:
            raise ConfigError(f"{path}: {e.strerror}, so nothing can be enrolled; {again}") from e
        if mode & OTHERS:
            raise ConfigError(
                f"{path} may be read by others (mode {mode & 0o777:o}); remove it and {SIGNER}, "
                "and run make install again"
            )
        try:
            return signature.sign(data, path, namespace, interactive=False)
        except ConfigError as e:
            if "does not sign" not in str(e):
                raise  # ssh-keygen itself is missing or hangs
            raise ConfigError(
                f"{path} is damaged; remove it and {SIGNER}, run make install again, and teach "
                "again"
            ) from e

    def verify(self, data: bytes, signed: bytes, namespace: str = NAMESPACE) -> None:
        """Raises BundleError if this box did not sign `data` in the namespace, ConfigError if that
        cannot be checked, and TemporaryError if it may be at the next attempt."""
        signer = self.folder / SIGNER
        try:
            signature.verify(data, signed, signer, namespace)
        except BundleError as e:
            if namespace == TAUGHT:
                raise BundleError(
                    "the bundle was not taught on this box, or altered since "
                    f"({e.args[0].partition(';')[0]}); teach it here (palpate teach), or sign it "
                    "on a desktop (palpate-train sign)"
                ) from e
            raise BundleError(
                "the labels were not enrolled on this box, or altered since "
                f"({e.args[0].partition(';')[0]}); teach them here (palpate teach)"
            ) from e
        except TemporaryError:
            raise  # ssh-keygen may run at the next attempt
        except ConfigError as e:
            raise ConfigError(
                "whether this box enrolled the labels cannot be checked: "
                f"{str(e).partition(';')[0]}; run make install, which makes {SIGNER} again from "
                f"{KEY} if that exists; else teach again"
            ) from e

"""The key with which a box signs the labels that it enrolled itself.

`make install` makes the key's folder. `key` is the private key, which only the user palpate may
read. `signer` is the public key, a line of a file of signers that belongs to root. Signatures have
a namespace of their own, so they are not valid for bundles.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from appliance.core.errors import BundleError, ConfigError
from appliance.deployment import signature

NAMESPACE = "palpate-enrolment"
KEY, SIGNER = "key", "signer"
OTHERS = 0o077
"""Permission bits that a private key must not have."""
PROBE = b"palpate: does this key sign?"


@dataclass(frozen=True, slots=True)
class EnrolmentKey:
    """The key in `folder`, below the setting store.keys."""

    folder: Path

    def check(self) -> None:
        """Raises ConfigError unless this user can sign an enrolment that this box accepts."""
        try:
            self.verify(PROBE, self.sign(PROBE))
        except BundleError as e:
            raise ConfigError(
                f"{self.folder / KEY} is not the key of {self.folder / SIGNER}; remove both and "
                "run make install again: then enrol all labels again"
            ) from e

    def sign(self, data: bytes) -> bytes:
        """The signature of an enrolment. Raises ConfigError if the key is missing, damaged or not
        private."""
        path = self.folder / KEY
        again = (
            "enrol as the user palpate (sudo -u palpate palpate enrol); if the key does not "
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
            return signature.sign(data, path, NAMESPACE, interactive=False)
        except ConfigError as e:
            if "does not sign" not in str(e):
                raise  # ssh-keygen itself is missing or hangs
            raise ConfigError(
                f"{path} is damaged; remove it and {SIGNER}, run make install again, and enrol "
                "again"
            ) from e

    def verify(self, data: bytes, signed: bytes) -> None:
        """Raises BundleError if this box did not sign `data` as an enrolment, ConfigError if that
        cannot be checked."""
        signer = self.folder / SIGNER
        try:
            signature.verify(data, signed, signer, NAMESPACE)
        except BundleError as e:
            raise BundleError(
                "the labels were not enrolled on this box, or altered since "
                f"({e.args[0].partition(';')[0]}); enrol them here (palpate enrol)"
            ) from e
        except ConfigError as e:
            raise ConfigError(
                "whether this box enrolled the labels cannot be checked: "
                f"{str(e).partition(';')[0]}; run make install, which makes {SIGNER} again from "
                f"{KEY} if that exists; else enrol again"
            ) from e

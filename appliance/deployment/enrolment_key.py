"""The key with which a box signs the labels that it enrolled itself. In: the folder that `make
install` has made, the bytes of enrolment.npz. Out: a signature, or a BundleError where the box did
not make one.

`key` is the private key, which user palpate alone may read; `signer` is the public one, which
belongs to root, as a line of a file of signers. Its signatures are for enrolments alone: another
namespace than that of bundles.
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
        """Raises ConfigError where this user could not sign an enrolment that this box then
        believes."""
        try:
            self.verify(PROBE, self.sign(PROBE))
        except BundleError as e:
            raise ConfigError(
                f"{self.folder / KEY} is not the key of {self.folder / SIGNER}; take both away and run make install again: "
                "what was enrolled before has to be enrolled again then"
            ) from e

    def sign(self, data: bytes) -> bytes:
        """The signature of an enrolment. Raises ConfigError where there is no key, or it is not
        private or damaged."""
        path = self.folder / KEY
        again = f"sudo -u palpate palpate enrol may read it; make install makes it where there is no {SIGNER} beside it"
        try:
            mode = path.stat().st_mode
            path.open("rb").close()
        except OSError as e:
            raise ConfigError(f"{path}: {e.strerror}, so nothing can be enrolled; {again}") from e
        if mode & OTHERS:
            raise ConfigError(
                f"{path} may be read by others (mode {mode & 0o777:o}); take it and {SIGNER} away, and run make install again"
            )
        try:
            return signature.sign(data, path, NAMESPACE, interactive=False)
        except ConfigError as e:
            if "does not sign" not in str(e):
                raise  # ssh-keygen itself is missing or hangs
            raise ConfigError(
                f"{path} is damaged; take it and {SIGNER} away, run make install again, and enrol again"
            ) from e

    def verify(self, data: bytes, signed: bytes) -> None:
        """Raises BundleError where this box did not sign `data` as an enrolment, ConfigError where
        that cannot be checked."""
        signer = self.folder / SIGNER
        try:
            signature.verify(data, signed, signer, NAMESPACE)
        except BundleError as e:
            raise BundleError(
                f"the labels were not enrolled on this box, or altered since ({e.args[0].partition(';')[0]}); enrol them "
                "here (palpate enrol)"
            ) from e
        except ConfigError as e:
            raise ConfigError(
                f"whether this box enrolled the labels cannot be checked: {str(e).partition(';')[0]}; make install makes it "
                f"again from {KEY}, where that is left; else enrol again"
            ) from e

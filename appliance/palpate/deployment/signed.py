"""Bundles with their signers, and the folder of the store that holds them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from palpate import __version__
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.bundle.manifest import version
from palpate.core import storage
from palpate.core.errors import BundleError
from palpate.deployment import signature
from palpate.deployment.enrolment_key import TAUGHT, EnrolmentKey

PACKAGER, HERE = "palpate", "taught here"
"""Shown as the signer of the packaged bundle, and of a bundle that this box has taught."""
INCOMPLETE = "."
"""First character of a folder's name while the folder is written or removed."""


@dataclass(frozen=True, slots=True)
class SignedBundle:
    """A bundle with its signer and the checked bytes of its files."""

    bundle: Bundle
    signer: str
    files: Mapping[str, bytes]

    @property
    def sha(self) -> str:
        """The bundle's name in the store."""
        return bundle.name(self.files)

    @property
    def taught(self) -> bool:
        """Whether this box has taught the bundle. A bundle that is signed as well counts as
        delivered."""
        return bundle.TAUGHT_SIGNATURE in self.files and bundle.SIGNATURE not in self.files


class BundleFolder:
    """Complete, verified bundles in `folder`, each under its name.

    signers: the file of trusted signers. key: this box's key for its own lessons. taught: whether
    bundles that it has taught are accepted."""

    def __init__(
        self, folder: Path, signers: Path, key: EnrolmentKey, *, taught: bool = True
    ) -> None:
        self.folder, self._signers, self._key, self._taught = folder, signers, key, taught

    def at(self, sha: str) -> Path:
        """The folder of the bundle `sha`."""
        return self.folder / sha

    def read(self, folder: Path) -> SignedBundle:
        """The bundle in any `folder`, checked but not run. Raises BundleError, and ConfigError as
        signature.verify."""
        return self.checked(bundle.files(folder), folder)

    def checked(self, files: Mapping[str, bytes], folder: Path) -> SignedBundle:
        """The bundle of `files`, which were read in `folder`. Raises as `read`."""
        signer = self._signer(files, folder)
        loaded = bundle.from_files(files, str(folder))
        if version(loaded.manifest.runtime) > version(__version__):
            raise BundleError(
                f"bundle needs palpate {loaded.manifest.runtime} and this is {__version__}; update "
                "the box (make install)"
            )
        return SignedBundle(loaded, signer, files)

    def _signer(self, files: Mapping[str, bytes], folder: Path) -> str:
        """The signer. Enrolled labels need the signature of this box. The bundle that they were
        enrolled into is signed, or is the packaged bundle, which is trusted like the program."""
        enrolled = bundle.ENROLMENT in files
        if enrolled:
            if bundle.ENROLMENT_SIGNATURE not in files:
                raise BundleError(
                    f"{folder}: {bundle.ENROLMENT} is not signed; teach again on this box "
                    "(palpate teach)"
                )
            self._key.verify(files[bundle.ENROLMENT], files[bundle.ENROLMENT_SIGNATURE])
        if bundle.SIGNATURE in files:
            signer = signature.verify(
                files[bundle.MANIFEST], files[bundle.SIGNATURE], self._signers
            )
        elif bundle.TAUGHT_SIGNATURE in files:
            if not self._taught:
                raise BundleError(
                    f"{folder} was taught on this box, which teach.allow = false forbids; deploy a "
                    "bundle, or set it to true"
                )
            self._key.verify(files[bundle.MANIFEST], files[bundle.TAUGHT_SIGNATURE], TAUGHT)
            signer = HERE
        elif not enrolled:
            raise BundleError(f"{folder} is not signed; sign the bundle (palpate-train sign)")
        elif files[bundle.MANIFEST] != (bundle.DEFAULT / bundle.MANIFEST).read_bytes():
            raise BundleError(
                f"{folder}: the bundle that {bundle.ENROLMENT} adds labels to is not signed, and "
                "is not the packaged bundle of this version; teach again"
            )
        else:
            signer = PACKAGER
        return f"{signer}, enrolled here" if enrolled else signer

    def get(self, sha: str) -> SignedBundle:
        """The bundle `sha`, checked again. Raises BundleError if its folder holds another
        bundle."""
        signed = self.read(self.at(sha))
        if signed.sha != sha:
            raise BundleError(
                f"{self.at(sha)} holds another bundle, {signed.bundle.id}; deploy the right one "
                "again"
            )
        return signed

    def put(self, signed: SignedBundle) -> None:
        """Write a bundle, completely or not at all. Raises OSError."""
        with storage.folder(self.at(signed.sha)) as new:
            for name, data in signed.files.items():
                (new / name).write_bytes(data)

    def keep(self, *kept: str) -> None:
        """Remove all other bundles and incomplete folders. A bundle is renamed before its files are
        removed."""
        for folder in sorted(self.folder.iterdir()):  # incomplete ones first
            if folder.name in kept:
                continue
            if not folder.name.startswith(INCOMPLETE):
                folder = folder.rename(folder.with_name(INCOMPLETE + folder.name))
            shutil.rmtree(folder)

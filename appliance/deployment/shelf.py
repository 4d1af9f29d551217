"""Bundles on the box's disk. In: a folder that somebody has filled. Out: a bundle whose signer is known; and, on the shelf,
such bundles whole, each under the sha256 of its manifest.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from appliance import __version__
from appliance.bundle import bundle
from appliance.bundle.bundle import Bundle
from appliance.bundle.manifest import version
from appliance.core import storage
from appliance.core.errors import BundleError
from appliance.deployment import signature

SHA = re.compile(r"[0-9a-f]{64}")
LEFTOVER = "."
"""How the name of a folder begins that is not complete, or no longer."""


@dataclass(frozen=True, slots=True)
class Signed:
    """A bundle and who signed it, with its files as they were checked."""

    bundle: Bundle
    signer: str
    files: Mapping[str, bytes]

    @property
    def sha(self) -> str:
        """The sha256 of its manifest."""
        return bundle.digest(self.files[bundle.MANIFEST])


class Shelf:
    """The bundles in `folder`. signers: the file of those who are believed."""

    def __init__(self, folder: Path, signers: Path) -> None:
        self.folder, self._signers = folder, signers

    def at(self, sha: str) -> Path:
        """Where a bundle lies."""
        return self.folder / sha

    def read(self, folder: Path) -> Signed:
        """The bundle in any `folder`, checked but not run. Raises BundleError, and ConfigError as signature.verify."""
        files = bundle.files(folder)
        if bundle.SIGNATURE not in files:
            raise BundleError(f"{folder} is not signed; sign the bundle (palpate-train sign)")
        signer = signature.verify(files[bundle.MANIFEST], files[bundle.SIGNATURE], self._signers)
        found = bundle.made(files, str(folder))
        if version(found.manifest.runtime) > version(__version__):
            raise BundleError(
                f"bundle needs palpate {found.manifest.runtime} and this is {__version__}; update the box (make install)"
            )
        return Signed(found, signer, files)

    def get(self, sha: str) -> Signed:
        """A bundle of the shelf, checked again: it, and no other in its place."""
        held = self.read(self.at(sha))
        if held.sha != sha:
            raise BundleError(f"{self.at(sha)} holds another bundle, {held.bundle.id}; deploy the right one again")
        return held

    def put(self, held: Signed) -> None:
        """Have a bundle on the disk, whole or not at all. Raises OSError."""
        folder = self.at(held.sha)
        if folder.exists() and _holds(folder, held.files):
            storage.sync(self.folder)  # who gave it its name may have been killed before this
            return
        with storage.folder(folder) as new:
            for name, data in held.files.items():
                (new / name).write_bytes(data)

    def keep(self, *kept: str) -> None:
        """Remove all other bundles and what an interruption left. A bundle loses its name before its files."""
        for folder in sorted(self.folder.iterdir()):  # leftovers first
            if folder.name in kept:
                continue
            if not folder.name.startswith(LEFTOVER):
                folder = folder.rename(folder.with_name(LEFTOVER + folder.name))
            shutil.rmtree(folder)


def _holds(folder: Path, files: Mapping[str, bytes]) -> bool:
    try:
        return bundle.files(folder) == files
    except BundleError:
        return False

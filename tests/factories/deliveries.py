"""Deliveries of bundles for tests: keys, signed bundles, a store that trusts one signer."""

import atexit
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.bundle.manifest import SCHEMA, Manifest
from palpate.core.config import StoreConfig
from palpate.deployment import signature
from palpate.deployment.enrolment_key import EnrolmentKey
from palpate.deployment.store import Store
from palpate.learn import enrolment
from tests.factories.install_scripts import enrolment_key

SIGNER = "anna@lab"
NEEDED = pytest.mark.skipif(
    not shutil.which("ssh-keygen"), reason="ssh-keygen is missing: apt install openssh-client"
)


def key(folder: Path, name: str = "key", kind: str = "ed25519") -> Path:
    """A new private key."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    subprocess.run(
        ["ssh-keygen", "-q", "-t", kind, "-N", "", "-C", name, "-f", path], check=True, timeout=120
    )
    return path


def line(key: Path, name: str = SIGNER, options: str = "") -> str:
    """The line of an allowed-signers file that trusts this key."""
    return f"{name} {options}{key.with_suffix('.pub').read_text()}"


def files(counter: int, key: Path | None, **changes: object) -> dict[str, bytes]:
    """The files of the default bundle with another counter, signed. changes: of its manifest."""
    held = {
        name: data
        for name, data in bundle.files(bundle.DEFAULT).items()
        if name != bundle.SIGNATURE
    }
    manifest = replace(
        Manifest.parse(held[bundle.MANIFEST]), counter=counter, schema=SCHEMA, **changes
    )  # type: ignore[arg-type]
    held[bundle.MANIFEST] = manifest.json()
    return signed(held, key) if key else held


def signed(held: dict[str, bytes], key: Path) -> dict[str, bytes]:
    """The files of a bundle with a matching manifest and its signature."""
    entries = {
        name: bundle.file_entry(data) for name, data in held.items() if name != bundle.MANIFEST
    }
    text = replace(Manifest.parse(held[bundle.MANIFEST]), files=entries).json()
    return held | {bundle.MANIFEST: text, bundle.SIGNATURE: signature.sign(text, key)}


def enrolled(
    held: dict[str, bytes], key: EnrolmentKey | None, label: str = "cork"
) -> dict[str, bytes]:
    """A bundle with one more label, made by the box from the first golden sweep."""
    made = bundle.from_files(held, "a test")
    new = enrolment.enrol(made, label, made.golden[:1])
    return enrolment.files(held, new, key.sign(new.file) if key else None)


def put(folder: Path, files: dict[str, bytes]) -> Path:
    """Write the files of a bundle to a new folder."""
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


@cache
def _keys() -> Path:
    """A sender's key and a box's key for enrolments, for all boxes of this process."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    key(folder / "keys")
    enrolment_key(folder / "enrolment")
    return folder


@cache
def _delivered(counter: int, **changes: object) -> dict[str, bytes]:
    """The same as `files`, signed with the sender's key."""
    return files(counter, _keys() / "keys" / "key", **changes)


class Delivery:
    """A box's store, and the sender of its bundles. All boxes of a process have the same keys."""

    def __init__(
        self, folder: Path, prove: Callable[[Bundle], object] = lambda bundle: None
    ) -> None:
        self.folder = folder
        shutil.copytree(_keys(), folder, dirs_exist_ok=True)
        self.key = folder / "keys" / "key"
        self.enrolment_key = EnrolmentKey(folder / "enrolment")
        self.how = StoreConfig(str(folder / "store"), str(folder), trial_sweeps=5)
        Path(self.how.folder).mkdir()
        self.how.signers.write_text(line(self.key))
        self.store = Store(self.how, prove)
        self._made = 0

    def made(self, counter: int, **changes: object) -> Path:
        """A folder with a signed bundle, as `deploy` copies it."""
        return self.copied(_delivered(counter, **changes))

    def copied(self, held: dict[str, bytes]) -> Path:
        """A folder with these files."""
        self._made += 1
        return put(self.folder / "incoming" / str(self._made), held)

    def installed(self, counter: int) -> str:
        """Install a bundle; returns its sha256."""
        return self.store.install(self.made(counter))

    def start(self) -> str:
        """Start the box. Returns the sha256 of its bundle, or "" for the packaged bundle."""
        folder = self.store.choose().folder
        return "" if folder == bundle.DEFAULT else folder.name

    def committed(self, counter: int) -> str:
        """Install and commit a bundle; returns its sha256."""
        sha = self.installed(counter)
        assert self.store.commit()
        return sha

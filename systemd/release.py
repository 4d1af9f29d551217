"""Packs the wheel, the lock and files of this checkout into one archive for each architecture and
Python version of the boxes.

The wheels of the lock are fetched on this machine and checked by their hashes, so the boxes need no
internet.
"""

from __future__ import annotations

import hashlib
import io
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

from packaging.requirements import Requirement

from fleet import Failed
from palpate import __version__
from palpate.core import storage
from palpate.core.errors import ApplianceError
from palpate.deployment import signature

ROOT = Path(__file__).resolve().parent.parent
LOCK, TEACH_LOCK = (ROOT / "appliance" / name for name in ("requirements.lock", "teach.lock"))
"""Libraries of the box, and the same with the libraries for teaching at the robot."""
SUMS, NAMESPACE = "SHA256SUMS", "palpate-release"
"""The list of an archive's files, and the namespace of its signature."""
GLIBC = 36
"""Newest glibc, 2.36 of Debian 12, that a wheel may need."""


class ReleaseArchives:
    """The archives for the boxes, one for each architecture and Python version. Each is made when
    the first box needs it.

    wheels: of Palpate, and of palpate-train if the boxes can be taught. shares: files and folders
    of this checkout that are packed too. folder: where the archives are written. key: it signs the
    list of all files and their hashes (SUMS), which the box checks before it installs them.
    """

    def __init__(
        self, wheels: Sequence[Path], shares: Sequence[str], folder: Path, key: Path
    ) -> None:
        self._wheels, self._key = wheels, key
        self._shares = [ROOT / name for name in shares if (ROOT / name).exists()]
        self._folder = folder
        self._lock = Lock()
        self._made: dict[tuple[str, str], tuple[str, Path]] = {}

    def of(self, machine: str, python: str) -> tuple[str, Path]:
        """Name and archive of the release. Raises Failed if a wheel cannot be fetched."""
        with self._lock:
            if (machine, python) not in self._made:
                self._made[machine, python] = self._make(machine, python)
            return self._made[machine, python]

    def _make(self, machine: str, python: str) -> tuple[str, Path]:
        libraries = TEACH_LOCK if len(self._wheels) > 1 else LOCK
        lock = locked(libraries.read_text(), python, machine)
        content = hashlib.sha256(f"{python.rpartition('.')[0]}\n{lock}".encode())
        for one in self._wheels:
            with zipfile.ZipFile(one) as wheel:  # not the wheel's own bytes: they contain dates
                content.update(
                    repr([(name, wheel.read(name)) for name in sorted(wheel.namelist())]).encode()
                )
        for file in sorted(
            path for share in self._shares for path in (share, *share.rglob("*")) if path.is_file()
        ):
            content.update(f"{file.relative_to(ROOT)}\n".encode() + file.read_bytes())
        name = f"{__version__}-{content.hexdigest()[:8]}"
        archive = self._folder / f"{name}-{machine}.tar"
        wheels = fetch(lock, python, machine)
        packed = {f"wheels/{f.name}": f for f in (*sorted(wheels.iterdir()), *self._wheels)}
        for share in self._shares:
            packed |= {
                f"share/palpate/{file.relative_to(share.parent)}": file
                for file in (share, *share.rglob("*"))
                if file.is_file()
            }
        sums = "".join(
            f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {name}\n"
            for name, file in packed.items()
        ).encode()
        try:
            signed = {SUMS: sums, f"{SUMS}.sig": signature.sign(sums, self._key, NAMESPACE)}
        except ApplianceError as e:
            raise Failed(str(e)) from e
        with tarfile.open(archive, "w") as tar:
            for name_in, data in signed.items():
                member = tarfile.TarInfo(name_in)
                member.size = len(data)
                tar.addfile(_plain(member), io.BytesIO(data))
            for name_in, file in packed.items():
                tar.add(file, name_in, filter=_plain)
        return name, archive


def _plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.mode = 0o755 if member.isdir() else 0o644
    return member


def locked(text: str, python: str, machine: str) -> str:
    """The lock without the lines for other Python versions or architectures. pip would evaluate
    their markers for the Python that it runs on."""
    box = {
        "python_full_version": python,
        "python_version": python.rpartition(".")[0],
        "platform_machine": machine,
    }
    kept = []
    for block in re.split(r"(?m)^(?=\w)", text):
        first, rest = block.partition("\\\n")[::2]
        if rest:
            requirement = Requirement(first.strip())
            if not requirement.marker or requirement.marker.evaluate(box):
                kept.append(f"{requirement.name}{requirement.specifier} \\\n{rest}")
    return "".join(kept)


def fetch(lock: str, python: str, machine: str) -> Path:
    """A folder with the lock and its wheels, which is kept. Raises Failed if pip cannot fetch
    them."""
    short = python.rpartition(".")[0]
    digest = hashlib.sha256(lock.encode()).hexdigest()[:8]
    target = ROOT / "build" / "wheels" / f"{machine}-{short}-{digest}"
    if target.exists():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with storage.folder(target) as part:
        (part / "requirements.lock").write_text(lock)
        command: list[str | Path] = [sys.executable, *_download(machine, short), "-d", part]
        done = subprocess.run(
            [*command, "-r", part / "requirements.lock"],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise Failed(
                f"wheels for {machine}, Python {short}: {done.stderr.strip().splitlines()[-1]}"
            )
    return target


def _download(machine: str, python: str) -> list[str]:
    """Arguments with which pip fetches wheels for another machine. python: "3.11"."""
    options = "-q download --no-deps --only-binary :all: --require-hashes --implementation cp"
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(GLIBC, 16, -1)]
    return [
        *("-m", "pip", "--disable-pip-version-check", *options.split()),
        *("--python-version", python),
        *(f"--platform={platform}" for platform in [*platforms, f"manylinux2014_{machine}"]),
    ]

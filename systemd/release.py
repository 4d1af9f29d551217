"""Packs a release for a box. In: the wheel, the lock, files of this checkout. Out: an archive for
each architecture and Python.

Wheels for another architecture or Python are fetched here, each checked by its hash: the boxes need
no internet for them.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

from fleet import Failed
from packaging.requirements import Requirement

from appliance import __version__
from appliance.core import storage

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "appliance" / "requirements.lock"
GLIBC = 36
"""Wheels may need glibc 2.36, that of Debian 12, or an older one."""


class ReleaseArchives:
    """What is copied to a box: one archive for each architecture and Python, made when the first
    box needs it.

    wheel: of Palpate. shares: files and folders of this checkout that are copied as well. folder:
    for the archives.
    """

    def __init__(self, wheel: Path, shares: Sequence[str], folder: Path) -> None:
        self._wheel = wheel
        self._shares = [ROOT / name for name in shares if (ROOT / name).exists()]
        self._folder = folder
        self._lock = Lock()
        self._made: dict[tuple[str, str], tuple[str, Path]] = {}

    def of(self, machine: str, python: str) -> tuple[str, Path]:
        """Name of the release, and its archive. Raises Failed where a wheel cannot be fetched."""
        with self._lock:
            if (machine, python) not in self._made:
                self._made[machine, python] = self._make(machine, python)
            return self._made[machine, python]

    def _make(self, machine: str, python: str) -> tuple[str, Path]:
        lock = locked(LOCK.read_text(), python, machine)
        content = hashlib.sha256(f"{python.rpartition('.')[0]}\n{lock}".encode())
        with zipfile.ZipFile(self._wheel) as wheel:  # not the file itself: it has dates in it
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
        with tarfile.open(archive, "w") as tar:
            for file in (*sorted(wheels.iterdir()), self._wheel):
                tar.add(file, f"wheels/{file.name}", filter=_plain)
            for share in self._shares:
                tar.add(share, f"share/palpate/{share.name}", filter=_plain)
        return name, archive


def _plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.mode = 0o755 if member.isdir() else 0o644
    return member


def locked(text: str, python: str, machine: str) -> str:
    """The lock without the lines for another Python or architecture: pip evaluates markers for the
    Python it runs on, also when it fetches for another."""
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
    """A folder with the lock and its wheels, kept for the next time. Raises Failed where pip cannot
    fetch them."""
    short = python.rpartition(".")[0]
    target = (
        ROOT
        / "build"
        / "wheels"
        / f"{machine}-{short}-{hashlib.sha256(lock.encode()).hexdigest()[:8]}"
    )
    if target.exists():
        return target
    tags = [f"--platform=manylinux_2_{minor}_{machine}" for minor in range(GLIBC, 16, -1)]
    target.parent.mkdir(parents=True, exist_ok=True)
    with storage.folder(target) as part:
        (part / "requirements.lock").write_text(lock)
        command: tuple[str | Path, ...] = (
            sys.executable,
            "-m",
            "pip",
            "--disable-pip-version-check",
            "-q",
            "download",
            "--no-deps",
            "--only-binary",
            ":all:",
            "--implementation",
            "cp",
            "--python-version",
            short,
            *tags,
            f"--platform=manylinux2014_{machine}",
            "--require-hashes",
            "-r",
            part / "requirements.lock",
            "-d",
            part,
        )
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise Failed(
                f"wheels for {machine}, Python {short}: {done.stderr.strip().splitlines()[-1]}"
            )
    return target

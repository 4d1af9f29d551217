"""A backup of a box: its settings, keys, bundles and recordings in one tar, and the way back, onto
this box or another.

The program and its files are not in it, since an installation brings them, nor is the page's
certificate, which names the old host. The last member has the digest of each file, so damage and a
missing end are found before anything is changed.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pwd
import re
import shutil
import tarfile
from grp import getgrnam
from pathlib import Path, PurePosixPath
from typing import IO

from palpate.core import storage
from palpate.core.errors import ApplianceError, FormatError

PARTS = {"settings": "/etc/palpate", "data": "/var/lib/palpate"}
"""Folders of a backup, and of a box."""
FIRST = ("data/current", "data/bundles.json")
"""Read first: they name bundles, which are added before they are named."""
LEFT_OUT = re.compile(
    r"settings/watch/(key|certificate)\.pem|data/(incoming|teaching)(/.*)?|.*\.(part|new)"
)
"""Files of this host alone, and files of unfinished work."""
END, SCHEMA = "digests.json", 1
BEFORE = ".before-restore"
"""Suffix of the folders that a restore has replaced."""
CURRENT = re.compile(r"bundles/[0-9a-f]{64}")


class HashedFile:
    """Reads a file and digests what was read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.digest = file, hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self.digest.update(data)
        return data


def save(out: IO[bytes], root: Path = Path("/")) -> int:
    """Write a backup of the box to `out`; returns the number of files. The service may run. root:
    the folder that holds the box's file system. Raises OSError, and ApplianceError if there is no
    box."""
    digests: dict[str, str] = {}
    with tarfile.open(fileobj=out, mode="w|") as tar:
        for part, place in PARTS.items():
            folder = root / place[1:]
            if not folder.is_dir():
                raise ApplianceError(f"there is no {folder}; Palpate is not installed here")
            named = {f"{part}/{path.relative_to(folder)}": path for path in folder.rglob("*")}
            for name in sorted(named, key=lambda name: (name not in FIRST, name != FIRST[0], name)):
                _add(tar, named[name], name, digests)
        text = json.dumps({"schema": SCHEMA, "files": digests}).encode()
        member = tarfile.TarInfo(END)
        member.size = len(text)
        tar.addfile(member, io.BytesIO(text))
    return len(digests)


def _add(tar: tarfile.TarFile, path: Path, name: str, digests: dict[str, str]) -> None:
    """Add a folder, a file or the link `current`; a file that was removed meanwhile is left
    out."""
    if LEFT_OUT.fullmatch(name) or (path.is_symlink() and name != FIRST[0]):
        return
    try:
        if path.is_symlink() or path.is_dir():
            tar.addfile(tar.gettarinfo(path, name))
            return
        if not path.is_file():  # a socket
            return
        with path.open("rb") as file:
            member, hashed = tar.gettarinfo(arcname=name, fileobj=file), HashedFile(file)
            member.type = tarfile.REGTYPE  # also of a file with two names
            tar.addfile(member, hashed)
        digests[name] = hashed.digest.hexdigest()
    except FileNotFoundError:
        return


def unpack(source: IO[bytes], root: Path = Path("/")) -> dict[str, Path]:
    """Unpack a backup next to the folders of the box and check it; returns the new folder of each
    part, synced, for `swap`.

    Settings that the backup lacks stay as they are on this box. Raises FormatError if the backup is
    damaged, ApplianceError if this box lacks its users, and OSError; nothing has changed then.
    """
    new = {part: root / f"{place[1:]}.new" for part, place in PARTS.items()}
    try:
        for part, folder in new.items():
            shutil.rmtree(folder, ignore_errors=True)
            old = root / PARTS[part][1:]
            if not old.is_dir():
                raise ApplianceError(f"there is no {old}; install Palpate on this box first")
            if part == "settings":
                shutil.copytree(old, folder, symlinks=True)
                for path in (old, *old.rglob("*")):
                    _own_like(path, folder / path.relative_to(old))
            else:
                folder.mkdir()
                _own_like(old, folder)
        _unpack(source, new)
        for folder in new.values():
            for path in (*folder.rglob("*"), folder):
                if not path.is_symlink():
                    storage.sync(path)
    except BaseException:
        for folder in new.values():
            shutil.rmtree(folder, ignore_errors=True)
        raise
    return new


def swap(new: dict[str, Path], root: Path = Path("/")) -> None:
    """Put unpacked folders in the place of the box's, whose content stays next to them. Raises
    OSError; a second restore completes the first."""
    for part, folder in new.items():
        old = root / PARTS[part][1:]
        before = old.with_name(old.name + BEFORE)
        shutil.rmtree(before, ignore_errors=True)
        storage.exchange(folder, old)
        folder.rename(before)
        storage.sync(old.parent)


def _unpack(source: IO[bytes], new: dict[str, Path]) -> None:
    found: dict[str, str] = {}
    stated: dict[str, str] | None = None
    try:
        with tarfile.open(fileobj=source, mode="r|") as tar:
            for member in tar:
                if member.name == END:
                    file = tar.extractfile(member)
                    assert file
                    held = json.loads(file.read())
                    if held["schema"] != SCHEMA:
                        raise FormatError(f"the backup has schema {held['schema']}; update Palpate")
                    stated = held["files"]
                else:
                    _take(tar, member, new, found)
    except (tarfile.TarError, ValueError, KeyError, TypeError, AssertionError) as e:
        raise FormatError(f"the backup cannot be read: {e}; copy it again") from e
    if stated is None:
        raise FormatError("the backup has no end; it was not copied completely: copy it again")
    if wrong := sorted(name for name in {*found, *stated} if found.get(name) != stated.get(name)):
        raise FormatError(f"the backup is damaged at {wrong[0]}; copy it again")
    link = new["data"] / "current"
    if link.is_symlink() and not link.resolve().is_dir():
        raise FormatError(f"the backup lacks its current bundle, {os.readlink(link)}; save again")


def _take(
    tar: tarfile.TarFile, member: tarfile.TarInfo, new: dict[str, Path], found: dict[str, str]
) -> None:
    """Write one member below the folder of its part. Raises FormatError for anything that `save`
    does not write."""
    part, _, name = member.name.partition("/")
    plain = part in new and name and ".." not in PurePosixPath(name).parts
    linked = member.name == FIRST[0] and CURRENT.fullmatch(member.linkname)
    if not plain or not (member.isreg() or member.isdir() or (member.issym() and linked)):
        raise FormatError(
            f"the backup has {member.name!r}, which no box has saved; "
            "use a file of `palpate backup`"
        )
    path = new[part] / name
    if member.issym():
        path.symlink_to(member.linkname)
        _own(path, member)
        return
    if member.isdir():
        path.mkdir(exist_ok=True)
    else:
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)  # a link to the program's own file
        file = tar.extractfile(member)
        assert file
        hashed = HashedFile(file)
        with path.open("xb") as out:
            shutil.copyfileobj(hashed, out)
        found[member.name] = hashed.digest.hexdigest()
    _own(path, member)
    path.chmod(member.mode & 0o777)


def _own(path: Path, member: tarfile.TarInfo) -> None:
    """Give a file to the user and group of the same names on this box; to the present user if this
    is not root. Raises ApplianceError."""
    if os.geteuid():
        return
    try:
        user, group = pwd.getpwnam(member.uname).pw_uid, getgrnam(member.gname).gr_gid
    except KeyError as e:
        raise ApplianceError(f"this box lacks {e.args[0]}; install Palpate here first") from e
    os.chown(path, user, group, follow_symlinks=False)


def _own_like(old: Path, new: Path) -> None:
    held = old.lstat()
    if not os.geteuid():
        os.chown(new, held.st_uid, held.st_gid, follow_symlinks=False)
    if not new.is_symlink():
        new.chmod(held.st_mode & 0o777)

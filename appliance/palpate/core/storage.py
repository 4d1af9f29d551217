"""Atomic writes: a file or folder is complete or absent, also after a loss of power.

A file is written under another name, synced and renamed, and its folder synced. So its name refers
to the old content or to all of the new at every moment. Nothing here handles an OSError, since only
the caller knows the consequences.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

PART = ".part"
"""Suffix of an unfinished file; after a crash such a file may be removed."""
AT_FDCWD, RENAME_EXCHANGE = -100, 2
"""Constants of the Linux system call renameat2."""


def put(
    path: Path, data: bytes, *, parents: bool = False, durable: bool = True, mode: int | None = None
) -> None:
    """Write one file completely or not at all. parents: make its folders. durable, mode: as for
    `put_all`. Raises OSError, and then leaves nothing behind."""
    if parents:
        path.parent.mkdir(parents=True, exist_ok=True)
    put_all({path: data}, durable=durable, mode=mode)


def put_all(files: Mapping[Path, bytes], *, durable: bool = True, mode: int | None = None) -> None:
    """Write files of one folder. They get their names in this order, so that a later file may refer
    to those before it.

    durable: False omits the syncs: every reader still finds a complete file, but a loss of power
    may leave a broken one. mode: permission bits, regardless of the umask; None leaves them to the
    umask. Raises OSError, and then leaves behind no file that did not exist before.
    """
    # as text: pathlib interns each new name, and Python never reuses a place in its table of
    # interned strings. With a file written each second the table would fill and be rebuilt, half a
    # MiB larger, during the work
    asides = {target: f"{target}{PART}" for target in files}
    taken: list[str] = []
    try:
        for target, data in files.items():
            write(asides[target], data, durable=durable, mode=mode)
        for target, aside in asides.items():
            new = not target.exists()
            os.replace(aside, target)
            if new:
                taken.append(str(target))
    except OSError as e:
        for left in (*asides.values(), *taken):
            with suppress(OSError):
                os.unlink(left)
        # a full disk is reported by a write, which does not know its file
        e.filename = (e.filename or str(next(iter(files)))).removesuffix(PART)
        raise
    for folder in {target.parent for target in files} if durable else ():
        sync(folder)


@contextmanager
def file(path: Path) -> Iterator[BinaryIO]:
    """A new file that gets its name when the block ends without an exception; otherwise nothing is
    left. Raises OSError with the name of the file."""
    aside = Path(f"{path}{PART}")
    try:
        with aside.open("w+b") as f:
            yield f
            f.flush()
            os.fsync(f.fileno())
        aside.replace(path)
        sync(path.parent)
    except BaseException as e:
        aside.unlink(missing_ok=True)
        if isinstance(e, OSError):  # a write to a full disk does not know its file
            e.filename = (str(e.filename) if e.filename else str(path)).removesuffix(PART)
        raise


def write(path: Path | str, data: bytes, *, durable: bool = True, mode: int | None = None) -> None:
    """Write one file under its own name, synced if `durable`."""
    with open(path, "wb") as f:
        if mode is not None:
            os.fchmod(f.fileno(), mode)
        f.write(data)
        f.flush()
        if durable:
            os.fsync(f.fileno())


@contextmanager
def folder(target: Path) -> Iterator[Path]:
    """A new folder next to `target`. If the block ends without an exception, its files are synced
    and it takes the name `target` in one step, replacing an earlier folder; otherwise it is
    removed. Raises OSError, with the name of the folder if a write fails."""
    import tempfile  # costs 1 MB of memory with its imports, needed only to write a bundle

    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as aside:
        new = Path(aside) / "new"
        new.mkdir()
        try:
            yield new
        except OSError as e:
            if not e.filename or str(e.filename).startswith(aside):
                e.filename = str(target)  # a write to a full disk does not know its file
            raise
        for path in (*new.iterdir(), new):
            sync(path)
        if target.exists():
            exchange(new, target)
        else:
            new.rename(target)
        sync(target.parent)


def locked(opened: int) -> bool:
    """Take the lock of an open file or folder, which its end or that of the process gives back;
    False while another program has it."""
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def sync(path: Path) -> None:
    """Flush a file's content, or the names in a folder, to the disk."""
    at = os.open(path, os.O_RDONLY)
    try:
        os.fsync(at)
    finally:
        os.close(at)


def link(path: Path, target: str) -> None:
    """Point the symlink `path` to `target` in one step; Linux cannot change a symlink in place."""
    aside = path.with_name(path.name + PART)
    aside.unlink(missing_ok=True)
    aside.symlink_to(target)
    aside.replace(path)
    sync(path.parent)


def exchange(one: Path, other: Path) -> None:
    """Swap two names in one step (renameat2), which Python's os does not offer."""
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(other))

"""The room of the disk: files that are whole or not there. In: names and bytes. Out: these, through a loss of power too.

A file is written aside, synced, renamed, and its folder synced: at every moment its name is what it was or the whole new
content. Nothing here catches an OSError; who calls knows what is lost by it.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

PART = ".part"
"""How the name of a file ends that is not finished; after a crash such a one may be taken away."""
AT_FDCWD, RENAME_EXCHANGE = -100, 2
"""Of the Linux call renameat2."""


def put(path: Path, data: bytes, *, parents: bool = False, durable: bool = True, mode: int | None = None) -> None:
    """Write one file, whole or not at all. parents: make its folders. durable, mode: as for `put_all`.

    Raises OSError, and then leaves nothing behind.
    """
    if parents:
        path.parent.mkdir(parents=True, exist_ok=True)
    put_all({path: data}, durable=durable, mode=mode)


def put_all(files: Mapping[Path, bytes], *, durable: bool = True, mode: int | None = None) -> None:
    """Write files of one folder; they take their names in this order, so the last may rely on those before it.

    durable: False leaves out the syncs; the file is still whole for every reader, but not after a loss of power. mode:
    permission bits, whatever the umask; None leaves them to the umask. Raises OSError where that fails, and then leaves
    none of them behind that was not there before.
    """
    asides = {target: target.with_name(target.name + PART) for target in files}
    taken: list[Path] = []
    try:
        for target, data in files.items():
            write(asides[target], data, durable=durable, mode=mode)
        for target, aside in asides.items():
            new = not target.exists()
            aside.replace(target)
            if new:
                taken.append(target)
    except OSError:
        for left in (*asides.values(), *taken):
            with suppress(OSError):
                left.unlink(missing_ok=True)
        raise
    for folder in {target.parent for target in files} if durable else ():
        sync(folder)


def write(path: Path, data: bytes, *, durable: bool = True, mode: int | None = None) -> None:
    """Write one file under its own name and sync it where it is to be `durable`: for a folder that takes its name only
    when it is complete."""
    with path.open("wb") as f:
        if mode is not None:
            os.fchmod(f.fileno(), mode)
        f.write(data)
        f.flush()
        if durable:
            os.fsync(f.fileno())


@contextmanager
def folder(target: Path) -> Iterator[Path]:
    """A new folder beside `target` that takes its name when the block ends well, in one step and with all its files on
    the disk, and vanishes when it does not; what was at `target` gives way. Raises OSError.
    """
    import tempfile  # with all it brings 1 MB, and only where a bundle is written

    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as aside:
        new = Path(aside) / "new"
        new.mkdir()
        yield new
        for path in (*new.iterdir(), new):
            sync(path)
        if target.exists():
            exchange(new, target)
        else:
            new.rename(target)
        sync(target.parent)


def sync(path: Path) -> None:
    """Have a file's content, or the names in a folder, on the disk."""
    at = os.open(path, os.O_RDONLY)
    try:
        os.fsync(at)
    finally:
        os.close(at)


def link(path: Path, target: str) -> None:
    """Have the symlink `path` lead to `target`, in one step; Linux cannot change one in place."""
    aside = path.with_name(path.name + PART)
    aside.unlink(missing_ok=True)
    aside.symlink_to(target)
    aside.replace(path)
    sync(path.parent)


def exchange(one: Path, other: Path) -> None:
    """Swap two names in one step; Python's os has no such call."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(other))

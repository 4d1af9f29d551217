"""A folder as a value that can be compared, hashed, and written again."""

import hashlib
import os
import re
from pathlib import Path

Tree = dict[str, bytes | str | None]
"""Path below the folder -> content of a file, target of a symlink, or None for a folder."""
NOTHING = re.compile("(?!)")
MADE_UP = re.compile(r"-[a-z0-9_]{8}(?=/|$)")


def read(folder: Path) -> Tree:
    """The contents of a folder."""
    found: Tree = {}
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        found[name] = (
            os.readlink(path) if path.is_symlink() else None if path.is_dir() else path.read_bytes()
        )
    return found


def write(found: Tree, folder: Path) -> None:
    """Make an empty folder hold these contents."""
    for name, held in sorted(found.items()):
        if held is None:
            (folder / name).mkdir()
        elif isinstance(held, str):
            (folder / name).symlink_to(held)
        else:
            (folder / name).write_bytes(held)


def digest(found: Tree, apart: re.Pattern[str] = NOTHING) -> str:
    """Equal for equal contents. Paths that match `apart`, and tempfile's names, do not count."""
    digested = hashlib.sha256()
    for name, held in sorted(
        (MADE_UP.sub("-*", name), held) for name, held in found.items() if not apart.fullmatch(name)
    ):
        data = held if isinstance(held, bytes) else repr(held).encode()
        digested.update(
            f"{name}\0{type(held).__name__}\0{len(data)}\0".encode("utf-8", "surrogateescape")
            + data
        )
    return digested.hexdigest()

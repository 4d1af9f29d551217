"""A disk that is only certain to keep synced data: computes all states of a folder that may be
found when the power returns.

Written data are certain to be on the disk only after a sync: the content of a file after an fsync
of the file, a name (new, renamed, removed) after an fsync of its folder. Until then:

- Changed names of one folder reach the disk in their order; those of different folders in any
  order. A rename is never half done, also from folder to folder, and an fsync of a folder includes
  everything that had to happen before.
- The content of a file may be all of it, the last synced content, nothing, the first half, or as
  many zeros; also for each file separately.

These guarantees are weaker than ext4's (where a sync of a file includes all earlier names), and
about those of POSIX. The target of a symlink is present as soon as its name is. Modes and owners
are ignored.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from tests.cuts.calls import NotFollowed, SystemCall
from tests.cuts.tree import NOTHING, Tree, digest

HOWS = ("all", "synced", "none", "half", "zeros")
"""What may be left of the content of a file that is not synced."""
IN_PLACE = re.compile(r"\.db(-wal|-journal)?$")
"""Files of SQLite, which changes parts of them: synced bytes in other sectors do not vanish. Of the
changed sectors the first half may be there, or zeros."""
SECTOR = 4096
MOST_STATES = 4096
"""Largest number of states of the names at one moment; a program with more should have synced
earlier."""


@dataclass(eq=False, slots=True)
class File:
    """synced: content certain to be on the disk. at: position of the next write, None: the end."""

    data: bytes = b""
    synced: bytes = b""
    at: int | None = 0


@dataclass(eq=False, slots=True)
class Folder:
    """names: as a program sees them. synced: those that are certain to be on the disk."""

    names: dict[str, Inode] = field(default_factory=dict)
    synced: dict[str, Inode] = field(default_factory=dict)


@dataclass(eq=False, slots=True)
class Link:
    """A symlink."""

    target: str


Inode = File | Folder | Link
Change = tuple[tuple[Folder, str, Inode | None], ...]
"""Names that change at once: folder, name, and its new inode (None if removed)."""


class Disk:
    """The disk under `folder`. It starts with the tree `there`, all of it synced; `effect` applies
    a call.

    apart: paths whose contents do not matter and are not varied.
    """

    def __init__(self, folder: Path, there: Tree, apart: re.Pattern[str] = NOTHING) -> None:
        self._path, self._apart = folder, apart
        self._root = Folder()
        self._open: list[Change] = []
        for name, held in sorted(there.items()):
            plain = Folder() if held is None else Link(str(held))
            inode = File(held, held) if isinstance(held, bytes) else plain
            above, last, _ = self._find(str(self._path / name))
            above.names[last] = above.synced[last] = inode

    def follow(self, calls: Iterable[SystemCall]) -> None:
        """Apply all calls. Raises NotFollowed."""
        for call in calls:
            if effect := self.effect(call):
                effect()

    def effect(self, call: SystemCall) -> Callable[[], None] | None:
        """The effect of this call on the folder; None if it has none. Raises NotFollowed."""
        if call.result is None or call.result < 0:
            return None
        if call.name == "sync":
            return self._sync_all
        if not any(self._inside(path) for path in call.paths):
            return None
        if call.process:
            raise NotFollowed(
                f"a process that the command started calls {call.name} on {call.paths}"
            )
        return self._effect(call)

    def _effect(self, call: SystemCall) -> Callable[[], None] | None:
        match call.name:
            case "open" | "openat" | "creat":
                return self._opened(call)
            case "write" | "writev" | "pwrite64":
                return self._written(call)
            case "lseek":
                if isinstance(file := self._at(call.paths[0]), File):
                    file.at = call.result
                return None
            case "truncate" | "ftruncate":
                return self._resized(call)
            case "fsync" | "fdatasync":
                return lambda: self._sync(self._at(call.paths[0]))
            case "syncfs":
                return self._sync_all
            case "sync_file_range":  # guarantees nothing
                return None
            case name if name.endswith(("mod", "modat", "own", "ownat")):
                return lambda: None
            case _:
                return self._renamed(call)

    def _renamed(self, call: SystemCall) -> Callable[[], None]:
        """A call that changes names."""
        here, name, there = self._find(call.paths[0])
        match call.name:
            case "mkdir" | "mkdirat":
                return lambda: self._change((here, name, Folder()))
            case "symlink" | "symlinkat":
                return lambda: self._change(
                    (here, name, Link(call.data.decode("utf-8", "surrogateescape")))
                )
            case "unlink" | "unlinkat" | "rmdir":
                return lambda: self._change((here, name, None))
            case "link" | "linkat":
                return lambda: self._change((*self._find(call.paths[1])[:2], there))
            case "rename" | "renameat" | "renameat2":
                to, new, old = self._find(call.paths[1])
                back = old if "RENAME_EXCHANGE" in call.words else None
                return lambda: self._change((here, name, back), (to, new, there))
        raise NotFollowed(f"{call.name} of {call.paths[0]} is not followed here; teach it here")

    def _opened(self, call: SystemCall) -> Callable[[], None] | None:
        above, name, there = self._find(call.paths[0], follow="O_NOFOLLOW" not in call.words)
        if call.name != "creat" and not any(
            flag in call.words for flag in ("O_CREAT", "O_WRONLY", "O_RDWR")
        ):
            return None
        at = None if "O_APPEND" in call.words else 0
        if there is None:
            return lambda: self._change((above, name, File(at=at)))
        if not isinstance(there, File):
            return None
        there.at = at
        if there.data and (call.name == "creat" or "O_TRUNC" in call.words):
            return lambda: setattr(there, "data", b"")
        return None

    def _written(self, call: SystemCall) -> Callable[[], None] | None:
        file, n = self._at(call.paths[0]), call.result
        assert n is not None
        if not isinstance(file, File) or not n:
            return None  # the file has no name any more

        def write() -> None:
            alone = call.name == "pwrite64"
            at = len(file.data) if file.at is None else file.at
            if alone:
                at = int(call.words.rsplit(", ", 1)[1])
            file.data = file.data[:at].ljust(at, b"\0") + call.data[:n] + file.data[at + n :]
            if not alone and file.at is not None:
                file.at = at + n

        return write

    def _resized(self, call: SystemCall) -> Callable[[], None] | None:
        file, size = self._at(call.paths[0]), int(call.words.rsplit(", ", 1)[1])
        if not isinstance(file, File):
            return None
        return lambda: setattr(file, "data", file.data[:size].ljust(size, b"\0"))

    def _inside(self, path: str) -> bool:
        return PurePosixPath(path).is_relative_to(self._path)

    def _find(
        self, path: str, follow: bool = False, depth: int = 0
    ) -> tuple[Folder, str, Inode | None]:
        """The folder that contains `path`, its name there, and its inode. Symlinks on the way are
        followed; a symlink at the end only if `follow` is set."""
        if depth > 40 or not self._inside(path):
            raise NotFollowed(f"{path} leads out of {self._path}")
        folder, done = self._root, self._path
        *way, last = (PurePosixPath(path).relative_to(self._path)).parts or (".",)
        for i, name in enumerate((*way, last)):
            there = folder.names.get(name)
            if isinstance(there, Link) and (follow or i < len(way)):
                rest = (*way, last)[i + 1 :]
                target = os.path.normpath(done.joinpath(there.target, *rest))
                return self._find(target, follow, depth + 1)
            if i < len(way):
                if not isinstance(there, Folder):
                    raise NotFollowed(f"{path} goes through {name}, which is no folder")
                folder, done = there, done / name
        return folder, last, folder.names.get(last)

    def _at(self, path: str) -> Inode | None:
        """The inode at `path`."""
        return self._root if Path(path) == self._path else self._find(path)[2]

    def _change(self, *change: tuple[Folder, str, Inode | None]) -> None:
        for folder, name, inode in change:
            _set(folder.names, name, inode)
        self._open.append(change)

    def _sync(self, inode: Inode | None) -> None:
        if isinstance(inode, File):
            inode.synced = inode.data
        elif isinstance(inode, Folder):
            touched, forced, later = {id(inode)}, [], []
            for change in reversed(self._open):
                folders = {id(folder) for folder, _, _ in change}
                if touched & folders:
                    touched |= folders
                    forced.insert(0, change)
                else:
                    later.insert(0, change)
            self._open = later
            _settle(forced)

    def _sync_all(self) -> None:
        _settle(self._open)
        self._open = []
        for _, inode in _walk(self._root, {}):
            self._sync(inode)

    def seen(self) -> Tree:
        """The folder as programs see it."""
        there = _walk(self._root, _overlay(self._open))
        return {path: _held(inode, "all") for path, inode in there}

    def left(self) -> Iterator[Tree]:
        """Each folder that may be found if the power fails now, once."""
        reported = set()
        for happened in self._happened():
            there = list(_walk(self._root, _overlay(happened)))
            unsure = [
                inode
                for path, inode in there
                if isinstance(inode, File)
                and inode.data != inode.synced
                and not self._apart.fullmatch(path)
            ]
            ways = [dict.fromkeys(map(id, unsure), how) for how in HOWS]
            for one in unsure if len(unsure) > 1 else ():
                ways += [ways[0] | {id(one): "synced"}, ways[1] | {id(one): "all"}]
            for way in ways if unsure else [{}]:
                found = {
                    path: _held(
                        inode, way.get(id(inode), "all"), in_place=bool(IN_PLACE.search(path))
                    )
                    for path, inode in there
                }
                if (name := digest(found, self._apart)) not in reported:
                    reported.add(name)
                    yield found

    def _happened(self) -> list[tuple[Change, ...]]:
        """Each set of changes on the disk: with all earlier ones that share a folder."""
        sets: list[tuple[int, ...]] = [()]
        for i, change in enumerate(self._open):
            folders = {id(folder) for folder, _, _ in change}
            shares = [any(id(folder) in folders for folder, _, _ in c) for c in self._open[:i]]
            before = [j for j, shared in enumerate(shares) if shared]
            sets += [(*there, i) for there in sets if set(before) <= set(there)]
            if len(sets) > MOST_STATES:
                raise NotFollowed(
                    f"{len(self._open)} names are not synced, too many to try what may be left"
                )
        return [tuple(self._open[i] for i in there) for there in sets]


def _set(names: dict[str, Inode], name: str, inode: Inode | None) -> None:
    if inode is None:
        names.pop(name, None)
    else:
        names[name] = inode


def _settle(changes: list[Change]) -> None:
    """These names are now certain to be on the disk."""
    for change in changes:
        for folder, name, inode in change:
            _set(folder.synced, name, inode)


def _overlay(changes: list[Change] | tuple[Change, ...]) -> dict[int, dict[str, Inode | None]]:
    over: dict[int, dict[str, Inode | None]] = {}
    for change in changes:
        for folder, name, inode in change:
            over.setdefault(id(folder), {})[name] = inode
    return over


def _walk(
    folder: Folder, over: dict[int, dict[str, Inode | None]], at: str = ""
) -> Iterator[tuple[str, Inode]]:
    """Paths and inodes below a folder: its synced names, overridden by `over`."""
    names = folder.synced | over.get(id(folder), {})
    for name, inode in sorted(names.items(), key=lambda entry: entry[0]):
        if inode is not None:
            yield f"{at}{name}", inode
            if isinstance(inode, Folder):
                yield from _walk(inode, over, f"{at}{name}/")


def _held(inode: Inode, how: str, *, in_place: bool = False) -> bytes | str | None:
    match inode:
        case Folder():
            return None
        case Link():
            return inode.target
    data = inode.data
    if in_place:
        return _torn(data, inode.synced, how)
    held = (data, inode.synced, b"", data[: len(data) // 2], bytes(len(data)))
    return held[HOWS.index(how)]


def _torn(data: bytes, synced: bytes, how: str) -> bytes:
    """The content of a file that is changed in place."""
    sectors = range(0, max(len(data), len(synced)), SECTOR)
    changed = [at for at in sectors if data[at : at + SECTOR] != synced[at : at + SECTOR]]
    if how == "all" or not changed:
        return data
    if how == "half":
        middle = changed[len(changed) // 2]
        return data[:middle] + synced[middle:]
    if how == "zeros":
        zeros = bytearray(data)
        for at in changed:
            zeros[at : at + SECTOR] = bytes(len(zeros[at : at + SECTOR]))
        return bytes(zeros)
    return synced

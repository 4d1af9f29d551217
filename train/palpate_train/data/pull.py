"""Fetches recordings from a box over ssh. Files that are already here stay as they are.

The box needs sshd, a shell, find, sha256sum and tar, but no part of Palpate. It lists each file
with its SHA-256. New files come in one stream, pair by pair (.npy and .json). Each pair is checked
as a recording before it is stored under its name. So a lost connection leaves no incomplete pair,
and the next call fetches the rest.
"""

from __future__ import annotations

import hashlib
import re
import shlex
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, cast

from palpate.core import storage
from palpate.core.config import StoreConfig
from palpate.core.errors import ApplianceError, FormatError
from palpate.core.sweep_file import load
from palpate.core.text import say
from palpate_train.data.progress import Progress

FOLDER = f"{StoreConfig().folder}/sweeps"
PAIR = (".json", ".npy")
"""The files of a recording in the order in which they are written: an .npy always has its
sidecar."""
SSH_OPTIONS = (
    "BatchMode=yes",
    "ConnectTimeout=10",
    "ServerAliveInterval=5",
    "ServerAliveCountMax=3",
)
"""ssh asks no questions, and a box that is silent for 15 s counts as disconnected."""
AS_READER = (
    'if cd -- "$1" 2>/dev/null && test -r .; '
    'then exec sh -c "$2" sh "$1"; else exec sudo -n sh -c "$2" sh "$1"; fi'
)
"""Runs script $2 in folder $1, with sudo only if the user cannot read the folder."""
ABSENT = 44
"""Exit code of LIST if the folder does not exist."""
LIST = f"""test -e "$1" || exit {ABSENT}
cd -- "$1" || exit
find . -type f '(' -name '*.npy' -o -name '*.json' ')' -exec sha256sum -z -- {{}} +
test $? -le 1"""
"""Lists files with their SHA-256. Exit code 1 of find is accepted: a file was removed meanwhile,
find reports that and lists the others."""
SEND = 'cd -- "$1" && exec tar -c --null -T - -f -'
LISTED = re.compile(rb"([0-9a-f]{64})  \./(.+)", re.S)
MAX_BYTES = 1 << 30
"""Largest file that is accepted."""
MAX_LIST = 1 << 26
"""Longest list of files that is accepted, in bytes: half a million files."""
MAX_HEADERS = 1 << 20
"""Most bytes before a file in the stream, which tarfile reads into memory."""
SHOWN = 5
"""Largest number of names in a line of the report."""


@dataclass(frozen=True)
class RecordingHost:
    """A box with recordings. options: further options of ssh, which override SSH_OPTIONS."""

    host: str
    folder: str = FOLDER
    options: Sequence[str] = ()

    @contextmanager
    def output(
        self, script: str, stdin: IO[bytes] | int = subprocess.DEVNULL
    ) -> Iterator[IO[bytes]]:
        """A context with the output of a script that runs in the folder, with sudo if the user
        cannot read the folder; leaving it waits for the script's end.

        The script's messages go to stderr. Raises ApplianceError if ssh is not installed, the box
        cannot be reached or the script fails.
        """
        ours = [part for option in SSH_OPTIONS for part in ("-o", option)]
        remote = shlex.join(["sh", "-c", AS_READER, "sh", self.folder, script])
        command = ["ssh", *self.options, *ours, "--", self.host, remote]
        with tempfile.TemporaryFile() as errors:
            try:
                process = subprocess.Popen(
                    command, stdin=stdin, stdout=subprocess.PIPE, stderr=errors
                )
            except FileNotFoundError:
                raise ApplianceError("ssh is not installed; apt install openssh-client") from None
            with process:
                try:
                    assert process.stdout
                    yield process.stdout
                    while process.stdout.read(1 << 16):
                        pass
                except BaseException:
                    process.kill()
                    raise
                code = process.wait()
            errors.seek(0)
            said = errors.read(1 << 16).decode(errors="replace")
            messages = " / ".join(said.split("\n")).strip(" /")
        if messages:
            say(f"{self.host}: {messages}", file=sys.stderr)
        self._check(code)

    def _check(self, code: int) -> None:
        """Raise ApplianceError for an exit code of a script."""
        if code == 255:
            raise ApplianceError(
                f"{self.host}: no connection; see that `ssh {self.host} true` works"
            )
        if code == ABSENT:
            raise ApplianceError(
                f"{self.host}: there is no {self.folder}; "
                "record something first (`palpate record`), or name another folder with --from"
            )
        if code:
            raise ApplianceError(
                f"{self.host}: {self.folder} cannot be read; name another folder with --from, "
                "add the user to its group (sudo usermod -aG palpate USER), "
                "or run the same command again"
            )


@dataclass
class PullReport:
    """The names of all recordings, without suffix, by what happened to them. present: already here,
    and the same. relabelled, different: here with another .json, another .npy. refused: not stored;
    the reason follows the name."""

    fetched: list[str] = field(default_factory=list)
    present: list[str] = field(default_factory=list)
    incomplete: list[str] = field(default_factory=list)
    relabelled: list[str] = field(default_factory=list)
    different: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def pull(box: RecordingHost, out: Path, report: PullReport, log: Callable[[str], None]) -> None:
    """Fetch all recordings that are not yet in `out`; each result is added to `report` at once.

    Raises ApplianceError if the box cannot be reached or read or the connection ends, FormatError
    if the box sends files that were not requested, and OSError if `out` cannot be written.
    """
    listed = listing(box)
    wanted = list(_new_recordings(listed, out, report))
    if not wanted:
        return
    names = [name + suffix for name in wanted for suffix in PAIR]
    progress = Progress(len(wanted), log)
    with tempfile.TemporaryFile() as request:
        request.write(b"".join(f"{name}\0".encode() for name in names))
        request.seek(0)
        with box.output(SEND, request) as stream:
            for name, pair in _pairs(stream, names):
                _keep(name, pair, {suffix: listed[name + suffix] for suffix in PAIR}, out, report)
                progress(name)
    if progress.done < len(wanted):
        raise ApplianceError(
            f"{box.host}: only {progress.done} of {len(wanted)} recordings came; "
            "run the same command again"
        )


def listing(box: RecordingHost) -> dict[str, str]:
    """The SHA-256 of each file on the box, by its path. Raises FormatError if the box sends
    something else."""
    with box.output(LIST) as stream:
        data = stream.read(MAX_LIST + 1)
        if len(data) > MAX_LIST:
            raise FormatError(
                f"{box.host} lists files without end; check that box, or name a smaller folder "
                "with --from"
            )
    lines = data.split(b"\0")
    listed = {}
    for line in filter(None, lines):
        if not (found := LISTED.fullmatch(line)):
            raise FormatError(
                f"{box.host} sends {line!r} instead of a list of files; "
                "see that its shell prints nothing at login"
            )
        listed[found[2].decode(errors="surrogateescape")] = found[1].decode()
    return listed


def _new_recordings(listed: Mapping[str, str], out: Path, report: PullReport) -> Iterator[str]:
    """The names, without suffix, of recordings that are not here yet.

    All others are added to the report.
    """
    for name in sorted({file.rpartition(".")[0] for file in listed}):
        if not name.isprintable() or name.startswith("/") or ".." in name.split("/"):
            report.refused.append(f"{name!r} (not a name for a file here)")
            continue
        theirs = {suffix: listed.get(name + suffix) for suffix in PAIR}
        ours = {suffix: _sha256(out / (name + suffix)) for suffix in PAIR}
        differ = [suffix for suffix in PAIR if ours[suffix] and ours[suffix] != theirs[suffix]]
        if None in theirs.values():
            report.incomplete.append(name)
        elif ".npy" in differ:
            report.different.append(name)
        elif differ:
            report.relabelled.append(name)
        elif None in ours.values():
            yield name
        else:
            report.present.append(name)


def _sha256(path: Path) -> str | None:
    """The SHA-256 of a local file, None if it does not exist."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return None


class _Bounded:
    """A stream of a box with `left` bytes to read."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self.left = stream, MAX_HEADERS

    def read(self, size: int) -> bytes:
        """Raises FormatError if it is more than that."""
        self.left -= size
        if self.left < 0:
            raise FormatError("the box sends more than was requested; check that box")
        return self._stream.read(size)


def _pairs(stream: IO[bytes], names: Sequence[str]) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Each recording as soon as both of its files have arrived, one after the other as requested;
    at most these two are in memory.

    names: the requested files. Raises FormatError if the archive holds anything else: a link, a
    device, a path outside the folder, a file twice, or a file of more than MAX_BYTES. A stream that
    is cut off ends the iteration.
    """
    requested = set(names)
    received: dict[str, bytes] = {}
    bounded = _Bounded(stream)
    try:
        with tarfile.open(fileobj=cast("IO[bytes]", bounded), mode="r|") as archive:
            for member in archive:
                name = member.name
                if not member.isreg() or name not in requested or member.size > MAX_BYTES:
                    raise FormatError(
                        f"the box sends {name!r}, which was not requested; check that box"
                    )
                requested.remove(name)
                bounded.left = member.size + MAX_HEADERS
                file = archive.extractfile(member)
                assert file
                recording, _, _ = name.rpartition(".")
                received = {k: v for k, v in received.items() if k.startswith(f"{recording}.")}
                received[name] = file.read()
                if all(recording + suffix in received for suffix in PAIR):
                    yield recording, {suffix: received.pop(recording + suffix) for suffix in PAIR}
    except (tarfile.TarError, EOFError):
        return


def _keep(
    name: str, pair: Mapping[str, bytes], sha256: Mapping[str, str], out: Path, report: PullReport
) -> None:
    """Store one recording if its hashes match the list and it can be read; else report why not."""
    try:
        for suffix, data in pair.items():
            if hashlib.sha256(data).hexdigest() != sha256[suffix]:
                raise FormatError(
                    f"{name}{suffix} changed while it was fetched; run the same command again"
                )
        with tempfile.TemporaryDirectory() as folder:
            for suffix, data in pair.items():
                Path(folder, f"sweep{suffix}").write_bytes(data)
            load(Path(folder, "sweep.npy"))
    except FormatError as e:
        report.refused.append(f"{name} ({e})")
        return
    target = out / name
    target.parent.mkdir(parents=True, exist_ok=True)
    storage.put_all({target.with_name(target.name + suffix): data for suffix, data in pair.items()})
    report.fetched.append(name)

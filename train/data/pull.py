"""The room of fetching. In: a box's recordings, over ssh. Out: the same files here; what is here already stays as it is.

The box needs sshd, a shell, find, sha256sum and tar, and nothing of Palpate's. It lists each file with its SHA-256; what
is new comes in one stream, pair by pair (.npy and .json). A pair is read as a recording before it takes its names, so
whatever ends the connection, no half of one is left under them, and the next call goes on with the rest.
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
from typing import IO

from appliance.core import storage
from appliance.core.config import StoreConfig
from appliance.core.errors import ApplianceError, FormatError
from appliance.core.types import load

FOLDER = f"{StoreConfig().folder}/sweeps"
PAIR = (".json", ".npy")
"""In the order in which they take their names: an .npy never lacks its sidecar."""
WAITS = ("BatchMode=yes", "ConnectTimeout=10", "ServerAliveInterval=5", "ServerAliveCountMax=3")
"""No question is asked, and a box that is silent for 15 s has gone."""
AS_READER = (
    'if cd -- "$1" 2>/dev/null && test -r .; then exec sh -c "$2" sh "$1"; else exec sudo -n sh -c "$2" sh "$1"; fi'
)
LIST = """cd -- "$1" || exit
find . -type f '(' -name '*.npy' -o -name '*.json' ')' -exec sha256sum -z -- {} +
test $? -le 1"""
"""find ends with 1 where a file went away meanwhile: it is told, and the others are listed all the same."""
SEND = 'cd -- "$1" && exec tar -c --null -T - -f -'
LISTED = re.compile(rb"([0-9a-f]{64})  \./(.+)", re.S)
LARGEST = 1 << 30
"""Bytes of a file that is taken."""
SHOWN = 5
"""Names that a line tells."""


@dataclass(frozen=True)
class RecordingHost:
    """Where the recordings are. options: of ssh, which go before ours. Raises ApplianceError where it cannot be asked."""

    host: str
    folder: str = FOLDER
    options: Sequence[str] = ()

    def run(self, script: str, given: IO[bytes] | int, told: IO[bytes]) -> subprocess.Popen[bytes]:
        """Start a script in the folder, as whoever may read it. given: what it reads. told: where its troubles go."""
        ours = [part for wait in WAITS for part in ("-o", wait)]
        remote = shlex.join(["sh", "-c", AS_READER, "sh", self.folder, script])
        try:
            return subprocess.Popen(
                ["ssh", *self.options, *ours, "--", self.host, remote], stdin=given, stdout=subprocess.PIPE, stderr=told
            )
        except FileNotFoundError:
            raise ApplianceError("ssh is not installed; apt install openssh-client") from None

    @contextmanager
    def reading(self, script: str, given: IO[bytes] | int = subprocess.DEVNULL) -> Iterator[IO[bytes]]:
        """What the script sends. It has ended when this ends. Raises ApplianceError where it failed."""
        with tempfile.TemporaryFile() as told, self.run(script, given, told) as process:
            try:
                assert process.stdout
                yield process.stdout
                process.stdout.read()
            except BaseException:
                process.kill()
                raise
            code = process.wait()
            told.seek(0)
            said = " / ".join(told.read().decode(errors="replace").split("\n")).strip(" /")
        if said:
            print(f"{self.host}: {said}", file=sys.stderr)
        if code == 255:
            raise ApplianceError(f"{self.host}: no connection; see that `ssh {self.host} true` works")
        if code:
            raise ApplianceError(
                f"{self.host}: {self.folder} cannot be read; name another with --from, let the user into its group "
                "(sudo usermod -aG palpate USER), or run the same command again"
            )


@dataclass
class PullReport:
    """What became of the recordings, by their names without ending."""

    fetched: list[str] = field(default_factory=list)
    there: list[str] = field(default_factory=list)
    halves: list[str] = field(default_factory=list)
    relabelled: list[str] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def pull(box: RecordingHost, out: Path, tally: PullReport, log: Callable[[str], None]) -> None:
    """Fetch into `out` what is not there yet; what becomes of each recording is put into `tally` as it happens.

    Raises ApplianceError where the box cannot be reached or read or the connection ends, FormatError where it sends what
    was not asked for, OSError where `out` cannot be written.
    """
    listed = listing(box)
    wanted = list(_wanted(listed, out, tally))
    if not wanted:
        return
    names, came = [name + suffix for name in wanted for suffix in PAIR], 0
    with tempfile.TemporaryFile() as given:
        given.write(b"".join(f"{name}\0".encode() for name in names))
        given.seek(0)
        with box.reading(SEND, given) as stream:
            for came, (name, pair) in enumerate(_pairs(stream, names), 1):
                _take(name, pair, {suffix: listed[name + suffix] for suffix in PAIR}, out, tally)
                log(f"{came} of {len(wanted)}")
    if came < len(wanted):
        raise ApplianceError(f"{box.host}: only {came} of {len(wanted)} recordings came; run the same command again")


def listing(box: RecordingHost) -> dict[str, str]:
    """The box's files and their SHA-256. Raises FormatError where it sends something else."""
    with box.reading(LIST) as stream:
        lines = stream.read().split(b"\0")
    listed = {}
    for line in filter(None, lines):
        if not (found := LISTED.fullmatch(line)):
            raise FormatError(
                f"{box.host} sends {line!r} where a file should be; see that its shell prints nothing at login"
            )
        listed[found[2].decode(errors="surrogateescape")] = found[1].decode()
    return listed


def _wanted(listed: Mapping[str, str], out: Path, tally: PullReport) -> Iterator[str]:
    """Names without ending of the recordings that are not here; all others are put to the tally."""
    for name in sorted({file.rpartition(".")[0] for file in listed}):
        if not name.isprintable() or name.startswith("/") or ".." in name.split("/"):
            tally.refused.append(f"{name!r} (not a name for a file here)")
            continue
        there = {suffix: listed.get(name + suffix) for suffix in PAIR}
        here = {suffix: _sha256(out / (name + suffix)) for suffix in PAIR}
        differ = [suffix for suffix in PAIR if here[suffix] and here[suffix] != there[suffix]]
        if None in there.values():
            tally.halves.append(name)
        elif ".npy" in differ:
            tally.others.append(name)
        elif differ:
            tally.relabelled.append(name)
        elif None in here.values():
            yield name
        else:
            tally.there.append(name)


def _sha256(path: Path) -> str | None:
    """Of a file that is here; None where there is none."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return None


def _pairs(stream: IO[bytes], names: Sequence[str]) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Each recording of which both files came, in the order of `names`, which go two by two.

    Raises FormatError where the archive holds anything but plain files that were asked for: a path out of the folder, a
    link or a device is none, nor what has more bytes than LARGEST. A stream that breaks off ends here.
    """
    asked = set(names)
    held: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=stream, mode="r|") as archive:
            for member in archive:
                name = member.name
                if not member.isreg() or name not in asked or member.size > LARGEST:
                    raise FormatError(f"the box sends {name!r}, which is no file asked for; look at that box")
                file = archive.extractfile(member)
                assert file
                held[name] = file.read()
                whole, _, _ = name.rpartition(".")
                if all(whole + suffix in held for suffix in PAIR):
                    yield whole, {suffix: held.pop(whole + suffix) for suffix in PAIR}
    except (tarfile.TarError, EOFError):
        return


def _take(name: str, pair: Mapping[str, bytes], sha256: Mapping[str, str], out: Path, tally: PullReport) -> None:
    """Keep one recording, if it is what the box listed and can be read as one."""
    try:
        for suffix, data in pair.items():
            if hashlib.sha256(data).hexdigest() != sha256[suffix]:
                raise FormatError(f"{name}{suffix} changed while it was fetched; run the same command again")
        with tempfile.TemporaryDirectory() as aside:
            for suffix, data in pair.items():
                Path(aside, f"sweep{suffix}").write_bytes(data)
            load(Path(aside, "sweep.npy"))
    except FormatError as e:
        tally.refused.append(f"{name} ({e})")
        return
    target = out / name
    target.parent.mkdir(parents=True, exist_ok=True)
    storage.put_all({target.with_name(target.name + suffix): data for suffix, data in pair.items()})
    tally.fetched.append(name)

"""The system calls of a command in their order, recorded by strace; and the command killed at one
of them.

strace sends SIGKILL on entry, and Linux does not carry out a call that a killed process has only
entered. So a kill at call k leaves the disk as it is after call k-1 and before call k. (strace 6.1
delivers no signal while its seccomp filter is in use, so killed runs do without it.)
"""

import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

WATCHED = (
    "open|creat|p?write|lseek|sendfile|copy_file|splice|f?truncate|fallocate|"
    "fsync|fdatasync|sync|rename|unlink|rmdir|mkdir|symlink|link|f?chmod|f?chown|mknod|clone"
)
"""System calls that matter, by the beginnings of their names."""
BEGINS = ("clone", "clone3")
"""Calls that begin a thread or a process."""
MOST_BYTES = 1 << 24
"""Largest number of bytes of a write that strace prints."""
DEADLINE_S = 900
"""Longest time of a command, also on a machine with much other work."""
LINE = re.compile(r"(\d+) +(\w+|\?+)\((.*)\) += (-?\d+|\?)(?:[ <].*)?")
END = re.compile(r"\d+ +\+\+\+ .* \+\+\+")
"""The end of a thread."""
UNSEEN = "?"
"""Beginning of the name of a call whose thread was killed before strace could read the name, as
happens on a busy machine."""
CUT, RESUMED = " <unfinished ...>", re.compile(r"(\d+) +<\.\.\. (?:\w+|\?+) resumed>(.*)")
STRING = re.compile(r'"((?:\\x[0-9a-f]{2})*)"(\.\.\.)?')
DESCRIPTOR = re.compile(r"(AT_FDCWD|\d+)<((?:\\x[0-9a-f]{2})*)>")


class NotFollowed(Exception):
    """The command did something to its files that this module does not follow."""


@dataclass(frozen=True, slots=True)
class SystemCall:
    """One system call.

    process, thread: numbers of its process and thread, 0 for the first. nth: its number among the
    calls of this name in its thread, from 1, as strace counts. paths: its absolute paths. data: the
    bytes that it writes, or the target of a symlink. words: its arguments as strace prints them.
    result: None if the process was killed in it.
    """

    process: int
    thread: int
    name: str
    nth: int
    paths: tuple[str, ...]
    data: bytes
    words: str
    result: int | None

    @property
    def descriptor(self) -> int:
        """The number of its file descriptor, -1 if it has none."""
        number = re.match(r"(\d+)<", self.words)
        return int(number[1]) if number else -1


@dataclass(frozen=True, slots=True)
class TracedRun:
    """The course of a command: its calls, its standard output and standard error, its exit code."""

    calls: tuple[SystemCall, ...]
    output: str
    code: int


def lacking() -> str:
    """The packages to install before calls can be recorded here; empty if none is missing."""
    if not shutil.which("strace"):
        return "strace (apt-get install strace)"
    tried = subprocess.run(["strace", "-o", os.devnull, "true"], capture_output=True, check=False)
    may = "permission to trace a process (CAP_SYS_PTRACE, or ptrace_scope 0 or 1)"
    return may if tried.returncode else ""


def run(
    command: Sequence[str | Path],
    log: Path,
    at: SystemCall | None = None,
    env: dict[str, str] | None = None,
) -> TracedRun:
    """Run a command under strace, in the folder of the log. at: the call at whose entry the command
    is killed.

    env: additions to the environment. Raises NotFollowed, and subprocess.TimeoutExpired.
    """
    how = [f"--inject={at.name}:signal=SIGKILL:when={at.nth}"] if at else ["--seccomp-bpf"]
    strace = ("strace", "-f", "-y", "-xx", "-s", str(MOST_BYTES), "-e", "signal=none")
    done = subprocess.run(
        [*strace, "-e", f"trace=/^({WATCHED})", *how, "-o", log, *command],
        cwd=log.parent,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONHASHSEED": "0"} | (env or {}),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=DEADLINE_S,
        check=False,
    )
    calls = tuple(_calls(log.read_text("ascii").splitlines(), str(log.parent)))
    killed = [(c.thread, c.name, c.nth) for c in calls if c.result is None]
    if at and (at.thread, at.name, at.nth) not in killed:
        raise NotFollowed(
            f"was not killed at its {at.name} number {at.nth}: it ended with {done.returncode}"
        )
    return TracedRun(calls, "".join(map(output, calls)), done.returncode)


def output(call: SystemCall) -> str:
    """The bytes that this call writes to standard output or error, without children."""
    if call.process or call.name not in ("write", "writev") or call.descriptor not in (1, 2):
        return ""
    return call.data[: call.result or 0].decode("utf-8", "replace")


def _calls(lines: list[str], folder: str) -> Iterator[SystemCall]:
    """The calls in the order of their ends, killed ones last. Raises NotFollowed."""
    counts: Counter[tuple[str, str]] = Counter()
    ranks: dict[str, int] = {}
    parsed = [call for call in map(_parsed, _joined(lines)) if not call[1].startswith(UNSEEN)]
    # a thread may run before the call that began it ends
    begun = {
        result: thread
        for thread, name, words, result in parsed
        if name in BEGINS and "CLONE_THREAD" in words
    }
    for thread, name, words, result in parsed:
        counts[thread, name] += 1
        rank = ranks.setdefault(thread, len(ranks))
        process = thread
        while process in begun:
            process = begun[process]
        if name in BEGINS:
            continue
        paths, data = _arguments(name, words, folder)
        first, nth = ranks.setdefault(process, len(ranks)), counts[thread, name]
        ended = None if result == "?" else int(result)
        yield SystemCall(first, rank, name, nth, paths, data, words, ended)


def _parsed(line: str) -> tuple[str, str, str, str]:
    """Thread, name, arguments and result of a call. Raises NotFollowed."""
    found = LINE.fullmatch(line)
    if not found or (found[2].startswith(UNSEEN) and found[4] != "?"):
        raise NotFollowed(f"strace says {line[:200]!r}")
    thread, name, words, result = found.groups()
    return thread, name, words, result


def _joined(lines: list[str]) -> Iterator[str]:
    """Each call as one line; strace splits a call in two if another process comes between."""
    begun: dict[str, str] = {}
    for line in (line for line in lines if not END.fullmatch(line)):
        if line.endswith(CUT):
            begun[line.split()[0]] = line.removesuffix(CUT)
        elif resumed := RESUMED.fullmatch(line):
            yield begun.pop(resumed[1]) + resumed[2]
        else:
            yield line
    yield from (f"{line}) = ?" for line in begun.values())


def _arguments(name: str, words: str, folder: str) -> tuple[tuple[str, ...], bytes]:
    """Paths, relative to the descriptor before or to `folder`, and data of a call."""
    paths: list[str] = []
    data, base = b"", folder
    of_data = name.startswith(("write", "pwrite"))
    found = sorted([*STRING.finditer(words), *DESCRIPTOR.finditer(words)], key=re.Match.start)
    for i, match in enumerate(found):
        if match.re is DESCRIPTOR:
            base = _bytes(match[2]).decode("utf-8", "surrogateescape")
            if of_data or i + 1 == len(found) or found[i + 1].re is DESCRIPTOR:
                paths.append(base)
        elif match[2]:
            raise NotFollowed(f"{name} of more than {MOST_BYTES} bytes")
        elif of_data or (name.startswith("symlink") and not data):
            data += _bytes(match[1])
        else:
            name = _bytes(match[1]).decode("utf-8", "surrogateescape")
            paths.append(os.path.normpath(os.path.join(base, name)))
            base = folder
    return tuple(paths), data


def _bytes(text: str) -> bytes:
    return bytes.fromhex(text.replace("\\x", ""))

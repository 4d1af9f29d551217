"""The saved inputs: a text file for each target, an input on each line in Python's notation for
bytes, the shortest first.

So a change shows the added inputs, and no tool is needed to read them.
"""

from ast import literal_eval
from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path

SAVED = Path(__file__).with_name("corpus")
CRASHES = Path(__file__).with_name("crashes")


def load(target: str) -> list[bytes]:
    """The saved inputs of a target; none if it has no file."""
    file = SAVED / f"{target}.txt"
    return (
        [literal_eval(line) for line in file.read_text("ascii").splitlines()]
        if file.exists()
        else []
    )


def save(target: str, inputs: Iterable[bytes]) -> None:
    """Replace the saved inputs of a target."""
    SAVED.mkdir(exist_ok=True)
    lines = sorted({repr(data) for data in inputs}, key=lambda line: (len(line), line))
    (SAVED / f"{target}.txt").write_text("".join(f"{line}\n" for line in lines), "ascii")


def name(data: bytes) -> str:
    """Name of a file with these bytes until a person gives it one."""
    return sha256(data).hexdigest()[:16]


def keep_crash(target: str, data: bytes) -> Path:
    """Keep an input that broke a promise; returns its file."""
    file = CRASHES / target / f"{name(data)}.bin"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data)
    return file


def crashes(target: str) -> list[Path]:
    """The inputs that once broke a promise of this target."""
    return sorted((CRASHES / target).glob("*.bin"))

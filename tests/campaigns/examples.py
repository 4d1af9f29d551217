"""Writes the examples in the documents again with a run of the packaged bundle.

`python -m tests.campaigns examples` names each line that it changes. A line of a code block is an
example if it begins as one of EXAMPLES says; its run prints the new line. Names of the packaged
bundle are replaced in all pages. `--quick` leaves out runs that take minutes.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate.bundle import bundle
from tests.factories.paths import ROOT

DOCS = ROOT / "docs"
FOLDERS = ("tutorials", "how-to", "reference", "explanation")
COMMAND = re.compile(r"(?m)^    ((?:python|palpate|palpate-train) .*)$")
TUTORIAL = "tutorials/first-model.md"
CUT = "; ..."
"""End of an example of which only the part up to the first semicolon is shown."""
LOADED = bundle.load(bundle.DEFAULT)
VERSION, LABELS = LOADED.manifest.version, len(LOADED.manifest.labels)
NAMES = {
    r"\bdefault \d+, (?!\d+ labels)[0-9a-f]{8}\b": f"default {VERSION}, {LOADED.id}",
    r"\bdefault \d+, \d+ labels": f"default {VERSION}, {LABELS} labels",
    r"\b[0-9a-f]{8}  default \d+": f"{LOADED.id}  default {VERSION}",
    r"(?m)(?<=^    bundle   )[0-9a-f]{8}$": LOADED.id,
}
"""The forms in which pages name the packaged bundle, and the present names."""


class StaleExample(Exception):
    """A page and its run have no common line that begins so."""


@dataclass(frozen=True)
class Example:
    """Lines of a page below docs/. starts: how they begin. run: prints them anew. quick: within
    seconds."""

    page: str
    starts: tuple[str, ...]
    run: Callable[[], str]
    quick: bool = True


def check() -> str:
    """`palpate check` with the packaged bundle and a simulated skin."""
    return _output([sys.executable, "-m", "palpate", "check", "--sim", "skin"], ROOT)


def tutorial() -> str:
    """All commands of "Your first model", but those that run until they are ended."""
    text = (DOCS / TUTORIAL).read_text("utf-8")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "docs").symlink_to(DOCS)
        (Path(folder) / "build").mkdir()
        commands = [line for line in COMMAND.findall(text) if not line.startswith("palpate watch")]
        return "\n".join(_output(shlex.split(line), Path(folder)) for line in commands)


def _output(words: Sequence[str], folder: Path) -> str:
    """What a command prints. Raises SystemExit with its errors if it fails."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{shlex.join(words)} ended with {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout


EXAMPLES = (
    Example("tutorials/first-start.md", ("ok    bundle", "ok    speed"), check),
    Example(
        TUTORIAL,
        ("162 files", "chosen: ", "held-out position, as", "named rightly: ", "answers: ", "  1  "),
        tutorial,
        quick=False,
    ),
)


def updated(text: str, starts: Sequence[str], printed: str) -> str:
    """A page with the printed lines in place of those that begin alike. Raises StaleExample for a
    beginning that the page or the output lacks."""
    lines, output = text.split("\n"), printed.split("\n")
    for start in starts:
        at = [i for i, line in enumerate(lines) if line.startswith(f"    {start}")]
        new = next((line.rstrip() for line in output if line.startswith(start)), None)
        if not at or new is None:
            where = "the page" if not at else "the output of its run"
            raise StaleExample(f"{where} has no line that begins with {start!r}")
        for i in at:
            cut = lines[i].endswith(CUT) and ";" in new
            lines[i] = "    " + (new.partition(";")[0] + CUT if cut else new)
    return "\n".join(lines)


def named(text: str) -> str:
    """A page with the present names of the packaged bundle."""
    for pattern, name in NAMES.items():
        text = re.sub(pattern, name, text)
    return text


def pages(*, quick: bool, docs: Path = DOCS) -> Iterator[tuple[Path, str, str]]:
    """Each page with its text now and with examples of today. Raises StaleExample."""
    for path in sorted(path for folder in FOLDERS for path in (docs / folder).glob("*.md")):
        text = new = path.read_text("utf-8")
        for one in EXAMPLES:
            if path == docs / one.page and (one.quick or not quick):
                try:
                    new = updated(new, one.starts, one.run())
                except StaleExample as e:
                    raise StaleExample(f"{path}: {e}; change EXAMPLES or the page") from e
        yield path, text, named(new)


def differences(path: Path, text: str, new: str) -> list[str]:
    """A line for each line of a page that changes."""
    pairs = zip(text.split("\n"), new.split("\n"), strict=True)
    return [f"{path}: {one.strip()} -> {other.strip()}" for one, other in pairs if one != other]


def main() -> None:
    """Write the pages, and print what has changed."""
    parser = argparse.ArgumentParser("python -m tests.campaigns examples", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only runs of seconds")
    args = parser.parse_args()
    changed = []
    for path, text, new in pages(quick=args.quick):
        changed += differences(path, text, new)
        if new != text:
            path.write_text(new, "utf-8")
    print(*(changed or ["all examples are of today's bundle"]), sep="\n")


if __name__ == "__main__":
    try:
        main()
    except StaleExample as e:
        raise SystemExit(f"examples: {e}") from e

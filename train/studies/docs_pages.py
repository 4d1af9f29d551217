"""The project's pages: what makes each, and whether it is of today. In: docs/. Out: their states,
and the pages again.

A page is made by one command, which is run as a process of its own: `python -m` and its words. What
has finished stays: folds in evaluate's cache, and a page that is of today's default is not made
twice.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from appliance.core.errors import FormatError
from train.reports import provenance

DOCS = Path("docs")
Run = Callable[[Sequence[str]], int]
"""Runs a command's words; its exit code."""
NEEDS: dict[str, Callable[[], bool]] = {
    "the folder of real sweeps in PALPATE_DATA": lambda: bool(os.environ.get("PALPATE_DATA")),
    "qemu-system-aarch64 (python -m tests.campaigns rig-tools)": lambda: (
        shutil.which("qemu-system-aarch64") is not None
    ),
}
REAL, EMULATOR = NEEDS
COMMANDS = {"appliance": "palpate"}
"""Modules that are installed as commands."""


@dataclass(frozen=True, slots=True)
class DocsPage:
    """One page. file, results: below docs/. words: what `python -m` runs. needs: keys of NEEDS.

    folds: whether the command takes the options that say where folds run and are kept. drawn:
    whether it takes --draw, which draws the page of the results that are there.
    """

    name: str
    file: str
    results: str
    words: tuple[str, ...]
    needs: tuple[str, ...] = ()
    folds: bool = False
    drawn: bool = False

    @property
    def command(self) -> str:
        """As a person types it."""
        first, *rest = self.words
        return " ".join([COMMANDS.get(first, f"python -m {first}"), *rest])

    def lacks(self) -> list[str]:
        """What it needs and is not here."""
        return [need for need in self.needs if not NEEDS[need]()]

    def stale(self) -> str:
        """Why it has to be made again; "" where it is of today's default, and shows the results
        that lie beside it."""
        try:
            shown, found = (provenance.read(DOCS / name) for name in (self.file, self.results))
        except FormatError as e:
            return str(e).partition(";")[0]
        if shown != found:
            return f"shows other figures than {self.results}"
        return found.older


PAGES = (
    DocsPage(
        "development",
        "development/index.html",
        "development/results.json",
        ("train.studies", "development"),
        (REAL,),
        True,
        True,
    ),
    DocsPage(
        "alignment",
        "alignment/README.md",
        "alignment/place.json",
        ("train.studies", "alignment", "--out", "docs/alignment"),
        drawn=True,
    ),
    DocsPage(
        "certainty",
        "certainty/index.html",
        "certainty/results.json",
        (
            "train.studies",
            "certainty",
            "--method",
            "default-reattached",
            "--set",
            "sim:T-REAL:1-3",
            "--test",
            "sim:T-REAL:4-6:20",
        ),
        folds=True,
    ),
    DocsPage(
        "chart",
        "chart/index.html",
        "chart/chart.json",
        ("train.studies", "chart"),
        (REAL,),
        True,
        True,
    ),
    DocsPage(
        "fabrics",
        "fabricslide/README.md",
        "fabricslide/results.json",
        ("train.studies", "fabrics"),
        (REAL,),
        True,
        True,
    ),
    DocsPage(
        "stress",
        "stress/index.html",
        "stress/results.json",
        ("train.studies", "stress"),
        folds=True,
        drawn=True,
    ),
    DocsPage(
        "paper",
        "paper/index.html",
        "paper/results.json",
        ("train.studies", "paper"),
        folds=True,
        drawn=True,
    ),
    DocsPage("overview", "overview.svg", "overview.svg", ("train.studies", "overview")),
    DocsPage(
        "bench", "bench.json", "bench.json", ("appliance", "bench", "--json", "docs/bench.json")
    ),
    DocsPage("skins", "skins.md", "skins.json", ("tests.skins",)),
    DocsPage(
        "soak",
        "soak/index.html",
        "soak/results.json",
        ("tests.rig.soak", "--out", "docs/soak"),
        (EMULATOR,),
    ),
)
"""Those that tell most come first. The last three measure this machine, too: let it do nothing else
meanwhile."""


def names() -> list[str]:
    """Of all pages."""
    return [page.name for page in PAGES]


def named(wanted: Sequence[str]) -> list[DocsPage]:
    """The pages `wanted` in the order of PAGES, or all. Raises FormatError for an unknown one."""
    if unknown := [name for name in wanted if name not in names()]:
        raise FormatError(f"no page {', '.join(unknown)}; there are {', '.join(names())}")
    return [page for page in PAGES if not wanted or page.name in wanted]


def require_project() -> None:
    """Raises FormatError where the working folder is not the project's."""
    if not (DOCS.is_dir() and Path("README.md").is_file()):
        raise FormatError(
            f"{Path.cwd()} has no docs/ and README.md; run this in the project's folder"
        )


def table(pages: Sequence[DocsPage]) -> str:
    """A line for each page: its name, its command, and why it would be made again or left out."""
    width = max(len(page.name) for page in pages)
    lines = [
        f"{page.name:<{width}}  {_state(page)}\n{'':<{width}}  {page.command}" for page in pages
    ]
    return "\n".join(lines)


def _state(page: DocsPage) -> str:
    why = page.stale()
    lacks = page.lacks() if why else []
    left_out = f"; left out: it needs {' and '.join(lacks)}" if lacks else ""
    return f"stale: {why.rstrip('.')}{left_out}" if why else "of today"


def draw(wanted: Sequence[str], log: Callable[[str], None], run: Run | None = None) -> None:
    """Draw the pages that are named, or all that are stale, of the results that are there, in
    seconds.

    Those whose command cannot do that are left out by name. Raises FormatError at the end where a
    page failed.
    """
    failed = []
    for page in [page for page in named(wanted) if wanted or page.stale()]:
        if not page.drawn:
            log(f"{page.name} is left out: its command has no --draw")
        elif (run or _run)([*page.words, "--draw"]):
            failed.append(page.name)
    if failed:
        raise FormatError(f"{', '.join(failed)} could not be drawn; see above")


def make(
    wanted: Sequence[str], where: Sequence[str], log: Callable[[str], None], run: Run | None = None
) -> None:
    """Make the pages that are named, or all that are stale. where: options for commands that
    compute folds.

    What is lacking is left out by name; after a failure the others are still made. Raises
    FormatError at the end where a page failed or one that was named is lacking something.
    """
    pages = [page for page in named(wanted) if wanted or page.stale()]
    left: dict[str, str] = {}
    for number, page in enumerate(pages, 1):
        if lacks := page.lacks():
            log(f"{page.name} is left out: it needs {' and '.join(lacks)}")
            left |= {page.name: "is left out"} if wanted else {}
            continue
        log(f"{number}/{len(pages)} {page.name}: {page.stale() or 'named'}")
        code = (run or _run)([*page.words, *(where if page.folds else ())])
        if code:
            left[page.name] = f"ended with exit code {code}"
    if left:
        said = "; ".join(f"{name} {why}" for name, why in left.items())
        raise FormatError(f"{said}; see above, and run the command again: what is done stays")


def _run(words: Sequence[str]) -> int:
    return subprocess.run([sys.executable, "-m", *words], check=False).returncode

"""The project's results: the command that makes each file anew, and whether it is up to date.

Each command runs as a process of its own. Finished folds stay in evaluate's cache, and a file with
results of today's default is not made twice.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate.core.errors import FormatError
from palpate_studies.fabrics_experiment import FABRICS, SEVEN
from palpate_train.reports import provenance

DOCS = Path("docs")
Run = Callable[[Sequence[str]], int]
"""Runs the words of a command; returns its exit code."""
NEEDS: dict[str, Callable[[], bool]] = {
    "the folder of real sweeps in PALPATE_DATA": lambda: bool(os.environ.get("PALPATE_DATA")),
    "qemu-system-aarch64 (python -m tests.campaigns rig-tools)": lambda: (
        shutil.which("qemu-system-aarch64") is not None
    ),
}
REAL, EMULATOR = NEEDS
COMMANDS = {"palpate": "palpate", "palpate_train": "palpate-train"}
"""Modules that are installed as commands."""


@dataclass(frozen=True, slots=True)
class ResultFile:
    """One file of results, or a picture with its own header. file: below docs/. words: a module and
    its arguments; $PALPATE_DATA in them is the folder of real sweeps. needs: keys of NEEDS.
    folds: whether the command has the options that say where folds run and are cached."""

    name: str
    file: str
    words: tuple[str, ...]
    needs: tuple[str, ...] = ()
    folds: bool = False

    @property
    def command(self) -> str:
        """The command line, for a shell."""
        first, *rest = (shlex.quote(w) if w.strip("$") == w else w for w in self.words)
        return " ".join([COMMANDS.get(first, f"python -m {first}"), *rest])

    def lacks(self) -> str:
        """The needs that are not met here; "" if all are."""
        return " and ".join(need for need in self.needs if not NEEDS[need]())

    def stale(self) -> str:
        """Why it has to be made again; "" if it is of today's default."""
        try:
            return provenance.read(DOCS / self.file).older
        except FormatError as e:
            return str(e).partition(";")[0]


def _study(name: str, *words: str, needs: tuple[str, ...] = (), folds: bool = True) -> ResultFile:
    return ResultFile(name, f"data/{name}.json", ("palpate_studies", name, *words), needs, folds)


FABRICS_STRESSED = (
    *("--set", f"$PALPATE_DATA/{FABRICS}", "--only", *SEVEN, "--split", "rep:0.67"),
    *("--method", "palpate,palpate-reattached,minirocket,multirocket-hydra,ds-cnn,H-svm"),
    *("--out", "docs/data/stress-fabrics.json"),
)
REPORTS = (
    _study("development", needs=(REAL,)),
    _study("alignment", folds=False),
    _study("certainty"),
    _study("fabrics", needs=(REAL,)),
    _study("shots", needs=(REAL,)),
    _study("recipe", needs=(REAL,), folds=False),
    ResultFile(
        "stress-fabrics",
        "data/stress-fabrics.json",
        ("palpate_studies", "stress", *FABRICS_STRESSED),
        (REAL,),
        folds=True,
    ),
    _study("stress"),
    _study("rules", folds=False),
    _study("paper"),
    ResultFile("overview", "overview.svg", ("palpate_studies", "overview")),
    ResultFile("junk", "data/junk.json", ("tests.campaigns", "junk")),
    ResultFile("bench", "data/bench.json", ("tests.campaigns", "bench")),
    ResultFile("skins", "data/skins.json", ("tests.campaigns.skins",)),
    ResultFile(
        "soak", "data/soak.json", ("tests.rig.soak", "--out", "docs/data/soak.json"), (EMULATOR,)
    ),
)
"""All results, the most important first. The last three measure this machine: run nothing else
meanwhile."""


def names() -> list[str]:
    """Names of all reports."""
    return [report.name for report in REPORTS]


def named(wanted: Sequence[str]) -> list[ResultFile]:
    """The reports `wanted` in the order of REPORTS, or all. Raises FormatError for an unknown
    one."""
    if unknown := [name for name in wanted if name not in names()]:
        raise FormatError(f"no report {', '.join(unknown)}; there are {', '.join(names())}")
    return [report for report in REPORTS if not wanted or report.name in wanted]


def require_project() -> None:
    """Raises FormatError if the working folder is not the project's."""
    if not (DOCS.is_dir() and Path("README.md").is_file()):
        raise FormatError(
            f"{Path.cwd()} has no docs/ and README.md; run this in the project's folder"
        )


def table(reports: Sequence[ResultFile]) -> str:
    """A line for each report: name, command, and the reason to make it again or to leave it out."""
    width = max(len(report.name) for report in reports)
    lines = [
        f"{report.name:<{width}}  {_state(report)}\n{'':<{width}}  {report.command}"
        for report in reports
    ]
    return "\n".join(lines)


def _state(report: ResultFile) -> str:
    why, lacks = report.stale(), report.lacks()
    left_out = f"; left out: it needs {lacks}" if lacks else ""
    return f"stale: {why.rstrip('.')}{left_out}" if why else "of today"


def make(
    wanted: Sequence[str], where: Sequence[str], log: Callable[[str], None], run: Run | None = None
) -> None:
    """Make the reports that are named, or all that are stale. where: options for commands that
    compute folds.

    A report whose needs are not met is left out by name. After a failure the others are still made.
    At the end, raises FormatError if a report failed, or if a named report was left out.
    """
    reports = [report for report in named(wanted) if wanted or report.stale()]
    left: dict[str, str] = {}
    for number, report in enumerate(reports, 1):
        if lacks := report.lacks():
            log(f"{report.name} is left out: it needs {lacks}")
            left |= {report.name: "is left out"} if wanted else {}
            continue
        log(f"{number}/{len(reports)} {report.name}: {report.stale() or 'named'}")
        words = map(os.path.expandvars, report.words)
        code = (run or _run)([*words, *(where if report.folds else ())])
        if code:
            left[report.name] = f"ended with exit code {code}"
    if left:
        said = "; ".join(f"{name} {why}" for name, why in left.items())
        raise FormatError(f"{said}; see above, and run the command again: what is done stays")


def _run(words: Sequence[str]) -> int:
    return subprocess.run([sys.executable, "-m", *words], check=False).returncode

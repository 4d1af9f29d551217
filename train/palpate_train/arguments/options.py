"""Options that several commands share, and readers of their values."""

from __future__ import annotations

import argparse
import atexit
import shlex
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from palpate.core import outputs
from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.text import printable, say
from palpate_train.arguments import numbers
from palpate_train.data import labels, readers, sets
from palpate_train.data.progress import ProgressLine, StageLine, spoken
from palpate_train.data.summary import warnings_of
from palpate_train.evaluate import evaluate, set_warnings
from palpate_train.models import methods

SET = f"FILE (.npz, .h5), a folder of recordings or {sets.SIMULATED_FORM}; several are joined"
SET_FILES = (".npz", *readers.HDF5)
"""Endings of a sweep set."""
LOG_EVERY_S = 30


def jobs(text: str) -> int:
    """Read --jobs: processes from 1 on, or -1 for one on each core. Raises FormatError."""
    return -1 if text == "-1" else numbers.whole("--jobs", 1)(text)


def text(metavar: str, default: Any = None, **more: Any) -> dict[str, Any]:
    """An option that is a text."""
    return {"metavar": metavar, "default": default, **more}


def path(metavar: str = "FILE", **more: Any) -> dict[str, Any]:
    """An option that is a path."""
    return {"type": Path, "metavar": metavar, **more}


def above_zero(flag: str, metavar: str, help: str, **more: Any) -> Row:
    """An option that is a number above 0."""
    return flag, help, text(metavar, type=numbers.above_zero(flag), **more)


# fmt: off
FLAG = {"action": "store_true"}
JSON: Row = "--json", "write the figures there", path()
SEED: Row = ("--seed", "seed of the training, and of simulated sets without one",
    {"type": numbers.whole("--seed", 0), "required": True})
ONLY: Row = ("--only", "keep these sweeps: force=100,150, force<=180, material=Canvas,Linen",
    text("NAME=VALUE", [], action="extend", nargs="+"))
RENAME: Row = ("--rename", "rename a material, before --only; two with the same new name become"
    " one", text("OLD=NEW", action="append", default=[]))
EFFORT = above_zero("--effort", "SHARE", "share of the networks' usual iterations"
    " (1)", default=methods.FULL_EFFORT.share)
WHERE: tuple[Row, ...] = (
    ("--jobs", "processes (one for each core)", {"type": jobs, "default": -1, "metavar": "N"}),
    ("--scheduler", "of a Dask cluster that runs the tasks", text("ADDRESS", "")),
    ("--cache", "where finished folds are kept, so that an interrupted run continues"
        f" ({evaluate.CACHE})", path("DIR", default=evaluate.CACHE)),
)
"""Options for where tasks run and where their results are kept."""
# fmt: on


def add_set(command: argparse.ArgumentParser, usual: str = "", required: bool = True) -> None:
    """Add --set, --only and --rename. usual: the default set; without it --set is required, unless
    the command checks that itself (`required` is False)."""
    told = f"{SET} ({usual})" if usual else SET
    many = {"action": "append", "required": required and not usual, "dest": "sets"}
    command.set_defaults(usual_set=usual)
    add_rows(command, ("--set", told, text("SET", **many)), ONLY, RENAME)


def folder(about: str) -> Row:
    """The option --out, a folder."""
    return "--out", about, {"type": outputs.folder, "required": True, "metavar": "DIR"}


def writable(path: Path, option: str = "--out") -> None:
    """Make the folders above `path`, before hours of work. Raises FormatError if nothing can be
    written there."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as e:
        raise FormatError(
            f"{option} {path}: cannot be written there: {e.strerror}; name another place"
        ) from e


def writable_file(path: Path, option: str = "--out", *endings: str) -> None:
    """As `writable`; also raises FormatError if `path` is a folder, or has an ending other than
    `endings`, if there are any: the file would be of another kind than its name says."""
    if path.is_dir():
        raise FormatError(f"{option} {path} is a folder; name a file")
    if endings and path.suffix.lower() not in ("", *endings):
        raise FormatError(
            f"{option} {path} would not be a {path.suffix} file; use a name that ends in "
            f"{' or '.join(endings)}"
        )
    writable(path, option)


def load(args: argparse.Namespace, seed: int = 1, learned: bool = True) -> sets.Dataset:
    """The sets of --set, renamed by --rename, joined and narrowed by --only. seed: of simulated
    sets without one. learned: whether a model learns from it.

    Warns of materials without sweeps, which are left out, of taxels that never change, and of the
    traps of set_warnings.of_set.
    """
    pairs = labels.parse_renames(args.rename)
    loaded = [sets.load(spec, seed) for spec in args.sets or [args.usual_set]]
    labels.check_renames(pairs, (name for sweeps in loaded for name in sweeps.materials))
    whole = sets.join([labels.renamed(sweeps, pairs) for sweeps in loaded])
    part = whole.select(args.only)
    for line in [*warnings_of(part if args.only else whole), *set_warnings.of_set(part, learned)]:
        say(f"palpate-train: {line}", file=sys.stderr)
    return part


def report_line(what: Path, sweeps: str = "") -> str:
    """The command for a page about a fit or a bundle. sweeps: the set to judge it on, if known."""
    words = ["palpate-train", "report", str(what), "--set", sweeps or "SET", "--out", "report.html"]
    return f"for a page about it and its limits: {shlex.join(words)}"


def names(args: argparse.Namespace) -> tuple[str, ...]:
    """The methods of --method, to be read before work. Raises FormatError for an unknown one."""
    if args.method == "all":
        return tuple(methods.every())
    return tuple(method.name for method in methods.find(args.method.split(",")))


def seeds(args: argparse.Namespace) -> range:
    """The seeds from 1 to --seeds. Raises FormatError if that is below 1."""
    if args.seeds < 1:
        raise FormatError(f"--seeds {args.seeds} is none; use 1 or more")
    return range(1, args.seeds + 1)


def effort(args: argparse.Namespace) -> methods.Effort:
    """The length of trainings."""
    return methods.Effort(args.effort)


def where(args: argparse.Namespace) -> evaluate.Where:
    """Where tasks run and where their results are kept."""
    return evaluate.Where(args.jobs, args.scheduler, args.cache, getattr(args, "kept", False))


class Log:
    """Shows progress on the error stream: on a terminal a bar and the latest line, otherwise a line
    every LOG_EVERY_S. A stage that has ended stays as a line with its time."""

    def __init__(self) -> None:
        self._last = self._begun = time.monotonic()
        self._bar: Any = None
        self._stage: StageLine | None = None

    def __call__(self, line: str) -> None:
        """Show `line`; for a ProgressLine or a StageLine also the share that is done."""
        if isinstance(line, StageLine):
            if self._stage and self._stage.stage != line.stage:
                self._check()
            self._stage = line
        if sys.stderr.isatty():
            self._shown().update(0, description=printable(line), **_share(line))
        elif time.monotonic() - self._last > LOG_EVERY_S:
            self._last = time.monotonic()
            say(line, file=sys.stderr)

    def keep(self, line: str) -> None:
        """Show `line` at once and permanently."""
        say(line, file=sys.stderr)

    def end(self) -> None:
        """The work has ended: the last stage gets its line, and the bar disappears."""
        if self._stage:
            self._check()
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _check(self) -> None:
        assert self._stage
        now = time.monotonic()
        sign = "✓" if (sys.stderr.encoding or "").lower().startswith("utf") else "done:"
        self.keep(f"{sign} {self._stage.name:<32} {spoken(now - self._begun):>7}")
        self._stage, self._begun = None, now

    def _shown(self) -> Any:
        """The bar, which disappears when the process ends; other output appears above it."""
        if self._bar is None:
            from rich import progress  # here: a tenth of a second that only a terminal needs
            from rich.console import Console
            from rich.table import Column

            text = progress.TextColumn(
                "{task.description}", markup=False, table_column=Column(no_wrap=True, ratio=1)
            )
            self._bar = progress.Progress(
                progress.SpinnerColumn(),
                progress.BarColumn(16),
                progress.TimeElapsedColumn(),
                text,
                console=Console(stderr=True),
                transient=True,
                redirect_stdout=sys.stdout.isatty(),
                expand=True,
            )
            self._bar.add_task("")
            self._bar.start()
            atexit.register(self._bar.stop)
        return self._bar


def _share(line: str) -> dict[str, float | None]:
    """The share of the work that is done, for a bar; a total of None if it is unknown."""
    if isinstance(line, ProgressLine):
        return {"completed": line.done, "total": line.total}
    if isinstance(line, StageLine):
        return {"completed": line.stage - 1 + line.within, "total": line.stages}
    return {"completed": 0, "total": None}


def group_share(text: str) -> tuple[str, float]:
    """GROUP:SHARE of --split. Raises FormatError if it cannot be read."""
    by, _, share = text.partition(":")
    try:
        return by, float(share)
    except ValueError:
        raise FormatError(
            f"split {text!r} cannot be read; write GROUP:SHARE, e.g. recording:0.7"
        ) from None

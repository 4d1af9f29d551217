"""A study: cases, methods, a run over them, and one file of results below docs/data.

Commands measure and write results. Pages are templates on these results (`pages`), so no module
both measures and draws.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core import outputs
from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate_studies import published
from palpate_train.arguments import options
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where
from palpate_train.models.methods import FULL_EFFORT, Effort
from palpate_train.reports import html, provenance

TEMPLATES = Path(__file__).with_name("templates")
DATA = Path("docs/data")
"""Folder of all results, from the project's folder."""
Rendered = tuple[str, Mapping[str, str]]
"""A page (HTML), and its pictures (SVG) by name."""
NO_DATA = "real sweeps; name their folder with --data or PALPATE_DATA"


@dataclass(frozen=True, slots=True)
class StudyCase:
    """Sweeps and the protocol under which methods are tested on them.

    sets: they are joined. only: selects sweeps of each set. real: the sets are files in the folder
    of real sweeps. means_removed: each taxel's mean over the window is subtracted.
    """

    sets: tuple[str, ...]
    protocol: str = ""
    only: tuple[str, ...] = ()
    real: bool = False
    means_removed: bool = False

    @property
    def simulated(self) -> bool:
        """Whether the simulator draws its sweeps."""
        return any(name.startswith("sim:") for name in self.sets)

    def load(self, data: Path | None = None, **names: int) -> Dataset | None:
        """Its sweeps; None if they are real and no folder is given. names: replace {NAME} in the
        names of sets."""
        if self.real and data is None:
            return None
        paths = [name.format(**names) for name in self.sets]
        paths = [str(data / path) if self.real and data else path for path in paths]
        loaders = [published if path.startswith(published.PREFIX) else sets for path in paths]
        loaded = [loader.load(path) for loader, path in zip(loaders, paths, strict=True)]
        return sets.join([one.select(self.only) for one in loaded])


@dataclass(slots=True)
class StudyRun:
    """One run of a study: where folds are computed and cached, on which sweeps, with which effort.

    data: folder of real sweeps. left_out: missing names, each with the reason; the run fills it.
    """

    where: Where
    log: Callable[[str], None]
    data: Path | None = None
    effort: Effort = FULL_EFFORT
    seeds: Sequence[int] = (1,)
    left_out: dict[str, str] = field(default_factory=dict)


def results_file(name: str, folder: Path = DATA) -> Path:
    """Where the results of a study lie."""
    return folder / f"{name}.json"


def add_out(command: argparse.ArgumentParser, name: str, *, kept: bool = True) -> None:
    """The option --out of the study `name`, and --kept."""
    file = results_file(name)
    how = {"type": outputs.file(".json"), "default": file, "metavar": "FILE"}
    rows: list[outputs.Row] = [("--out", f"file of results ({file})", how)]
    about = "train nothing, report what an earlier run has finished"
    rows += [("--kept", about, options.FLAG)] * kept
    outputs.add_rows(command, *rows)


def drawn(template: str, results: Any, pictures: Mapping[str, str], **data: Any) -> Rendered:
    """The page that a template makes of `results`, with these pictures."""
    shown = {name: html.picture(svg) for name, svg in pictures.items()}
    about = provenance.of(results)
    page = html.render(template, TEMPLATES, header=about, home=html.HOME, pictures=shown, **data)
    return page, pictures


def read(path: Path, *keys: str) -> Any:
    """The results in a file. Raises FormatError if it cannot be read, or if `keys` are missing."""
    try:
        results = json.loads(path.read_bytes())
    except (OSError, ValueError) as e:
        why = e.strerror if isinstance(e, OSError) else f"not JSON: {e}"
        raise FormatError(f"{path}: {why}; run the study that writes this file") from e
    there = results if isinstance(results, dict) else ()
    if missing := [key for key in keys if key not in there]:
        raise FormatError(
            f"{path} has no {', '.join(missing)}; name the results of the right study"
        )
    return results


def save(path: Path, results: Any) -> Path:
    """Write results as JSON, one line for each item of a list, so that differences can be read; the
    path."""
    put(path, text(results).encode(), parents=True)
    return path


def text(results: Any) -> str:
    """Results as JSON. Raises ValueError for a number that is not finite."""
    if isinstance(results, list):
        return _lines(results) + "\n"
    fields = (
        f"{json.dumps(key)}: {_lines(value) if _is_table(value) else _json(value)}"
        for key, value in results.items()
    )
    return "{\n" + ",\n".join(fields) + "\n}\n"


def _is_table(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _lines(items: Sequence[Any]) -> str:
    return "[\n" + ",\n".join(map(_json, items)) + "\n]"


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False)

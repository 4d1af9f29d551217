"""Pages of studies, drawn from results of a test or from those in docs/data."""

import json
from pathlib import Path
from typing import Any

from palpate_studies import pages
from palpate_studies.study import DATA, results_file, save
from tests.factories.paths import ROOT

RESULTS = ROOT / DATA


def committed(name: str) -> Any:
    """The results of a study in docs/data."""
    return json.loads(results_file(name, RESULTS).read_bytes())


def published(name: str, results: Any, folder: Path) -> Path:
    """Draw the page of a study from `results` in the folder; returns its path."""
    save(results_file(name, folder / "data"), results)
    (page,) = pages.write([name], folder / "pages", folder / "data")
    return page

"""Methods on real fabrics, with and without means, a condition left out at a time. In: methods,
FabricSlide. Out: its page.

What the page says is written by hand around a table and two pictures; figures of methods that are
not run stay as they are.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.data import sets
from train.evaluation import evaluate
from train.evaluation.evaluate import Plan, Where
from train.models.methods import Effort
from train.studies import matrix_table
from train.studies.chart_report import FABRICS, SEVEN
from train.studies.development_experiment import FOUR

Json = dict[str, Any]
PARTS = (
    (SEVEN, ("leave:force", "leave:speed", "leave:rep")),
    (FOUR, ("leave:force", "leave:speed", "leave:direction")),
)
"""Two parts of the set with all combinations of their conditions: what is selected, and what is
left out of it in turn."""
SEED = 1


def run(
    out: Path,
    data: Path | None,
    names: Sequence[str],
    where: Where,
    log: Callable[[str], None],
    effort: Effort,
) -> dict[str, str]:
    """Put results.json into the folder `out`: of `names` anew, of all other methods as it lay
    there.

    Returned: methods that cannot take these sweeps, and why. Raises FormatError where the real
    sweeps or the page are missing.
    """
    if data is None:
        raise FormatError("fabrics are real sweeps; name their folder with --data or PALPATE_DATA")
    _page(out)
    found: list[Json] = []
    left_out: dict[str, str] = {}
    whole = sets.load(str(data / FABRICS))
    for only, protocols in PARTS:
        sweeps = whole.select(only)
        for removed in (True, False):
            plan = Plan(names, protocols, (SEED,), removed, effort)
            for result in evaluate.evaluate(sweeps, plan, where, log):
                if result.refused:
                    left_out[result.method] = result.refused
                else:
                    found.append(result.json() | {"only": list(only)})
    done = {_entry(result) for result in found}
    earlier = read(out) if (out / "results.json").exists() else []
    results = [*found, *(result for result in earlier if _entry(result) not in done)]
    text = ",\n".join(json.dumps(result, allow_nan=False) for result in sorted(results, key=_place))
    put(out / "results.json", f"[\n{text}\n]\n".encode(), parents=True)
    return left_out


def read(out: Path) -> list[Json]:
    """What `run` put into the folder `out`. Raises FormatError where it is not there."""
    try:
        results: list[Json] = json.loads((out / "results.json").read_bytes())
        list(map(_entry, results))
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise FormatError(
            f"{out}/results.json is not of the command fabrics: {e!r}; run it without --draw"
        ) from e
    return results


def draw(out: Path) -> Path:
    """The pictures and the page's table, of what lies in the folder `out`; the page's path.

    Raises FormatError where results or the page's markers are missing.
    """
    results, page = read(out), out / "README.md"
    if not page.exists():
        raise FormatError(
            f"{page} is not there; take the project's, or make one with <!-- matrix --> and <!-- /matrix -->"
        )
    matrix_table.draw(results, out / "windows.svg")
    matrix_table.draw(results, out / "recordings.svg", recordings=True)
    matrix_table.insert(results, page)
    return page


def _page(out: Path) -> Path:
    page = out / "README.md"
    if not page.exists():
        raise FormatError(
            f"{page} is not there; take the project's, or make one with <!-- matrix --> and <!-- /matrix -->"
        )
    return page


def _entry(result: Json) -> tuple[str, str, bool, tuple[str, ...]]:
    """Of which method and test a result is."""
    return result["method"], result["protocol"], result["means_removed"], tuple(result["only"])


def _place(result: Json) -> tuple[bool, int, int]:
    """Tests in the order of the page; methods stay as they came."""
    part = [list(only) for only, _ in PARTS].index(result["only"])
    return not result["means_removed"], part, PARTS[part][1].index(result["protocol"])

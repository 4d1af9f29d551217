"""Tables of results in README and written pages, each between <!-- NAME --> and <!-- /NAME -->.

`python -m palpate_studies tables` writes all of them and the picture of README.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core.storage import put
from palpate_studies import (
    bench_table,
    contact_table,
    development_report,
    markdown,
    matrix_table,
    quantities,
    recipe_page,
    rules_table,
)
from palpate_studies.study import DATA, read, results_file
from palpate_train.reports import provenance

README = "README.md"
ALIGNMENT, FABRICS = "docs/alignment/README.md", "docs/fabricslide/README.md"
SPECIFICATIONS, RECIPE = "docs/reference/specifications.md", "docs/recipe.md"
FRONT = "docs/front.svg"
HEAD = ("sweeps", "classified correctly", "wrong label", "no label")
STRESSED = (
    ("noise", 0.0, "{:,} slides over trained materials"),
    ("dead", 1.0, "the same with one dead taxel, which is bridged"),
    ("hum", 0.5, "the same with 50 Hz hum of half of the deviation, which is removed"),
    ("lost", 0.1, "the same with a tenth of the frames lost"),
    ("speed-up", 0.35, "the same, slid 35 % faster than in training"),
    ("bits", 3.0, "the same with counts of five bits instead of eight"),
)
"""Corruption, severity and text of each row; {} is the number of sweeps."""
JUNK = {
    "slides that were altered": "{:,} slides that were altered: gain, speed, lifted, displaced",
    "no material, or no slide": "{:,} windows without a slide, or of two materials",
    "materials that nobody taught": "{:,} slides over three materials that nobody taught",
}
"""Texts of the groups of kinds in the campaign `junk`."""
STRANGERS = {
    "material near foam": "foam with every property up to a fifth off",
    "felt": "felt: soft as foam, with a finer and shallower pattern",
    "random material": "each property from one of two known materials, up to a third off",
    "random material, 50 Hz hum": "the same, with 50 Hz hum of half of the deviation",
    "random material, noise": "the same, with as much noise",
    "random material, 35 % faster": "the same, 35 % faster than in training",
    "random material, other skin": "the same on a less sensitive, noisier, more damped skin",
    "softness alone": "softness alone half larger or a third smaller",
    "roughness alone": "roughness alone, likewise",
    "vibration alone": "vibration alone, likewise",
    "halfway between two": "each property halfway between two known materials",
    "mean of two slides": "mean of two slides over different materials",
    "two halves": "half a slide over one material, half over another",
}
"""Texts of the kinds of that campaign that show where unknown materials get a label."""


def stressed(results: Any) -> str:
    """The packaged bundle's answers to corrupted sweeps, from the study `stress`."""
    curves, rows = results["box"]["curves"], []
    for name, severity, text in STRESSED:
        right, wrong = (curves[answer][name] for answer in ("correct", "wrong"))
        at = right["severities"].index(severity)
        rows.append((text, right["total"], right["right"][at], wrong["right"][at]))
    return _answers(rows)


def junk(results: Any) -> str:
    """Its answers to sweeps without a right label, from the campaign `junk`."""
    rows = []
    for group, text in JUNK.items():
        kinds = [kind for kind in results["kinds"].values() if kind["group"] == group]
        total, labelled, wrong = (
            sum(kind[key] for kind in kinds) for key in ("sweeps", "whole", "whole wrong")
        )
        rows.append((text, total, labelled - wrong, wrong))
    return _answers(rows)


def strangers(results: Any) -> str:
    """Where it takes an unknown material for a known one, from the same campaign."""
    kinds = [(text, results["kinds"][kind]) for kind, text in STRANGERS.items()]
    rows = [[text, *(of[key] for key in ("sweeps", "whole", "early"))] for text, of in kinds]
    return f"\n{markdown.table(('stranger', 'sweeps', 'label', 'with early answers'), rows)}\n"


def _answers(rows: Iterable[tuple[str, int, int, int]]) -> str:
    cells = (
        [text.format(total), *(f"{n:,}" for n in (right, wrong, total - right - wrong))]
        for text, total, right, wrong in rows
    )
    return f"\n{markdown.table(HEAD, cells)}\n"


TABLES: Sequence[tuple[str, str, str, Callable[[Any], str]]] = (
    (README, "stress", "stress", stressed),
    (README, "junk", "junk", junk),
    ("docs/explanation/limits.md", "strangers", "junk", strangers),
    (README, "front", "development", development_report.caption),
    (SPECIFICATIONS, "bench", "bench", bench_table.table),
    (ALIGNMENT, "alignment", "alignment", contact_table.table),
    (RECIPE, "recipe", "recipe", recipe_page.table),
    ("docs/how-to/train.md", "rules", "rules", partial(rules_table.table, pairs=False)),
    (FABRICS, "matrix", "fabrics", matrix_table.headline),
    (FABRICS, "shots", "shots", matrix_table.shots),
    *(("docs/explanation/figures.md", *one) for one in quantities.TABLES),
)
"""Document, marker, name of the results in docs/data, and the function that makes the text."""
HEADED = {ALIGNMENT: "alignment", FABRICS: "fabrics", RECIPE: "recipe"}
"""Pages of one file of results have its origin below their title."""


def write(root: Path = Path()) -> list[str]:
    """Write all tables, and the picture of README, below `root`; the files that changed.

    Raises FormatError if results or markers are missing.
    """
    texts: dict[str, str] = {}
    for document, marker, study, table in TABLES:
        text = texts.get(document) or (root / document).read_text(encoding="utf-8")
        made = table(read(results_file(study, root / DATA)))
        texts[document] = markdown.insert(text, marker, made, document)
    for document, study in HEADED.items():
        about = provenance.of(read(results_file(study, root / DATA)))
        texts[document] = provenance.in_markdown(texts[document], about)
    results = read(results_file("development", root / DATA))
    picture = provenance.in_svg(
        development_report.front(results, plain=True), provenance.of(results)
    )
    texts[FRONT] = picture + "\n"
    changed = [name for name, text in texts.items() if _there(root / name) != text]
    for name in changed:
        put(root / name, texts[name].encode(), parents=True)
    return changed


def _there(path: Path) -> str | None:
    return path.read_text(encoding="utf-8") if path.exists() else None

"""Tables of results in README and written pages, each between <!-- NAME --> and <!-- /NAME -->.

`python -m palpate_studies tables` writes all of them and the picture of README. A table takes the
results of its study, and returns Markdown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.storage import put
from palpate_studies import development_chart, development_report, differences, markdown
from palpate_studies.method_names import plain_name
from palpate_studies.study import DATA, read, results_file
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.reports import provenance
from palpate_train.reports.formatting import amount, estimate, percent, points

Json = Mapping[str, Any]
README = "README.md"
ALIGNMENT, FABRICS = "docs/alignment/README.md", "docs/fabricslide/README.md"
SPECIFICATIONS, RECIPE = "docs/reference/specifications.md", "docs/recipe.md"
FIGURES = "docs/explanation/figures.md"
FRONT = "docs/front.svg"
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
    return _spaced(("stranger", "sweeps", "label", "with early answers"), rows)


def _answers(rows: Iterable[tuple[str, int, int, int]]) -> str:
    cells = (
        [text.format(total), *(f"{n:,}" for n in (right, wrong, total - right - wrong))]
        for text, total, right, wrong in rows
    )
    return _spaced(("sweeps", "classified correctly", "wrong label", "no label"), cells)


def _spaced(head: Sequence[str], rows: Iterable[Sequence[object]], about: str = "") -> str:
    """A table between blank lines, in the middle of a page."""
    return f"\n{markdown.table(head, rows, about)}\n"


def _times(at: str) -> str:
    """Median and 99th percentile of n times, of the figures named `at`."""
    return f"median {{{at}[p50]:.2f}} ms, 99 % within {{{at}[p99]:.2f}} ms (n = {{{at}[n]}})"


# fmt: off
BENCH_CAPTION = (
    "Measured by `make bench` with the simulated skin, on {machine[cores]} cores of {processor}"
    " ({machine[arch]}, {machine[system]}, Python {machine[python]}, onnxruntime"
    " {machine[onnxruntime]}), one thread; {date}, commit {commit}, seed {seed}, bundle {bundle}."
    " Load average of the machine, which other work shares: {load_average[before][0]:.1f} before,"
    " {load_average[after][0]:.1f} after."
)
BENCH_ROWS = (
    ("simulated sweeps classified correctly (not the skin's accuracy), n = {accuracy[total]}, with"
        " 95 % interval; `unknown` counts as wrong",
        "{accuracy[right]} of {accuracy[total]}: {share:.1f} % [{low:.1f}, {high:.1f}]"),
    ("frames lost in these sweeps", "{frames_lost}"),
    ("from reading the last frame of the window to the sentence at the port",
        _times("edge_to_sentence_ms")),
    ("from the STOP edge to its being in hand, with the last frame (glitch filter, rest of a USB"
        " packet)", _times("edge_seen_ms")),
    ("inference of the packaged bundle (int8)", _times("inference_ms[int8]")),
    ("for comparison, inference of its network alone in float32", _times("inference_ms[fp32]")),
    ("for comparison, inference of the paper's network (CNN) in int8",
        _times("inference_ms[paper_int8]")),
    ("resident memory after 1,000 sweeps, with the simulated readout board in it",
        "{rss_mb[after_1000]:.1f} MiB; {growth:+.1f} MiB in the next 900"),
    ("of it without the simulated readout board", "{rss_mb[without_board]:.1f} MiB"),
    ("share of one core while the skin streams, without the simulated readout board",
        "{streaming:.1f} %"),
    ("start of the process to READY with a streaming skin",
        "median {cold_start_s:.2f} s, longest {cold_start_worst_s:.2f} s"),
    ("size of the packaged bundle on the disk",
        "{bundle_kb[all]:.1f} kB, of it the network {bundle_kb[model]:.1f} kB"),
)
# fmt: on
"""Name and value of each measured figure."""


def bench(figures: Json) -> str:
    """The box's time and memory, with a caption. Figures of an older bundle are marked as such.
    Raises KeyError if a figure is missing."""
    accuracy = figures["accuracy"]
    low, high = (100 * value for value in accuracy["interval"])
    known = {
        **figures,
        "processor": figures["machine"]["processor"] or "a machine",
        "share": 100 * accuracy["right"] / accuracy["total"],
        "low": low,
        "high": high,
        "growth": round(figures["rss_mb"]["growth_next_900"], 1) + 0.0,  # 0 has no sign
        "streaming": 100 * figures["cpu_share_streaming"],
    }
    older, about = provenance.of(figures).older, BENCH_CAPTION.format(**known)
    rows = ([cell.format(**known) for cell in row] for row in BENCH_ROWS)
    return markdown.table(("what", "measured"), rows, f"**{older}**\n\n" * bool(older) + about)


# fmt: off
MOVED_HEAD = ("skin moved", "answered correctly", "wrong label", "`unsure`", "`unknown`", "marked",
    "wrong and not marked")
MOVED = {
    "rows": ((0.0, "not at all"), (1.0, "1 mm towards row 4"), (2.0, "2 mm"), (3.0, "3 mm"),
        (4.0, "4 mm, one row"), (5.0, "5 mm"), (-4.0, "4 mm towards row 1")),
    "columns": ((-4.0, "4 mm towards column 1"), (4.0, "4 mm towards column 4")),
}
# fmt: on
"""Displacements in mm that have a line."""


def alignment(result: Json) -> str:
    """A line for each displacement of MOVED and for T-HARD, with 95 % intervals, under a caption
    with bundle, sets and commit."""
    rows = [("T-HARD, a row ahead and all else anew", result["T-HARD"])]
    for direction, shown in MOVED.items():
        at = {point["mm"]: point for point in result["moved"][direction]}
        rows += [(text, at[mm]) for mm, text in shown if mm in at]
    caption = (
        f"Bundle {result['bundle']}, "
        f"commit {result['commit']}, {result['machine']}: {result['T-HARD']['n']} sweeps of "
        f"{result['T-HARD']['set']} at {result['T-HARD']['attachments']} attachments; "
        f"all other lines {result['other positions']['n']} "
        f"of {result['other positions']['set']} at {result['other positions']['attachments']}, "
        "moved. Per cent [95 %], else sweeps."
    )
    return markdown.table(MOVED_HEAD, (_moved_cells(*row) for row in rows), caption)


def _moved_cells(text: str, point: Json) -> tuple[object, ...]:
    return (
        text,
        estimate(point["accuracy"]),
        estimate(point["wrong_share"]),
        point["unsure"],
        point["unknown"],
        estimate(point["moved"], 0),
        point["wrong_unflagged"],
    )


def fabrics(results: Sequence[Json], ours: str = SHIPPED) -> str:
    """A line for each test: `ours`, the best of the others (chosen in hindsight), their difference,
    a verdict.

    Sweeps without means come first. Each figure is the mean over seeds, with its 95 % interval.
    """
    tests: dict[tuple[bool, int, str], dict[str, list[list[float]]]] = {}
    for result in results:
        test = (bool(result["means_removed"]), len(result["materials"]), result["protocol"])
        share = result["window"]["right"] / result["window"]["total"]
        tests.setdefault(test, {}).setdefault(result["method"], []).append(
            [share, *result["interval"]]
        )
    rows = []
    for removed, classes, protocol in sorted(tests, key=lambda test: (not test[0], -test[1])):
        found = {
            name: differences.entry(np.mean(seeds, axis=0).tolist())
            for name, seeds in tests[removed, classes, protocol].items()
        }
        if ours in found:
            line = differences.line("", found.pop(ours), found)
            what = f"{classes} classes: {development_chart.PROTOCOLS.get(protocol, (protocol,))[0]}"
            rows.append([what, "removed" if removed else "kept", *_compared(line)])
    others = "best of the others", "difference, points", "verdict"
    return markdown.table(("test", "means", plain_name(ours), *others), rows)


def shots(results: Json, at: int = 5) -> str:
    """A line for each test of the study `shots`: accuracy in per cent of all methods by sweeps of a
    material, and by how much ours is ahead of each peer with `at`."""
    names, tests = list(map(plain_name, results["rows"][0]["methods"])), dict[str, list[str]]()
    ahead: dict[str, list[str]] = {}
    for row in results["rows"]:
        test = f"{len(row['materials'])} classes"
        shares = (one["right"] / one["total"] for one in row["methods"].values())
        tests.setdefault(test, []).append("/".join(map(points, shares)))
        if row["each"] == at:
            ahead[test] = [differences.shown(gap) for gap in row["ahead"].values()]
    numbers = dict.fromkeys(row["each"] for row in results["rows"])
    head = (
        "sweeps of a material",
        *map(str, numbers),
        *(f"{at}: ahead of {name}" for name in names[1:]),
    )
    rows = [[test, *cells, *ahead[test]] for test, cells in tests.items()]
    return markdown.table(head, rows, f"{'/'.join(names)}, per cent:")


def _compared(line: Json) -> list[str]:
    """Ours, the best of the others with its name, difference, verdict."""
    own = estimate(differences.of(line["ours"]))
    if not line["best"]:
        return [own, "–", "–", line["verdict"]]
    other = f"{plain_name(line['best'])}: {estimate(differences.of(line['leader']))}"
    return [own, other, differences.shown(line["gap"]), line["verdict"]]


# fmt: off
VIEWS = {
    "filters": ("log mean magnitude of random integer filters",
        "texture: which patterns in time and across taxels occur how strongly",
        "usually; as few filters as suffice"),
    "shares": ("share of each filter's responses above a threshold",
        "stick and slip: rare strong responses, which a mean hides",
        "with the filters, in every second discriminant"),
    "distribution": ("shares of counts and of their differences above thresholds, of each taxel",
        "roughness and friction of fast and slow skins", "unless accuracy is better without it"),
    "spectrum": ("log power in bands, averaged over taxels",
        "vibration; it carries over to a skin that was put back",
        "unless accuracy is better without it"),
    "relations": (
        "deviations of taxels and correlations of their pairs, at up to seven time scales",
        "how taxels move together: a new force, speed or direction",
        "only if held-out groups show a gain, and several taxels exist"),
    "loads": ("mean count of each taxel; the change of all in the first and the last tenth",
        "hardness, which the level shows", "only if held-out groups show a gain"),
    "slow waves": ("low lines of each taxel's transform over the window and over its tenths",
        "waves as long as the window, or of few taxels",
        "with half of the weight, unless held-out groups are worse for it"),
    "stages": ("log mean responses of three trained convolutions",
        "patterns that no fixed filter has",
        "with `--stages`, from 25 sweeps of each material on, unless accuracy is worse"),
}
# fmt: on
"""Features, purpose and condition of each view."""


def recipe(results: Json) -> str:
    """A row for each view: features, purpose, cost, condition, sets."""
    costs = {view["view"]: view for view in results["views"]}
    rows = []
    for name, (features, purpose, when) in VIEWS.items():
        cost = costs[name]
        spent = cost["features"], amount(cost["us"], "µs"), amount(cost["bytes"] / 1e3, "KB")
        told = ", ".join(map(str, spent))
        rows.append([name, features, purpose, told, when, _on(name, results["sets"])])
    head = "view", "features", "what it is for", "alone: features, time, bytes", "when chosen", "on"
    return markdown.table(head, rows)


def _on(view: str, sets: Sequence[Json]) -> str:
    """The sets whose fit has this view, or those without it where these are fewer."""
    chosen = [one["set"] for one in sets if view in one["views"]]
    without = [one["set"] for one in sets if view not in one["views"]]
    if not without:
        return f"all {len(sets)}"
    if len(without) < len(chosen):
        return f"all but {', '.join(without)}"
    return ", ".join(chosen) or "no set"


def rules(results: Json, pairs: bool = True) -> str:
    """A row for each rule that is left out, with `pairs` also for each pair of rules."""
    first, *others = results["rows"]
    others = [row for row in others if pairs or len(row["without"]) == 1]
    kinds = list(first["total"])
    totals = ", ".join(f"{first['total'][kind]:,} {kind}" for kind in kinds)
    head = ["without", *(f"{kind}: right, wrong" for kind in kinds[:-1]), "junk with a label"]
    rows = []
    for row in (first, *others):
        name = " and ".join(row["without"]) or "(every rule)"
        counts = [f"{row['right'][kind]}, {row['wrong'][kind]}" for kind in kinds[:-1]]
        rows.append([name, *counts, row["wrong"][kinds[-1]], f"{row['ms']:.2f}"])
    return _spaced([*head, "ms"], rows, f"Bundle {results['bundle']}, {totals}.")


Row = tuple[str, str, str]
"""A question, its figure, and the test."""
FIGURE_HEAD = ("question", "figure, 95 % interval", "test")


def recorded(results: Json) -> str:
    """Accuracy on recorded data and time of a sweep, of the default recipe and the packaged one."""
    return _spaced(FIGURE_HEAD, _recorded(results))


def _recorded(results: Json) -> Iterator[Row]:
    for panel in development_chart.panels(results):
        for spot in panel.whole:
            if spot.method in (SHIPPED, PACKAGED) and not spot.form:
                test = f"mean of {len(panel.cases)} tests: {panel.kind}"
                yield f"accuracy: {plain_name(spot.method)}", estimate(spot.accuracy), test
    times = results.get("times") or {"entries": (), "format": ""}
    for method, ms in development_chart.quickest(times["entries"]).items():
        if method in (SHIPPED, PACKAGED):
            yield f"time of a sweep: {plain_name(method)}", amount(ms, "ms"), times["format"]


def answered(results: Json) -> str:
    """The packaged bundle's answers on the simulated skin, from the study `alignment`."""
    places = {
        "other positions": "simulated, 36 attachments that training had not seen",
        "T-HARD": "simulated, one row further along and all else anew",
    }
    figures = {"accuracy": "correct answers", "wrong_share": "wrong labels"}
    rows = []
    for place, test in places.items():
        at = results[place]
        for key, what in figures.items():
            rows.append((f"packaged bundle: {what}", estimate(at[key]), f"{test}, n = {at['n']}"))
    return _spaced(FIGURE_HEAD, rows)


def trusted(results: Json) -> str:
    """Unknown materials, early answers and calibration, from the study `certainty`."""
    unknown, early = results["unknown"]["mean"], results["early"]
    after, n = results["calibration"]["after"], results["tested"]
    left_out = f"simulated, each material left out in turn, n = {n}"
    other = f"simulated, other skins than in training, n = {n}"
    lost: Sequence[float] = [100 * early[key] for key in ("lost", "lost_low", "lost_high")]
    # fmt: off
    return _spaced(FIGURE_HEAD, (
        (f"sweeps of untaught materials that get a label, where {percent(unknown['kept'])} of"
            " taught ones get theirs", percent(unknown["false_known"]), left_out),
        ("part of the window until an early answer", percent(early["share"]), other),
        ("accuracy that early answers lose", "{:.1f} points [{:.1f}, {:.1f}]".format(*lost), other),
        ("calibration error of the probability",
            estimate((after["error"], after["low"], after["high"])), other),
    ))
    # fmt: on


TABLES: Sequence[tuple[str, str, str, Callable[[Any], str]]] = (
    (README, "stress", "stress", stressed),
    (README, "junk", "junk", junk),
    ("docs/explanation/limits.md", "strangers", "junk", strangers),
    (README, "front", "development", development_report.caption),
    (SPECIFICATIONS, "bench", "bench", bench),
    (ALIGNMENT, "alignment", "alignment", alignment),
    (RECIPE, "recipe", "recipe", recipe),
    ("docs/how-to/train.md", "rules", "rules", partial(rules, pairs=False)),
    (FABRICS, "matrix", "fabrics", fabrics),
    (FABRICS, "shots", "shots", shots),
    (FIGURES, "recorded", "development", recorded),
    (FIGURES, "answered", "alignment", answered),
    (FIGURES, "trusted", "certainty", trusted),
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
    changed = []
    for name, text in texts.items():
        path = root / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            put(path, text.encode(), parents=True)
            changed.append(name)
    return changed

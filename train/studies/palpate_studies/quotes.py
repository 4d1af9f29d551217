"""The quantities that documents may quote, each with its one figure: the tables of "Which number to
quote".

`contradictions` finds figures of the same quantities in sentences of other documents that differ.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate_studies import development_chart, reports, stress_report
from palpate_studies.development_chart import ChartPanel
from palpate_studies.method_names import plain_name
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.reports import provenance
from palpate_train.reports.formatting import amount, estimate, percent

Json = Mapping[str, Any]
HEAD = "| quantity | figure, 95 % interval | test | sweeps | seeds |\n|---|---|---|---|---|"
FAIR = 0.97
"""Share of known sweeps that count as known where unknown ones are compared."""
NUMBER = re.compile(r"(?<![\d.,–-])(\d+(?:\.\d+)?) (%|ms|kB|points)(?![\w%])")
SENTENCE = re.compile(r"(?<=[.:;])\s|\n\s*\n|\n(?=[|*-])")


@dataclass(frozen=True, slots=True)
class Quote:
    """A quantity with its figure. shown: figure and interval in words. values: figure and ends of
    the interval, in `unit`. test: in words. words: regular expressions, all of which match a
    sentence about the quantity; without them no sentence is checked."""

    name: str
    shown: str
    values: tuple[float, ...]
    unit: str
    test: str
    sweeps: int | None = None
    seeds: Sequence[int] = ()
    words: tuple[str, ...] = ()

    @property
    def row(self) -> str:
        """The line of the table."""
        sweeps = f"{self.sweeps:,}" if self.sweeps else "–"
        seeds = ", ".join(map(str, self.seeds)) or "–"
        return f"| {self.name} | {self.shown} | {self.test} | {sweeps} | {seeds} |"

    def allows(self, text: str, unit: str) -> bool:
        """Whether a number in a document is one of the values, rounded to its own places."""
        places = len(text.partition(".")[2])
        return unit == self.unit and any(f"{value:.{places}f}" == text for value in self.values)


def table(study: str, results: Any) -> str:
    """The quantities of one file of results in Markdown, with its origin and its command."""
    about = provenance.of(results)
    (made,) = reports.named([study])
    origin = f"[{study}.json](../data/{study}.json), by `{made.command}`; {about.date}."
    rows = [quote.row for quote in QUOTES[study](results)]
    older = [f"**{about.older}**", ""] if about.older else []
    return "\n".join([*older, origin, "", HEAD, *rows])


def contradictions(document: str, quotes: Sequence[Quote]) -> list[str]:
    """Sentences of a document about a quantity whose figure is none of its values. Tables between
    markers are left out, because their own results make them."""
    text = re.sub(r"(?s)<!-- ([^/>]+) -->.*?<!-- /\1 -->|^```.*?^```", "", document, flags=re.M)
    found = []
    for sentence in SENTENCE.split(text):
        plain = " ".join(sentence.split())
        there = [q for q in quotes if q.words and all(re.search(w, plain) for w in q.words)]
        units = {quote.unit for quote in there}
        for number, unit in NUMBER.findall(plain):
            if unit in units and not any(quote.allows(number, unit) for quote in there):
                found.append(f"{number} {unit}: {plain}")
    return found


def _share(name: str, shares: Sequence[float], test: str, **more: Any) -> Quote:
    """A quantity that is a share with its interval."""
    values = tuple(100 * share for share in shares)
    return Quote(name, estimate(shares), values, "%", test, **more)


def _development(results: Json) -> Iterator[Quote]:
    """Accuracies on recorded data, and times."""
    table = development_chart.by_case(results["results"])
    for panel in development_chart.panels(results):
        for method in (SHIPPED, PACKAGED):
            yield from _mean(panel, method, table)
        for case in panel.cases if panel.kind == development_chart.TACTILE else ():
            if one := table[case["case"]].get(SHIPPED):
                test = development_chart.plain_case(case)
                shares = one["mean"], one["low"], one["high"]
                yield _share(plain_name(SHIPPED), shares, test, sweeps=one["n"], seeds=one["seeds"])
    timed = results.get("times") or {"entries": (), "format": ""}
    for method, ms in development_chart.quickest(timed["entries"]).items():
        name = plain_name(method)
        words = ("[Tt]ime|takes", re.escape(name), "sweep")
        shown = amount(ms, "ms")
        yield Quote(f"time of a sweep: {name}", shown, (ms,), "ms", timed["format"], words=words)


def _mean(panel: ChartPanel, method: str, table: Mapping[str, Any]) -> Iterator[Quote]:
    """The mean accuracy of a method on a panel, if it was run in every test."""
    for spot in panel.whole:
        if (spot.method, spot.form) == (method, ""):
            entries = [table[case["case"]][method] for case in panel.cases]
            seeds = sorted(set.intersection(*(set(one["seeds"]) for one in entries)))
            test = f"mean of {len(entries)} tests: {panel.kind}"
            sweeps = sum(one["n"] for one in entries)
            yield _share(plain_name(method), spot.accuracy, test, sweeps=sweeps, seeds=seeds)


PLACES = (
    ("other positions", "36 attachments that training had not seen", ("packaged", "simulated")),
    ("T-HARD", "one row further along and all else anew", ("T-HARD", "packaged")),
)


def _alignment(results: Json) -> Iterator[Quote]:
    """The packaged bundle on the simulated skin, as the box answers."""
    for key, test, words in PLACES:
        point = results[key]
        for what, name in (
            ("accuracy", "packaged bundle, correct answers"),
            ("wrong_share", "packaged bundle, wrong labels"),
            ("network", "its network by label alone"),
        ):
            more = {"words": ("answer", *words)} if what == "accuracy" else {}
            yield _share(name, point[what], f"simulated, {test}", sweeps=point["n"], **more)


def _bench(results: Json) -> Iterator[Quote]:
    """The box on one machine."""
    right, total = results["accuracy"]["right"], results["accuracy"]["total"]
    shares = (right / total, *results["accuracy"]["interval"])
    test = "simulated, a quick check of a machine"
    yield _share("packaged bundle, correct answers", shares, test, sweeps=total)
    for key, name, words in (
        ("int8", "inference of the packaged bundle (int8)", ("inference", "packaged bundle")),
        (
            "paper_int8",
            "inference of the paper’s CNN (int8)",
            ("inference", "paper.s (CNN|network)"),
        ),
    ):
        ms = results["inference_ms"][key]
        values = tuple(round(ms[f"p{q}"], 2) for q in (50, 99))
        shown = f"{values[0]} ms, 99 % within {values[1]} ms"
        yield Quote(name, shown, values, "ms", "one thread", ms["n"], words=words)
    size = results["bundle_kb"]
    for key, name in (("all", "packaged bundle"), ("model", "its network")):
        words = ("[Ss]ize", name)
        yield Quote(f"size: {name}", f"{size[key]:.1f} kB", (size[key],), "kB", "–", words=words)


def _certainty(results: Json) -> Iterator[Quote]:
    """Unknown materials, early answers and calibration, simulated."""
    unknown, early, after = (
        results["unknown"]["mean"],
        results["early"],
        results["calibration"]["after"],
    )
    test, n = "simulated, each material left out in turn", results["tested"]
    more: dict[str, Any] = {"sweeps": n, "seeds": (results["seed"],)}
    words = ("[Uu]nknown", "known name|known label")
    limits = results["unknown"]["limits"]
    columns = [[limit[key] for limit in limits] for key in ("kept", "false_known")]
    fair = float(np.interp(FAIR, columns[0], columns[1]))
    for kept, known in ((FAIR, fair), (unknown["kept"], unknown["false_known"])):
        name = (
            f"sweeps of unknown materials that get a known name, where {percent(kept)} of known "
            "sweeps count as known"
        )
        yield Quote(name, percent(known), (100 * known,), "%", test, words=words, **more)
    lost = tuple(100 * early[key] for key in ("lost", "lost_low", "lost_high"))
    shown = "{:.1f} points [{:.1f}, {:.1f}]".format(*lost)
    share = early["share"]
    test = "simulated, other skins than in training"
    words = ("[Ee]arly answers", "part|share|window")
    yield Quote(
        "part of the window until an early answer",
        percent(share),
        (100 * share,),
        "%",
        test,
        words=words,
        **more,
    )
    yield Quote("accuracy that early answers lose", shown, lost, "points", test, **more)
    shares = after["error"], after["low"], after["high"]
    yield _share("calibration error of the probability", shares, test, **more)


def _stress(results: Json) -> Iterator[Quote]:
    """Corrupted sweeps, simulated."""
    entry = results["methods"].get(PACKAGED)
    if entry and entry["curves"]:
        _, broken = stress_report.first(entry["curves"])
        clean, *_ = entry["curves"].values()
        shares = clean["accuracy"][0], clean["low"][0], clean["high"][0]
        more: dict[str, Any] = {"sweeps": results["test_sweeps"], "seeds": entry["seeds"]}
        test = f"simulated, {results['attachments']} other attachments, undisturbed"
        yield _share(f"{plain_name(PACKAGED)}, trained anew, by label alone", shares, test, **more)
        name = "corruptions that cost it five points within the tested range"
        shown = f"{broken} of {len(entry['curves'])}"
        yield Quote(name, shown, (broken,), "", "the same, corrupted", **more)


QUOTES: Mapping[str, Callable[[Any], Iterator[Quote]]] = {
    "development": _development,
    "alignment": _alignment,
    "bench": _bench,
    "certainty": _certainty,
    "stress": _stress,
}
"""The quantities of each file of results, the first to quote first."""

"""The room of the story: what `paper` found, told in the paper's order. In: its summary, as results.json holds it.
Out: a page and its pictures.

Nothing is computed here but differences. Every sentence with a number takes it from the summary, so that it is true of
whatever was run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from train.reports import html, paper_printed, plots

TITLES = {
    "lopo": "T-REAL, leave one position out",
    "hard": "trained on T-REAL, tested on T-HARD",
    "lab": "T-LAB, random folds",
    "random": "T-REAL, random folds",
}
"""Hard protocols first."""
COLUMNS = {"lopo": "T-REAL\nleave position", "hard": "T-HARD", "lab": "T-LAB\nrandom", "random": "T-REAL\nrandom"}
FIVE = ("L-gauss", "L-knn", "L-svm", "H-knn", "H-svm")
BEST = "H-svm"
NEAR, NEAR_ON_AVERAGE = 0.06, 0.03
"""What the calibration aims at."""
Row = Mapping[str, Any]


class Story:
    """The page as it grows. pictures: SVG by name."""

    def __init__(self, told: Mapping[str, Any]) -> None:
        self.told = told
        self.rows: dict[tuple[str, str], Row] = {(row["part"], row["method"]): row for row in told["table"]}
        self.pictures: dict[str, str] = {}
        self.cnns = [m for m in paper_printed.CNNS if ("lopo", m) in self.rows]

    def html(self) -> str:
        """All of it."""
        parts = [self.opening(), self.short(), self.run(), self.match(), self.spectral()]
        parts += [self.deep(), self.confused()] if self.cnns else []
        return html.page("The paper, run again", *parts, self.repeated(), self.beyond())

    def picture(self, name: str, svg: str, caption: str, *more: str) -> str:
        """A picture in the page, and by itself."""
        self.pictures[name] = svg
        return html.figure(svg, caption, *more)

    def opening(self) -> str:
        """What this is, before any figure."""
        quick = html.text(
            "This is a quick run: few sweeps, few folds, hardly any training. It shows that every part works; "
            "none of its figures means anything.", kind="stop")  # fmt: skip
        return "\n".join([
            quick if self.told["quick"] else "",
            html.text("Baishya and Bäuml, “Robust Material Classification with a Tactile Skin Using Deep Learning” "
                      "(2016): six tubes, one sweep of a robot's thumb, 4 × 4 taxels at 750 Hz for two seconds. "
                      "Which tube is it?"),
            html.text("Every figure of ours on this page comes from simulated sweeps. The paper's data set is not "
                      "public, and the simulator is a stand-in for the skin, fitted to what the paper printed of its "
                      "five classical methods. What is called T-LAB, T-REAL and T-HARD here is drawn as the paper "
                      "describes its sets. Diamonds ◇ and the word “printed” are the paper's own numbers, of the "
                      "real skin.", kind="note"),
        ])  # fmt: skip

    def short(self) -> str:
        """What came out, hard protocols first."""
        lines = []
        for part, title in TITLES.items():
            held = {m: row["share"] for (p, m), row in self.rows.items() if p == part}
            best = max(held, key=lambda m: held[m][0])
            own = [_estimate(held[m]) if m in held else "–" for m in (BEST, *paper_printed.CNNS)]
            lines.append([title, *own, f"{best} {_estimate(held[best])}"])
        return html.heading("In short") + html.table(
            ["", BEST, paper_printed.CNNS[0], "– means out", "best of all"], lines, texts=(0,)
        )

    def run(self) -> str:
        """Sets, methods, seeds, machine, iterations."""
        sets = [[TITLES[k], ", ".join(p["sets"]) + (f" ({', '.join(p['only'])})" if p["only"] else ""), p["protocol"]]
                for k, p in _ordered(self.told["parts"])]  # fmt: skip
        trained = {row["method"]: row for row in self.told["table"] if row["ran"]}
        nets = [[name, row["ran"], _seconds(row["fit_s"])] for name, row in trained.items()]
        one = self.told["results"][0]
        worlds = {w for row in self.told["table"] for w in row["worlds"]}
        return "\n".join([
            html.heading("What was run"),
            html.text(f"Commit {self.told['commit']}, on {one['machine']}; {_seconds(self.told['took_s'])} without "
                      f"what was kept from an interrupted run. {len(self.told['results'])} evaluations of "
                      f"{len({m for _, m in self.rows})} methods in {len(worlds)} simulated worlds; a world's number "
                      f"{{w}} is its seed, that of the training and that of the random folds."),
            html.table(["", "sets", "protocol"], sets, texts=(0, 1, 2)),
            html.text("In {a}-{b} each seed tapes the skin on anew. An interval is the 95 % bootstrap over where the "
                      "skin sat, since sweeps of one attachment fail together, or Wilson's where that is wider."),
            html.text("Networks were trained on this machine for as long as it says here, which may be less than the "
                      "paper's 4,000 iterations; seconds are of one fold."),
            html.table(["network", "what ran", "fit"], nets, texts=(1,)),
            html.folded("All methods", html.table(["", "what it is"], list(self.told["methods"].items()), texts=(1,))),
        ])  # fmt: skip

    def match(self) -> str:
        """How well the stand-in stands in."""
        rows = [
            self.rows[part, m] for part in ("lab", "lopo", "random", "hard") for m in FIVE if (part, m) in self.rows
        ]
        away = np.array([abs(row["share"][0] - row["printed"]) for row in rows])
        off = [
            f"{row['method']} on {TITLES[row['part']]} ({_signed(row)})"
            for row, d in zip(rows, away, strict=True)
            if d > NEAR
        ]
        return "\n".join([
            html.heading("How well the stand-in stands in"),
            html.text(f"The simulator was calibrated on the {len(rows)} numbers of Figs. 4 to 7, never on a network. "
                      f"Here it misses them by {away.mean():.3f} on average and {away.max():.3f} at most; "
                      f"{np.sum(away <= NEAR)} of {len(rows)} are within {plots.share(NEAR)}, and the aim was all of "
                      f"them, with a mean below {plots.share(NEAR_ON_AVERAGE)}.",
                      f"Further off: {'; '.join(off)}." if off else ""),
        ])  # fmt: skip

    def spectral(self) -> str:
        """Sec. III: Figs. 4 to 7."""
        return "\n".join([
            html.heading("Spectral features (section III)"),
            self.figure(4, "lab", FIVE, f"In the lab, with the skin attached once, random folds. {self.change('lab')}"),
            self.figure(5, "lopo", FIVE, "The skin was taken off and put back nine times, and each position was left "
                        f"out once: what a robot must expect. {self.change('lopo')}"),
            self.figure(6, "random", FIVE, "The same sweeps in random folds: other sweeps of the tested position are "
                        f"known from training. {self.flattery()}"),
            self.figure(7, "hard", FIVE, "The skin sits a row of taxels further on than ever in training. "
                                         f"{self.attachments()}"),
        ])  # fmt: skip

    def deep(self) -> str:
        """Sec. IV and V.A: Figs. 9 and 10."""
        two = [(k, m) for k in ("lopo", "hard") for m in (BEST, *paper_printed.CNNS) if (k, m) in self.rows]
        groups = {TITLES[k]: [self.bar(*at) for at in two if at[0] == k] for k in ("lopo", "hard")}
        costs = [np.array(cost) for cost in self.told["costs"][self.cnns[0]]]
        cost = plots.curve(costs, paper_printed.COST, "Fig. 9: cost in training")
        done = f"Ours ended at {np.median([cost[-1, 1] for cost in costs]):.2g}." if costs else ""
        steps = "; ".join(
            sorted({f"{m}: {row['ran']}" for (_, m), row in self.rows.items() if m in paper_printed.CNNS})
        )
        return "\n".join([
            html.heading("The paper's network (sections IV and V)"),
            self.picture("figure-9", cost,
                         f"Fig. 9: cost of {self.cnns[0]} in training, position left out; each fold and their median. "
                         f"Printed: about .08 after 500 iterations, .002 after 2,500, flat after 3,300. {done}"),
            self.picture("figure-10", plots.bars({k: v for k, v in groups.items() if v}, "Fig. 10: H-svm and the CNN"),
                         f"Fig. 10: the best classical method and the CNN ({steps}). In print T-HARD is 60 sweeps: "
                         ".917 is 55 of them, whose 95 % interval is .819 to .964. “Means out” is the same network "
                         "on sweeps less each taxel's mean: it need not learn first that the offset tells nothing.",
                         self.numbers(two)),
        ])  # fmt: skip

    def confused(self) -> str:
        """Sec. V.B and C: Figs. 11 and 12."""
        names = self.told["results"][0]["materials"]
        cnn, best = (np.array(self.told["confusion"][m]) for m in (self.cnns[0], BEST))
        return "\n".join([
            html.heading("What is taken for what (section V.B, C)"),
            self.picture("figure-11", plots.confusion(cnn, names, "Fig. 11: confusion of the CNN", paper_printed.CONFUSION),
                         f"Fig. 11: {self.cnns[0]}, position left out. {_worst(cnn, names)} Printed: metal is recognised "
                         "least (.78), and taken for plastic smooth."),
            self.picture("figure-12", plots.confusion(best, names, "Fig. 12: confusion of H-svm"),
                         f"Fig. 12: H-svm, position left out. {_worst(best, names)} The paper's matrix did not "
                         "survive in numbers; its text: paper, metal and wood are recognised least."),
        ])  # fmt: skip

    def repeated(self) -> str:
        """Sec. V.D: Fig. 13, and the same of all methods, and as many sweeps as it takes."""
        held, explored = self.told["several"], self.told["explored"]
        shown = {m: held[m] for m in (BEST, *self.cnns, "compact") if m in held}
        rows = [[m, *(_estimate(rules["product"][n]) for n in range(3)), _estimate(rules["vote"][2])]
                for m, rules in sorted(held.items(), key=lambda item: -item[1]["product"][2][0])]  # fmt: skip
        sure = [e["sure"] for e in next(iter(explored.values()))]
        more = [[m, *(f"{_estimate(e['share'])} in {e['sweeps']:.1f}" for e in those)]
                for m, those in sorted(explored.items(), key=lambda item: -item[1][-1]["share"][0])]  # fmt: skip
        return "\n".join([
            html.heading("More than one sweep (section V.D)"),
            self.picture("figure-13", plots.sweeps(shown, paper_printed.SEVERAL, "Fig. 13: one, two and three sweeps"),
                         "Fig. 13: one, two and three sweeps of one tube at the position left out. By vote as "
                         "printed the first of equals wins, so two sweeps say what the first said: the printed .973 "
                         "of two sweeps cannot come from it. The box multiplies probabilities."),
            html.folded("All methods, position left out", html.table(
                ["", "one sweep", "two, product", "three, product", "three, vote"], rows)),
            html.text("Or as many as it takes: sweeps are added until the posterior is sure (Xu et al. 2013), up to "
                      "all of that tube at that position. Share right, and sweeps it took on average:"),
            html.table(["sure means", *(plots.share(s) for s in sure)], more),
        ])  # fmt: skip

    def beyond(self) -> str:
        """All methods on all protocols."""
        cells = {(m.replace("paper-cnn,", "cnn,"), COLUMNS[part]): tuple(row["share"]) for part, _ in _ordered(COLUMNS)
                 for (p, m), row in self.rows.items() if p == part}  # fmt: skip
        return "\n".join([
            html.heading("Beyond the paper: all methods"),
            self.picture("methods", plots.grid({"": cells}, "all methods on all protocols"),
                         "Per cent right and 95 % intervals, hard protocols first; the best on average on "
                         "top. Two columns on the right: random folds, only to show how they flatter."),
            *(html.folded(TITLES[k], self.numbers([at for at in self.rows if at[0] == k], times=True)) for k in TITLES),
        ])  # fmt: skip

    def figure(self, number: int, part: str, methods: Sequence[str], caption: str) -> str:
        """Bars of one part with the printed values."""
        those = [(part, m) for m in methods if (part, m) in self.rows]
        bars = plots.bars({"": [self.bar(*at) for at in those]}, f"Fig. {number}: {TITLES[part]}", chance=1 / 6)
        return self.picture(f"figure-{number}", bars, f"Fig. {number}: {TITLES[part]}. {caption}", self.numbers(those))

    def bar(self, part: str, method: str) -> plots.Bar:
        """One row of a picture."""
        row = self.rows[part, method]
        return plots.Bar(paper_printed.short(method), tuple(row["share"]), row["printed"])

    def numbers(self, those: Sequence[tuple[str, str]], times: bool = False) -> str:
        """What a picture shows, as a table; times: also how long it took."""
        several_parts = len({part for part, _ in those}) > 1
        head = ["", "ours", "95 %", "printed", "differs", "right of", "worlds"] + ["ms a sweep", "fit"] * times
        lines = []
        for part, method in those:
            if (row := self.rows.get((part, method))) is not None:
                mean, low, high = row["share"]
                printed = ["–", "–"] if row["printed"] is None else [_printed(row["printed"]), _signed(row)]
                took = [f"{row['ms_p50']:.2f}", _seconds(row["fit_s"])] * times
                lines.append([f"{method}, {TITLES[part]}" if several_parts else method, _three(mean),
                              f"{_three(low)} – {_three(high)}", *printed, f"{row['right']} / {row['total']}",
                              str(len(row["worlds"])), *took])  # fmt: skip
        return html.table(head, lines) if times else html.folded("the numbers", html.table(head, lines))

    def change(self, part: str) -> str:
        """The best of the five, ours and printed."""
        those = [self.rows[part, m] for m in FIVE if (part, m) in self.rows]
        ours, printed = (max(those, key=key) for key in (lambda r: r["share"][0], lambda r: r["printed"]))
        return (f"Best of ours: {ours['method']} with {plots.share(ours['share'][0])}; "
                f"printed: {printed['method']} with {plots.share(printed['printed'])}.")  # fmt: skip

    def flattery(self) -> str:
        """By how much random folds are better than a position left out."""
        both = [
            (self.rows["random", m], self.rows["lopo", m])
            for m in FIVE
            if {("random", m), ("lopo", m)} <= set(self.rows)
        ]
        ours = np.mean([a["share"][0] - b["share"][0] for a, b in both])
        printed = np.mean([a["printed"] - b["printed"] for a, b in both])
        return (
            f"They say {ours:+.3f} more on average over the five than leaving a position out; in print {printed:+.3f}."
        )

    def attachments(self) -> str:
        """How much hangs on one attachment."""
        row = self.rows["hard", BEST]
        n, low, high = row["attachments"]
        return (f"Ours is the mean over {n} attachments, and {BEST} gets from {_three(low)} to {_three(high)} of a "
                "single one: the paper has one, of 60 sweeps.")  # fmt: skip


def tell(told: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The page (HTML) of a summary as paper.summary gives it, and its pictures (SVG) by name."""
    story = Story(told)
    return story.html(), story.pictures


def _ordered(held: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [(k, held[k]) for k in TITLES if k in held]


def _three(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")


def _printed(value: float) -> str:
    return plots.share(value) if round(value, 2) == value else _three(value)


def _estimate(share: Sequence[float]) -> str:
    mean, low, high = map(plots.share, share)
    return f"{mean} [{low}, {high}]"


def _signed(row: Row) -> str:
    return f"{row['share'][0] - row['printed']:+.3f}".replace("0.", ".").replace("-", "−")


def _seconds(value: float) -> str:
    return f"{value / 60:.0f} min" if value >= 600 else f"{value:.0f} s" if value >= 10 else f"{value:.2g} s"


def _worst(matrix: np.ndarray, names: Sequence[str]) -> str:
    """The two greatest confusions, of ours."""
    rows = matrix / np.maximum(matrix.sum(1, keepdims=True), 1)
    off = np.where(np.eye(len(names), dtype=bool), -1, rows)
    order = np.argsort(off, axis=None)[::-1][:2]
    said = [
        f"{names[i]} for {names[j]} ({plots.share(rows[i, j])})"
        for i, j in zip(*np.unravel_index(order, off.shape), strict=True)
    ]
    return f"Ours most often takes {' and '.join(said)}."

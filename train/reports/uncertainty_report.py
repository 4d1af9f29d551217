"""The room that tells how sure the box may be. In: the figures of certainty.py. Out: a page and its pictures.

Nothing is computed here; every sentence with a number takes it from the figures, so that it is true of whatever was run.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from appliance.core.storage import put
from train.calibration.novelty import KEPT
from train.reports import html
from train.reports.plot_style import ACCENT, FAINT, GREY, INK, SMALL, field, scale, share, svg

Told = Mapping[str, Any]
TARGETS = {"unknown": 0.95, "enrolment": 0.90, "early": 0.5, "lost": 0.005}
"""AUROC; share of the fully trained accuracy from five sweeps; share of the sweep; of the accuracy."""
LINE = {"color": ACCENT, "linewidth": 2.0, "marker": "o", "markersize": 3.5}
OTHER = {"color": INK, "linewidth": 1.4, "linestyle": (0, (3, 1.5)), "marker": "o", "markersize": 2.5}
PALE = {"color": GREY, "linewidth": 0.9}


def tell(told: Told) -> tuple[str, dict[str, str]]:
    """The page (HTML) and its pictures (SVG) by name."""
    pictures = {"reliability": reliability(told), "sweeps": sweeps(told), "touch": touch(told)}
    parts = [opening(told), calibration(told, pictures), sequence(told, pictures)]
    if "unknown" in told:
        pictures |= {"unknown": unknown(told), "enrolment": enrolment(told)}
        parts += [strangers(told, pictures), enrolled(told, pictures)]
    return html.page("Knowing what it does not know", *parts, early(told, pictures), run(told)), pictures


def opening(told: Told) -> str:
    """What came out, target by target."""
    rows = []
    if "unknown" in told:
        mean = told["unknown"]["mean"]
        rows.append(["unknown material, AUROC, mean of those left out", "≥ .95", _three(mean["auroc"]),
                     _met(mean["auroc"] >= TARGETS["unknown"])])  # fmt: skip
        for p in _at(told, 5):
            rows.append([f"enrolment from five sweeps, {p['where']}, share of fully trained accuracy", "≥ .90",
                         _estimate(p["share"], p), _met(p["share"] >= TARGETS["enrolment"])])  # fmt: skip
    e = told["early"]
    rows.append(
        ["mean touch time, share of the window", "≤ .50", share(e["share"]), _met(e["share"] <= TARGETS["early"])]
    )
    rows.append(
        ["accuracy that deciding early costs, points", "≤ 0.5", _points(e["lost"]), _met(e["lost"] <= TARGETS["lost"])]
    )
    simulated = str(told["set"]).startswith("sim:")
    return "\n".join([
        html.text("All sweeps are simulated: the simulator stands in for the skin, and a real skin may differ.",
                  kind="note") if simulated else "",
        html.table(["what", "target", "here", ""], rows, texts=(0,)),
    ])  # fmt: skip


def calibration(told: Told, pictures: Mapping[str, str]) -> str:
    """Reliability before and after."""
    c = told["calibration"]
    heat = " to ".join(dict.fromkeys(f"{t:.1f}" for t in (min(c["temperature"]), max(c["temperature"]))))
    return html.heading("May its probabilities be believed?") + html.figure(
        pictures["reliability"],
        f"Of {c['n']} sweeps at places never trained on: what the probability says and how many were right; the size of a dot "
        f"is the number of sweeps. Expected calibration error {_estimate(c['before']['error'], c['before'])} before and "
        f"{_estimate(c['after']['error'], c['after'])} after dividing by the temperature ({heat}, found on sweeps held "
        f"out of training). Accuracy {_estimate(c['accuracy']['accuracy'], c['accuracy'])}.",
    )  # fmt: skip


def sequence(told: Told, pictures: Mapping[str, str]) -> str:
    """The sequential test."""
    rows = [[name, share(p["wanted"]) if p["wanted"] < 0.99 else _three(p["wanted"]), f"{p['sweeps']:.2f}",
             _estimate(p["accuracy"], p), _three(p["decided"])]
            for name, held in told["sequence"].items() for p in held["points"] if p["wanted"]]  # fmt: skip
    return html.heading("One more sweep where it is unsure") + html.figure(
        pictures["sweeps"],
        "Sweeps of one object are fused until the wanted probability is reached, five at most. One sweep always is the first dot "
        "of a line. Sweeps of one place share its errors; after being taken off and put on, they do not.",
        html.folded("All figures", html.table(["sweeps of", "wanted", "mean sweeps", "accuracy", "decided"], rows)),
    )


def strangers(told: Told, pictures: Mapping[str, str]) -> str:
    """Materials that were never trained."""
    u = told["unknown"]
    rows = [[name, _estimate(m["auroc"], m), _three(m["false_known_at_95"]), _three(m["kept"]), _three(m["false_known"]),
             f"{m['known']} / {m['unknown']}"] for name, m in u["materials"].items()]  # fmt: skip
    rows.append(["mean", *(_three(u["mean"][k]) for k in ("auroc", "false_known_at_95", "kept", "false_known")), ""])
    others = [[name, _three(value)] for name, value in u["scores"].items()]
    return html.heading("A material that was never trained") + html.figure(
        pictures["unknown"],
        "Each material was left out of training in turn. Known sweeps are from places never trained on.",
        html.table(["left out", "AUROC", "false known\nat .95 kept", "kept by\nthe limit", "false known\nby the limit",
                    "known / unknown"], rows),
        html.text(f"The limit is found on sweeps held out of training and meant to keep {share(KEPT)}; kept and false known are what "
                  "it does at places that neither training nor the limit has seen."),
        html.folded("Other scores on the same sweeps, mean AUROC", html.table(["score", "AUROC"], others, texts=(0,))),
    )  # fmt: skip


def enrolled(told: Told, pictures: Mapping[str, str]) -> str:
    """New materials without training."""
    rows = [[p["where"], str(p["sweeps"]), _estimate(p["share"], p), _three(p["accuracy"]), _three(p["new"]),
             _points(p["old_lost"]), str(p["draws"])] for p in told["enrolment"]["points"]]  # fmt: skip
    return html.heading("A new material from a few sweeps") + html.figure(
        pictures["enrolment"],
        "The material left out is enrolled from sweeps of one place, as palpate enrol does, and all classes are "
        "tested there and at other places: accuracy, the mean of all classes, as a share of what training on all "
        "materials gives on the same sweeps.",
        html.folded("All figures", html.table(
            ["tested at", "sweeps", "share", "accuracy", "the new one", "old ones lose, points", "draws"], rows)),
    )  # fmt: skip


def early(told: Told, pictures: Mapping[str, str]) -> str:
    """Deciding while the finger slides."""
    e = told["early"]
    off = [r["why"] for r in e["rules"] if r["why"]]
    on = [r for r in e["rules"] if not r["why"]]
    said = f"Off in {len(off)} of {len(e['rules'])} folds: {off[0]}." if off else ""
    rule = f"Rules: {', '.join(sorted({_rule(r) for r in on}))}." if on else ""
    rows = [[f"{d} of 10", _estimate(a["accuracy"], a)] for d, a in enumerate(e["always"], 1)]
    return html.heading("Deciding while the finger still slides") + html.figure(
        pictures["touch"],
        f"By the rules that training found, {share(e['share'])} of the window is needed on average and accuracy is "
        f"{_estimate(e['rule']['accuracy'], e['rule'])} against {_estimate(e['whole']['accuracy'], e['whole'])} of the "
        f"whole window: {_points(e['lost'])} points lost, 95 % {_points(e['lost_low'])} to {_points(e['lost_high'])}. "
        f"{rule} {said}",
        html.folded("Always at the same tenth", html.table(["after", "accuracy"], rows)),
    )


def run(told: Told) -> str:
    """What was run."""
    rows = [[name, str(told[name])] for name in
            ("set", "test", "protocol", "method", "seed", "effort", "folds", "trainings", "sweeps", "tested", "format",
             "digest", "commit", "machine", "took_s") if told[name] != ""]  # fmt: skip
    return html.heading("What was run") + html.table(["", ""], rows, texts=(1,))


def reliability(told: Told) -> str:
    """Said against right, before and after."""
    figure, axes = field(3.0, left=0.12, right=0.97, top=0.35, bottom=0.45)
    axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.2)
    for name, look in (("before", OTHER), ("after", LINE)):
        bins = told["calibration"][name]["bins"]
        said, right = [b["said"] for b in bins], [b["right"] for b in bins]
        n = [6 + 60 * (b["n"] / told["calibration"]["n"]) ** 0.5 for b in bins]
        axes.plot(said, right, **(look | {"marker": ""}))
        axes.scatter(said, right, n, color=look["color"], zorder=3)
    _legend(axes, (("● after", ACCENT), ("╍ before", INK)))
    _frame(axes, (0, 1), (0, 1), "probability said")
    return svg(figure, "share right against the probability said, before and after the temperature")


def sweeps(told: Told) -> str:
    """Mean sweeps against accuracy."""
    figure, axes = field(2.6, left=0.12, right=0.97, top=0.35, bottom=0.45)
    lows = []
    for (_, held), look in zip(told["sequence"].items(), (LINE, OTHER), strict=False):
        x = [p["sweeps"] for p in held["points"]]
        axes.fill_between(x, [p["low"] for p in held["points"]], [p["high"] for p in held["points"]],
                          color=look["color"], alpha=0.12, linewidth=0)  # fmt: skip
        axes.plot(x, [p["accuracy"] for p in held["points"]], **look)
        lows += [p["low"] for p in held["points"]]
    _legend(axes, tuple(zip((f"● {name}" for name in told["sequence"]), (ACCENT, INK), strict=False)))
    most = max([p["sweeps"] for h in told["sequence"].values() for p in h["points"]] or [1])
    _frame(axes, (1, max(most, 1.5)), (_floor(lows), 1), "mean sweeps of an object")
    return svg(figure, "accuracy against the mean number of sweeps")


def unknown(told: Told) -> str:
    """AUROC of each material left out, with its interval."""
    held = told["unknown"]["materials"]
    figure, axes = field(0.29 * len(held) + 0.75, left=0.28, right=0.86, top=0.3, bottom=0.4)
    for y, (name, m) in enumerate(held.items()):
        axes.plot([m["low"], m["high"]], [y, y], color=ACCENT, linewidth=1.6)
        axes.plot(m["auroc"], y, "o", color=ACCENT, markersize=5)
        axes.annotate(name, (0, y), (-8, 0), ("axes fraction", "data"), textcoords="offset points", ha="right",
                      va="center", color=INK, size=SMALL + 0.5)  # fmt: skip
        axes.annotate(_three(m["auroc"]), (1, y), (8, 0), ("axes fraction", "data"), textcoords="offset points",
                      va="center", color=ACCENT, size=SMALL + 0.5)  # fmt: skip
    lowest = _floor([m["low"] for m in held.values()])
    axes.axvline(TARGETS["unknown"], color=GREY, linewidth=1, linestyle=(0, (2, 2)))
    axes.set_ylim(len(held) - 0.5, -0.5)
    axes.set_xlim(lowest, 1.002)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    scale(axes.xaxis, sorted({lowest, 0.95, 1.0}))
    scale(axes.yaxis, [])
    axes.set_title("AUROC, 95 %; the dashes are the target", color=GREY, size=SMALL, loc="left", pad=5)
    return svg(figure, "AUROC of unknown materials, each left out of training")


def enrolment(told: Told) -> str:
    """Share of the fully trained accuracy against sweeps."""
    figure, axes = field(2.6, left=0.12, right=0.97, top=0.35, bottom=0.45)
    points, lows, legend = told["enrolment"]["points"], [TARGETS["enrolment"]], []
    for where, look in (("same place", LINE), ("other places", OTHER)):
        held = [p for p in points if p["where"] == where]
        if held:
            x = [p["sweeps"] for p in held]
            axes.fill_between(x, [p["low"] for p in held], [p["high"] for p in held], color=look["color"], alpha=0.12,
                              linewidth=0)  # fmt: skip
            axes.plot(x, [p["share"] for p in held], **look)
            lows += [p["low"] for p in held]
            legend.append((f"● {where}", look["color"]))
    axes.axhline(TARGETS["enrolment"], color=GREY, linewidth=1, linestyle=(0, (2, 2)))
    _legend(axes, tuple(legend))
    _frame(axes, (1, 10), (_floor(lows), max([1.01, *(p["high"] for p in points)])), "sweeps enrolled from")
    return svg(figure, "accuracy with an enrolled material as a share of the fully trained one")


def touch(told: Told) -> str:
    """Accuracy against the mean share of the sweep."""
    e = told["early"]
    figure, axes = field(2.8, left=0.12, right=0.97, top=0.35, bottom=0.45)
    curves = {int(k): [(p["share"], p["accuracy"]) for p in v] for k, v in e["curves"].items()}
    for held in curves.values():
        axes.plot(*zip(*held, strict=True), **PALE)
    always = [a["accuracy"] for a in e["always"]]
    axes.plot([(d + 1) / len(always) for d in range(len(always))], always, **OTHER)
    axes.plot(e["share"], e["rule"]["accuracy"], "D", color=ACCENT, markersize=7, zorder=4)
    axes.axhline(e["whole"]["accuracy"] - TARGETS["lost"], color=GREY, linewidth=1, linestyle=(0, (2, 2)))
    _legend(axes, (("◆ the rules found", ACCENT), ("╍ always then", INK), ("— other rules", GREY)))
    _frame(axes, (0, 1), (_floor([*always, *(a for held in curves.values() for _, a in held)]), 1),
           "mean share of the window")  # fmt: skip
    return svg(figure, "accuracy against touch time")


def _frame(axes: Axes, x: tuple[float, float], y: tuple[float, float], label: str) -> None:
    """Limits, ticks, grid and the name of the horizontal axis; upright is always a share."""
    (left, right), (low, high) = x, y
    axes.set_xlim(left - 0.03 * (right - left), right + 0.03 * (right - left))
    axes.set_ylim(low, high + 0.02 * (high - low))
    axes.grid(color=FAINT, linewidth=0.6)
    step = 0.25 if right <= 1 else 1 if right >= 3 else 0.2 if right < 2 else 0.5
    scale(axes.xaxis, [left + step * k for k in range(int((right - left) / step + 1e-9) + 1)])
    scale(axes.yaxis, [round(low + k * (1 - low) / 5, 3) for k in range(6)])
    axes.set_xlabel(label, color=GREY, size=SMALL)


def _legend(axes: Axes, entries: Sequence[tuple[str, str]]) -> None:
    for i, (text, colour) in enumerate(entries):
        axes.annotate(
            text, (i / 3, 1), (0, 8), "axes fraction", textcoords="offset points", color=colour, size=SMALL + 0.5
        )


def _at(told: Told, sweeps: int) -> list[Any]:
    return [p for p in told["enrolment"]["points"] if p["sweeps"] == sweeps]


def _floor(lows: Sequence[float]) -> float:
    """Where an axis of shares begins: a tenth below all."""
    return max(int(min(lows, default=0) * 10 - 1e-9) / 10, 0.0)


def _rule(rule: Told) -> str:
    return f"probability {rule['least']:g}, {rule['agree']} in agreement"


def _estimate(value: float, ends: Told) -> str:
    return f"{_three(value)} [{_three(ends['low'])}, {_three(ends['high'])}]"


def _three(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")


def _points(value: float) -> str:
    return f"{100 * value:.1f}".replace("-", "−")


def _met(met: bool) -> str:
    return "reached" if met else "not reached"


def write(told: dict[str, Any], out: Path) -> Path:
    """results.json, the pictures and the page in the folder `out`; the page's path."""
    page, pictures = tell(told)
    put(out / "results.json", (json.dumps(told) + "\n").encode(), parents=True)
    for name, picture in pictures.items():
        put(out / f"{name}.svg", picture.encode(), parents=True)
    put(out / "index.html", page.encode(), parents=True)
    return out / "index.html"

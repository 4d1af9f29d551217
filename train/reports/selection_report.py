"""The room where a choice is told. In: choice.json as a dict. Out: the same sentences for a terminal and for one page.

Nothing is computed here but shares and points; every number is in choice.json.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from train.reports import html as page
from train.reports import selection_plots
from train.reports.selection_plots import figure_of as share

Json = Mapping[str, Any]
UNITS = {"ms": "ms", "kb": "kB", "mb": "MB"}
NAMES = {"window": "window", "rate": "rate", "taxels": "taxels", "bits": "bits", "classes": "materials"}


def text(told: Json) -> str:
    """For the terminal."""
    lines = [headline(told), honest(told), *verdicts(told), "", _rungs_line(RUNG_HEAD)]
    lines += [_rungs_line(row) for row in rung_rows(told)]
    lines += ["", *(f"{name}: {said}" for name, said in needs(told)), together(told), "", budget(told), caveat(told)]
    return "\n".join(line for line in lines if line is not None)


def html(told: Json) -> str:
    """The page."""
    missed = wanted(told) and not reached(told)
    parts = [page.text(headline(told), kind="note"), page.text(honest(told))]
    parts += [page.text(said, kind="stop" if missed and i == 0 else "") for i, said in enumerate(verdicts(told))]
    parts.append(page.figure(selection_plots.rungs(told["rungs"], told["chosen"], told["wanted"], "accuracy of each model"),
                             f"Share of sweeps named rightly, {_left_out(told)}; 95 % intervals. Cheapest on top."))  # fmt: skip
    parts.append(page.text(budget(told), caveat(told) or ""))
    parts += _less(told) if told["less"] else []
    parts += [page.heading("What remains confused"), page.text(*confusions(told), _sentence(merges(told)))]
    parts += [page.folded("All models", page.table(RUNG_HEAD, rung_rows(told), texts=(6,)))]
    parts += [page.folded("How this was found", "\n".join([page.text(said) for said in method(told)]))]
    return page.page(f"{told['scene']}: the smallest model", *(part for part in parts if part))


def _less(told: Json) -> list[str]:
    """The section of the curves."""
    picture = selection_plots.less(told["less"], "accuracy with less of each thing")
    caption = "Accuracy of the chosen model with less. Filled: no more than one standard error lost; blue: the least that will do."
    rows = [row for row in needs(told) if row[0] != NAMES["classes"]]
    table = [page.table(["", "what will do"], rows, texts=(1,))] if rows else []
    left = [page.text(said)] if (said := together(told)) else []
    return [page.heading("What the scene does not need"), page.figure(picture, caption), *table, *left]


def headline(told: Json) -> str:
    """What was taken."""
    b = told["bundle"]
    less = [c["kept"] + " of each sweep" * (c["kind"] == "window") for c in told["less"] if c["applied"]]
    cut = f" with {' and '.join(less)}" if less else ""
    size = f"a bundle of {b['kb']:.0f} kB, {b['ms']:.3f} ms a sweep on this machine"
    if wanted(told) and not reached(told):
        return f"{told['chosen']}{cut} is as good as anything here, yet not good enough: {size}."
    return f"{told['chosen']}{cut} is enough to tell {len(told['materials'])} materials apart: {size}."


def honest(told: Json) -> str:
    """The figure that the choice did not flatter."""
    h = told["honest"]
    chose = ", ".join(f"{n} × {name}" for name, n in h["chose"].items())
    groups = "; ".join(f"{name} {_estimate(e)}" for name, e in h["groups"].items()) if len(h["groups"]) > 1 else ""
    return (f"To be expected at work: {_estimate(h)}. That is the choice made anew without each part and tested on it "
            f"({chose}){': ' + groups if groups else ''}.")  # fmt: skip


def wanted(told: Json) -> bool:
    """Whether an accuracy was asked for."""
    return told["wanted"] > 0


def reached(told: Json) -> bool:
    """Whether the honest figure is what was asked for."""
    return bool(told["honest"]["mean"] >= told["wanted"])


def verdicts(told: Json) -> list[str]:
    """Wanted or not, why not smaller, why not larger."""
    return [said for said in (_wanted(told), _smaller(told), _larger(told)) if said]


def _wanted(told: Json) -> str:
    if not wanted(told):
        return ""
    aim, h = share(told["wanted"]), told["honest"]
    if not reached(told):
        return (f"Not reached: {aim} is wanted, {share(h['mean'])} is to be expected; no model within the budget does better "
                "by more than a standard error. Record more, let less vary, or tell fewer materials apart.")  # fmt: skip
    if h["low"] < told["wanted"]:
        sure = f"; it is not certain, the interval begins at {share(h['low'])}"
    else:
        sure = f", and the interval begins at {share(h['low'])}"
    enough = next((r for r in told["rungs"] if r["accuracy"] and r["accuracy"]["mean"] >= told["wanted"]), None)
    cheaper = ""
    if enough and enough["method"] != told["chosen"]:
        cheaper = (f" {enough['method']} ({enough['kb']:.0f} kB) would reach it too, with {_estimate(enough['accuracy'])}: "
                   f'name it in methods if that is enough.')  # fmt: skip
    return f"Reached: {aim} is wanted{sure}.{cheaper}"


def _smaller(told: Json) -> str:
    if not (s := told["smaller"]):
        return "Not smaller: nothing cheaper could be tried."
    best = "it" if told["best"] == told["chosen"] else f"the best, {told['best']}"
    behind = next(r["behind"] for r in told["rungs"] if r["method"] == s["method"])
    return (f"Not smaller: {s['method']} names {_points(s)} points fewer rightly, and is {_number(behind['mean'])} points behind {best}, "
            f"where one standard error is {_number(behind['se'])}.")  # fmt: skip


def _larger(told: Json) -> str:
    if not (s := told["larger"]):
        following = next((r for r in told["rungs"] if r["method"] == told["next"]), None)
        return (
            f"Not larger: {following['method']}: {following['why_not']}."
            if following
            else "Not larger: it is the last of the ladder."
        )
    if s["mean"] <= 0:
        return f"Not larger: {s['method']} names {_points(s, -1)} points fewer rightly."
    return f"Not larger: {s['method']} names {_points(s)} points more rightly, where one standard error is {_number(s['se'])} points."


RUNG_HEAD = ["model", "ms", "kB", "MB", "of the budget", "right", "behind the best, in points"]


def rung_rows(told: Json) -> list[list[str]]:
    """One row for each rung, cheapest first."""
    rows = []
    for r in told["rungs"]:
        costs = ["–"] * 3 if r["ms"] is None else [f"{r['ms']:.3f}", f"{r['kb']:.1f}", f"{r['mb']:.0f}"]
        used = f"{100 * max(r['used'].values()):.0f} %" if r["used"] else "–"
        right = _estimate(r["accuracy"]) if r["accuracy"] else "–"
        behind = _points(r["behind"]) if r["behind"] else r["why_not"]
        rows.append([r["method"], *costs, used, right, "best" if r["method"] == told["best"] else behind])
    return rows


def _rungs_line(row: Sequence[str]) -> str:
    name, ms, kb, mb, used, right, behind = row
    return f"  {name:<14} {ms:>7} {kb:>7} {mb:>4} {used:>14}  {right:<20} {behind}"


def needs(told: Json) -> list[list[str]]:
    """What of each thing will do, and what has to be set for it."""
    rows = []
    for c in told["less"]:
        if c["kind"] == "classes":
            rows.append([NAMES["classes"], merges(told)])
            continue
        last = [p for p in c["points"] if "accuracy" in p]
        kept = next(p for p in last if p["name"] == c["kept"])
        fails = next((p for p in last if not p["fine"]), None)
        said = f"all of it; {fails['name']} loses {_points(fails['behind'])} points" if fails else "all of it"
        if kept is not last[0]:
            said = f"{c['kept']}: {share(kept['accuracy']['mean'])} of {share(last[0]['accuracy']['mean'])}"
            said += f"; {fails['name']} loses {_points(fails['behind'])} points" if fails else ""
            said += f". {'In the bundle' if c['applied'] else 'Not in the bundle'}; {c['set']}"
            said += f": {_taxels(c['taxels'])}" if "taxels" in c else ""
        rows.append([NAMES[c["kind"]], said + "."])
    return rows


def together(told: Json) -> str | None:
    """What the bundle does with all that was left out of it."""
    if not any(c["applied"] for c in told["less"]):
        return None
    return f"The bundle, with that left out: {_estimate(told['left'])}; it loses {_points(told['left']['behind'])} points by it."


def _taxels(kept: Sequence[Sequence[int]]) -> str:
    return " ".join(f"{r + 1}.{c + 1}" for r, c in kept) + " (row.column)"


def merges(told: Json) -> str:
    """Which materials might as well be one."""
    curve = next((c for c in told["less"] if c["kind"] == "classes"), None)
    if curve is None:
        return ""
    if not curve["proposed"]:
        return "all are told apart well enough; none need be counted as one"
    tables = ", ".join(f'"{" or ".join(those)}"' for those in curve["proposed"])
    left = len(told["materials"]) - sum(len(those) - 1 for those in curve["proposed"])
    got = next(p for p in curve["points"] if p["name"] == str(left))
    return (f"if {tables} may count as one, {share(got['accuracy']['mean'])} of sweeps are right among {left} names; "
            "say so under [merge], nothing was merged")  # fmt: skip


def _sentence(said: str) -> str:
    return f"{said[:1].upper()}{said[1:]}." if said else ""


def confusions(told: Json, most: int = 3) -> list[str]:
    """The pairs that are most often taken for each other."""
    said = [f"{100 * c['share']:.0f} % of {c['is']} are called {c['named']}" for c in told["confused"][:most]]
    return ["; ".join(said) + "." if said else "Nothing at all."]


def budget(told: Json) -> str:
    """What the bundle takes of the board."""
    b, limits = told["bundle"], told["budget"]
    used = [f"{100 * share_:.0f} % of {limits[k]:g} {UNITS[k]}" for k, share_ in b["used"].items()]
    assumed = (
        f"one ms here is taken for {limits['slower']:g} on the board, which is an assumption"
        if "ms" in b["used"]
        else ""
    )
    return (
        f"Of the board it takes {', '.join(used)}{'; ' + assumed if assumed else ''}."
        if used
        else "No budget was given."
    )


def caveat(told: Json) -> str | None:
    """What makes the figures of no worth, if anything does."""
    said = (
        [] if told["varies"] else ["nothing varies in this scene, so recordings were left out at random: that flatters"]
    )
    said += [f"trained for {told['effort']:g} of the usual time"] if told["effort"] != 1 else []
    said += ["all sweeps are simulated"] if told["set"].startswith("sim:") else []
    said += [f"not shortened: {told['bundle']['refused_with_less']}"] if told["bundle"].get("refused_with_less") else []
    return "Mind: " + "; ".join(said) + "." if said else None


def method(told: Json) -> list[str]:
    """For whoever doubts it."""
    parts = "; ".join(
        f"{p['group']} {' '.join(map(str, p['values'][:8]))}{' …' if len(p['values']) > 8 else ''}"
        for p in told["parts"]
    )
    return [
        f"{told['sweeps']} sweeps of {told['set']} ({told['digest']}). Left out in turn: {parts}. Tests: "
        + ", ".join(f"{c['name']} {share(c['accuracy'])}" for c in told["conditions"]) + ", each counting the same.",
        "Taken is the cheapest within one standard error of the best; the error is that of the difference, sweep by sweep, "
        "over the values that are left out together. Cheap is what takes little of the scarcer of time and room.",
        "The curves compare with the whole in the same way. They and the choice have seen all sweeps; only the figure to be "
        "expected at work has not been chosen by.",
        f"Seeds {', '.join(map(str, told['seeds']))}; commit {told['commit']}; {told['machine']}.",
        told["command"],
    ]  # fmt: skip


def _left_out(told: Json) -> str:
    groups = list(dict.fromkeys(p["group"] for p in told["parts"]))
    tests = f", {len(told['conditions'])} conditions" if len(told["conditions"]) > 1 else ""
    return f"with every {' and '.join(groups)} unseen in training{tests}"


def _estimate(e: Json) -> str:
    return f"{share(e['mean'])} [{share(e['low'])}, {share(e['high'])}]"


def _number(value: float) -> str:
    return f"{100 * value:.1f}"


def _points(d: Json, sign: int = 1) -> str:
    low, high = sorted((sign * d["low"], sign * d["high"]))
    return f"{_number(sign * d['mean'])} [{_number(low)}, {_number(high)}]"

"""Pictures: their content and its order. They are the same on every machine and need no other
file.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

from palpate_studies import paper_values, plots, stress_plots
from palpate_train.reports import confusion_plot, plot_style
from tests.factories import stress_data

SVG = "{http://www.w3.org/2000/svg}"
ESTIMATE = (0.864, 0.81, 0.903)
NAMES = ("metal", "plastic rough", "foam")
COUNTS = np.array([[8, 2, 0], [0, 10, 0], [1, 0, 9]])


def result(
    method: str, protocol: str, right: int, means_removed: bool = True, seed: int = 1
) -> dict:
    """A result as evaluate writes it, of a hundred windows and ten recordings."""
    return {
        "method": method,
        "protocol": protocol,
        "means_removed": means_removed,
        "seed": seed,
        "materials": ["a", "b"],
        "window": {"right": right, "total": 100},
        "interval": [right / 100 - 0.05, right / 100 + 0.05],
        "recording": {"right": 4, "total": 10},
        "recording_interval": [0.31, 0.52],
    }


PICTURES: dict[str, Callable[[], str]] = {
    "bars": lambda: plots.bars(
        {"T-HARD": [plots.Bar("H-svm", ESTIMATE, 0.7)]}, "bars of H & L", chance=1 / 6
    ),
    "curve": lambda: plots.curve([np.array([[0, 1.8], [100, 0.3]])] * 2, [(500, 0.08)], "cost"),
    "long curve": lambda: plots.curve(
        [np.array([[1, 1.8], [4000, 1e-4]])], [(2500, 0.002)], "cost"
    ),
    "confusion": lambda: confusion_plot.draw(COUNTS, NAMES, "confusion", COUNTS / 10),
    "sweeps": lambda: plots.sweeps(
        {"H-svm": dict.fromkeys(("vote", "product"), [ESTIMATE] * 3)}, {}, "sweeps"
    ),
    "matrix": lambda: plots.matrix([result("H-svm", "leave:force", 70)]),
    "stress": lambda: stress_plots.methods(
        {
            name: entry["curves"]
            for name, entry in stress_data.figures()["methods"].items()
            if entry["curves"]
        }
    ),
    "box under stress": lambda: stress_plots.box(stress_data.figures()["box"]["curves"]),
}


def words(svg: str) -> list[str]:
    """All texts of a picture."""
    return [node.text or "" for node in ElementTree.fromstring(svg).iter(f"{SVG}text")]


def places(svg: str) -> dict[str, tuple[float, float]]:
    """The position of each text. Of equal texts the last counts."""
    return {
        node.text or "": (float(node.get("x", 0)), float(node.get("y", 0)))
        for node in ElementTree.fromstring(svg).iter(f"{SVG}text")
    }


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_are_whole_alike_and_need_nothing(name: str):
    """They are well-formed, titled, equal in two runs and in roles of colour.

    They link only to their own parts.
    """
    svg = PICTURES[name]()
    root = ElementTree.fromstring(svg)
    assert root.find(f"{SVG}title").text
    assert svg == PICTURES[name]()
    assert all(link.startswith("#") for link in re.findall(r'href="([^"]*)"', svg))
    assert all(link.startswith("#") for link in re.findall(r"url\(([^)]*)\)", svg))
    assert svg.count("<style") == svg.count(plot_style.SCHEMES) == 1
    svg = svg.replace(plot_style.SCHEMES, "")
    assert "font-family: " not in svg
    for colour in plot_style.ROLES.values():
        assert re.search(f"(?<!, ){colour}", svg) is None, "the page cannot change this colour"
    assert all("fill: var(--" in text.get("style") for text in root.iter(f"{SVG}text")), (
        "black in dark mode, too"
    )
    assert all(float(size) >= 7 for size in re.findall(r"font-size: ([\d.]+)px", svg))


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_no_text_leaves_the_picture(name: str):
    """Every text begins inside the picture, and ends inside by a cautious estimate of its width."""
    root = ElementTree.fromstring(PICTURES[name]())
    _, _, width, height = map(float, root.get("viewBox").split())
    for node in root.iter(f"{SVG}text"):
        style, text = node.get("style"), node.text or ""
        long = 0.5 * len(text) * float(re.search(r"font-size: ([\d.]+)px", style)[1])
        left = float(node.get("x")) - {"middle": long / 2, "end": long}.get(
            (re.search(r"text-anchor: (\w+)", style) or ["", ""])[1], 0
        )
        assert -1 <= left <= left + long <= width + 1, text
        assert 0 < float(node.get("y")) <= height, text


def test_bars_show_ours_the_interval_and_what_was_printed():
    """All four numbers are there, in the paper's notation. The line of chance is optional."""
    shown = words(PICTURES["bars"]())
    assert {"T-HARD", "H-svm", "86 %", "81 – 90 %", "70 %", "random guess"} <= set(shown)
    plain = words(plots.bars({"": [plots.Bar("H-svm", ESTIMATE)]}, "bars"))
    assert "random guess" not in plain
    assert "70 %" not in plain


def test_a_cost_curve_has_its_marks_even_where_nothing_was_trained():
    """Printed marks are at their values. The project's label is only there with a curve of the
    project.
    """
    assert {"0.08", "ours"} <= set(words(PICTURES["curve"]()))
    none = words(plots.curve([], [(2500, 0.002)], "cost"))
    assert "0.002" in none
    assert "ours" not in none


def test_confusion_gives_shares_of_each_row():
    """Counts become shares of the true material. The paper's printed shares stand below them."""
    shown = words(PICTURES["confusion"]())
    assert [shown.count(text) for text in ("80", "20", "100", "90", "10")] == [1, 1, 1, 1, 1]
    assert shown.count("◇ 20") == 1
    assert not any("◇" in text for text in words(confusion_plot.draw(COUNTS, NAMES, "confusion")))
    one = np.diag(np.ones(len(NAMES)))
    thirty = words(confusion_plot.draw(one, NAMES, "c", totals=np.full(len(NAMES), 30)))
    assert thirty.count("3") == len(NAMES)
    assert "100" not in thirty


def test_a_name_is_text_and_no_formula_or_markup():
    """A name that people typed may have dollar signs and angle brackets."""
    names = ["geölt $\\frac{$ <b>", "wood"]
    drawn = confusion_plot.draw(np.eye(2, dtype=int), names, "confusion")
    assert names[0] in words(drawn)
    assert "<b>" not in drawn


def test_sweeps_mark_what_was_printed():
    """A single sweep gives the same by vote and by product, and is labelled once.

    Each printed value has a mark, None has no mark.
    """
    bare = PICTURES["sweeps"]()
    assert words(bare).count("86") == 5
    ours = {"H-svm": dict.fromkeys(("vote", "product"), [ESTIMATE] * 3)}
    marked = plots.sweeps(ours, {"H-svm": (0.86, None, 0.92)}, "sweeps")
    assert marked.count("<use") == bare.count("<use") + 2


def test_matrix_puts_hard_protocols_and_good_methods_first():
    """Columns are leave, split, random. Rows are sorted by the mean of the first panel, without
    means.
    """
    order = ("random:5", "split:force=1->2", "leave:speed")
    results = [result(m, p, r) for m, r in (("bad", 40), ("good", 90)) for p in order]
    results += [result("bad", p, 95, means_removed=False) for p in order]
    shown = places(plots.matrix(results))
    assert shown["good"][1] < shown["bad"][1]
    assert (
        shown["without each taxel’s mean over the window"][1]
        < shown["as recorded, means and all"][1]
    )
    assert shown["speed"][0] < shown["split by"][0] < shown["random"][0]


def test_matrix_takes_the_mean_over_seeds_and_counts_what_it_is_told():
    """70 and 80 of 100 windows are 75 with the mean interval. By recordings it is 40."""
    results = [result("H-svm", "leave:force", 70), result("H-svm", "leave:force", 80, seed=2)]
    assert {"75", "70–80"} <= set(words(plots.matrix(results)))
    assert {"40", "31–52"} <= set(words(plots.matrix(results, count="recording")))


def test_titles_of_panels_do_not_collide():
    """The title of each panel ends before the next begins, by a generous estimate of its width."""
    rules = dict.fromkeys(("vote", "product"), [ESTIMATE] * 3)
    names = ["H-svm", *map(paper_values.short_name, (paper_values.CNN, "palpate-reattached"))]
    at = places(plots.sweeps(dict.fromkeys(names, rules), {}, "sweeps"))
    ends = [(at[name][0], at[name][0] + 0.65 * plot_style.MEDIUM * len(name)) for name in names]
    assert all(end < begin for (_, end), (begin, _) in pairwise(ends))
    assert ends[-1][1] < 360

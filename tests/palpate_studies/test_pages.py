"""Pages from templates: each shows every figure of its committed results and escapes its texts.

It needs no other file.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jinja2
import pytest

from palpate_studies import paper_report, stress_report, uncertainty_report
from palpate_studies.method_names import plain_name
from palpate_studies.stress_targets import at_targets
from palpate_train.reports import formatting, html, selection_report
from tests.factories import choice_data
from tests.factories.page_reader import PageReader
from tests.factories.paths import ROOT
from tests.factories.study_pages import committed
from tests.rig import soak_page

Facts = Iterator[str]


def number(value: float, places: int = 1) -> str:
    """A share in percent, without the sign."""
    return f"{100 * value:.{places}f}"


def three(mean: float, low: float, high: float) -> str:
    """A share with its interval."""
    return f"{number(mean)} % [{number(low)}, {number(high)}]"


def paper_facts(summary: Any) -> Facts:
    """Each line of the table, with and without a printed value; commit, machine, methods, sets."""
    for row in summary["table"]:
        mean, low, high = row["share"]
        yield f"{number(mean)} % {number(low)} – {number(high)} %"
        ms = (
            "–" if row["ms_p50"] is None else f"{row['ms_p50']:.2f}"
        )  # of a CNN in the curve's file instead of the evaluation
        yield f"{row['right']} / {row['total']} {len(row['seeds'])} {ms}"
    yield from (f"Commit {commit}" for commit in {one["commit"] for one in summary["results"]})
    yield f"On {summary['results'][0]['machine']}"
    yield f"{len(summary['results'])} evaluations"
    yield from summary["methods"].values()
    yield from (
        "sim:T-REAL/level-blind:W, sim:T-HARD/level-blind:A-B",
        "the 20 numbers differ by",
        "55 of them",
        "best in print: H-svm",
    )


def certainty_facts(figures: Any) -> Facts:
    """Targets, calibration, sequences, materials, enrolment, early exit, origin."""
    let_through = figures["unknown"]["mean"]["false_known"]
    if let_through > 0.1:
        yield (
            f"Missed: sweeps of unknown materials that get a known name, {number(let_through)} "
            "% (wanted ≤ 10 %)"
        )
    worst, its = max(
        figures["unknown"]["materials"].items(), key=lambda item: item[1]["false_known"]
    )
    yield f"the one most often taken for a known one: {worst}, {number(its['false_known'])} %."
    for p in (p for held in figures["sequence"].values() for p in held["points"] if p["wanted"]):
        share = three(p["accuracy"], p["low"], p["high"])
        yield f"{p['sweeps']:.2f} {share} {number(p['decided'])} %"
    for name, m in figures["unknown"]["materials"].items():
        shares = (
            f"{number(m['false_known'])} % {number(m['kept'])} "
            f"% {three(m['auroc'], m['low'], m['high'])}"
        )
        yield f"{name} {shares} {number(m['false_known_at_95'])} % {m['known']} / {m['unknown']}"
    for name, value in figures["unknown"]["scores"].items():
        yield f"{name} {number(value)} %"
    for p in figures["enrolment"]["points"]:
        yield f"{p['where']} {p['sweeps']} {three(p['share'], p['low'], p['high'])}"
    for tenth, a in enumerate(figures["early"]["always"], 1):
        yield f"{tenth} of 10 {three(a['accuracy'], a['low'], a['high'])}"
    before = figures["calibration"]["before"]
    yield f"{three(before['error'], before['low'], before['high'])} as the classifier gives them"
    yield f"{number(figures['early']['share'])} % of the window"
    yield from (
        str(figures[name]) for name in ("set", "test", "digest", "commit", "machine", "format")
    )


def stress_facts(result: Any) -> Facts:
    """Each method, its accuracy at every severity with a limit, the box's answers there, and the
    origin.
    """
    curves = {plain_name(name): entry["curves"] for name, entry in result["methods"].items()}
    curves |= {
        f"box {answer}": result["box"]["curves"][answer]
        for answer in ("rightly", "wrongly", "network")
    }
    for name, those in curves.items():
        yield name.removeprefix("box ")
        for mean, low, high in at_targets(those).values():
            yield f"{number(mean)} % {number(low)} – {number(high)} %"
    yield f"{result['test_sweeps']} of {result['test']} ({result['test_digest']})"
    bundle = result["box"]["bundle"]
    yield ", ".join(filter(None, [f"bundle {bundle['name']} {bundle['version']}", bundle["id"]]))


def soak_facts(records: Any) -> Facts:
    """Boxes, sums, faults and runs."""
    for name, box in records["boxes"].items():
        sums = box["sums"]
        yield name
        yield f"{sums['received']:,}"
        yield from (
            f"{sums[kind]['n']:,}: {number(sums[kind]['n'] / sums[kind]['of'])} %"
            for kind in ("right", "wrong")
        )
        yield from (what for run in box["runs"] for _, what in run["faults"])
        yield f"{number(sums['cpu'])} %"
        yield box["commit"]


def choice_facts(choice: Any) -> Facts:
    """The choice with its reason, all sizes, the target, budget and origin."""
    honest = choice["honest"]
    yield (
        f"{choice['chosen']} with 0.5 s of each sweep is enough to distinguish 3 materials: a "
        "bundle of 12 kB, 0.118 ms a sweep on this machine. It contains relations at 3 scales, "
        "spectrum <i>."
    )
    yield (
        f"Accuracy to expect: {three(honest['mean'], honest['low'], honest['high'])}, with every "
        "place and day unseen in training."
    )
    yield "tested on it (4 × pairs, 1 × 64)."
    yield "Reached: 90 % is wanted; it is not certain, since the interval begins at 87.8 %."
    yield (
        "Not smaller: bands names 12.3 [10.3, 14.3] points fewer rightly, and is 13.1 "
        "points behind the best, 64,"
    )
    yield (
        "Not larger: 64 names 0.8 [−1.2, 2.8] points more rightly, where one standard "
        "error is 1.2 points."
    )
    yield "0.5 s: 93.0 % of 93.5 %; 0.2 s loses 12.0 [10.0, 14.0] points."
    yield "In the fit; set window so."
    yield "everything; 375 Hz loses 6.0 [4.0, 8.0] points."
    yield "4: 92.8 % of 93.5 %. Not in the fit; set taxels so: 1.1 1.4 4.1 4.4 (row.column)."
    yield (
        "1 % of 50 ms, 2 % of 500 kB; one ms here is taken for 3 on the board, which is an "
        "assumption."
    )
    yield (
        "Note: two thirds of the held-out sweeps are augmented copies, as of a skin put back; all "
        "sweeps are simulated."
    )


SMALL = '"metal or plastic <smooth>" may count as one, 96.5 % of sweeps are right among 2 names'
PAGES: dict[str, tuple[Callable[[], str], Callable[[], Facts]]] = {
    "paper": (
        lambda: paper_report.render(committed("paper"))[0],
        lambda: paper_facts(committed("paper")),
    ),
    "certainty": (
        lambda: uncertainty_report.render(committed("certainty"))[0],
        lambda: certainty_facts(committed("certainty")),
    ),
    "stress": (
        lambda: stress_report.render(committed("stress"))[0],
        lambda: stress_facts(committed("stress")),
    ),
    "stress-fabrics": (
        lambda: stress_report.render(committed("stress-fabrics"), "stress-fabrics")[0],
        lambda: stress_facts(committed("stress-fabrics")),
    ),
    "soak": (
        lambda: soak_page.render(committed("soak"))[0],
        lambda: soak_facts(committed("soak")),
    ),
    "choice": (
        lambda: selection_report.page(choice_data.choice()),
        lambda: iter(
            [
                *choice_facts(choice_data.choice()),
                f"If {SMALL}",
                "12 % of metal are called plastic <smooth>.",
                "480 sweeps of sim:T-REAL:1 (7f7b49c7)",
                "Parts of place and day were left out in turn;",
            ]
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
def test_a_page_shows_every_figure_of_its_results(name: str):
    """Its visible text contains all facts. It contains no brace, None or nan; its tags close, and
    it links to no other place but a DOI.
    """
    render, facts = PAGES[name]
    page = render()
    read = PageReader(page)
    for fact in facts():
        assert fact in read.text, fact
    assert not re.search(r"[{}]|\bNone\b|\bnan\b|Markup|Undefined", read.text)
    assert (read.wrong, read.open) == ([], [])
    elsewhere = re.compile(r"/|(?!data:|https://doi\.org/)\w+:")  # a page shows nothing from there
    assert not any(elsewhere.match(link) for link in read.links)
    assert not re.search(r"@import|url\((?!#)|<link", page)
    assert 'name="viewport" content="width=device-width' in page
    assert "prefers-color-scheme: dark" in page
    assert page.count("<table") == len(re.findall(r'<div class="wide"[^>]*><table', page))


@pytest.mark.slow
def test_terminal_and_page_say_the_same_of_a_choice():
    """Every sentence is a line on the terminal, unescaped. The table has a line for each model."""
    text = selection_report.text(choice_data.choice())
    lines = text.split("\n")
    for fact in choice_facts(choice_data.choice()):
        assert any(fact in line for line in lines), fact
    assert f"materials: if {SMALL}" in text
    table = [line.split()[0] for line in lines if line.startswith("  ")]
    assert table == ["size", "bands", "pairs", "64", "all"]
    assert lines[-1].startswith("Note: ")


def test_a_choice_that_is_not_good_enough_says_so_first():
    """The page emphasizes that it missed the target. It has no smaller or larger model, curve or
    budget.
    """
    text, page = (
        selection_report.text(choice_data.missed()),
        selection_report.page(choice_data.missed()),
    )
    for fact in (
        "bands is the best size here but not good enough",
        "Not reached: 99 % is wanted, 51.0 % is to be expected",
        "The same sweeps chose the size, so it is slightly too high.",
        "Not smaller: no size is cheaper.",
        "Not larger: no larger size is within the budget.",
        "No budget was given.",
        "the set has no groups that vary",
    ):
        assert fact in text
        assert fact in PageReader(page).text
    assert '<p class="stop">Not reached' in page
    assert "does not need" not in page


@pytest.mark.slow
def test_what_a_template_prints_is_escaped(tmp_path: Path):
    """Foreign names cannot become tags. A picture stays a picture. Missing data is an error."""
    (tmp_path / "a.html.j2").write_text("<p>{{ name }} {{ picture }} {{ share | percent }}</p>")
    page = html.render(
        "a.html.j2", tmp_path, name="<b> & c", picture=html.picture("<svg/>"), share=0.5
    )
    assert page == "<p>&lt;b&gt; &amp; c <svg/> 50.0\N{NO-BREAK SPACE}%</p>"
    with pytest.raises(jinja2.UndefinedError, match="name"):
        html.render("a.html.j2", tmp_path)
    evil = selection_report.page(choice_data.choice(set="</title><script>"))
    assert "<script>" not in evil
    assert "&lt;/title&gt;" in evil


def test_numbers_are_written_for_people():
    """Percentages have a sign, differences are in points, durations have a suitable unit."""
    assert (formatting.percent(0.973), formatting.percent(1, 0)) == ("97.3 %", "100 %")
    assert [formatting.exact_percent(v) for v in (0.86, 0.923, 0.999, 1)] == [
        "86 %",
        "92.3 %",
        "99.9 %",
        "100 %",
    ]
    assert formatting.estimate([0.864, 0.81, 0.9031]) == "86.4 % [81.0, 90.3]"
    assert formatting.interval((0.81, 0.903), 0) == "81 – 90 %"
    assert [formatting.points(v) for v in (0.023, -0.0041)] == ["2.3", "−0.4"]
    assert [formatting.points(v, sign=True) for v in (0.023, -0.0041)] == ["+2.3", "−0.4"]
    assert formatting.points(-0.0001) == "0.0"
    assert [
        formatting.amount(*v)
        for v in ((0.4009, "ms"), (104.17, "ms"), (950.0, "KB"), (15918.3, "KB"), (1234567.0,))
    ] == ["0.401 ms", "104 ms", "950 KB", "15.9 MB", "1,230,000"]
    assert [formatting.seconds(v) for v in (0.2468, 31.4, 720)] == ["0.25 s", "31 s", "12 min"]


@pytest.mark.slow
def test_an_installed_wheel_has_the_templates(tmp_path: Path):
    """The wheel of the desktop contains every template and script of reports."""
    source = shutil.copytree(
        ROOT / "train", tmp_path / "train", ignore=shutil.ignore_patterns("build", "*.egg-info")
    )
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        tmp_path,
        source,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    packed = set(zipfile.ZipFile(wheel).namelist())
    assert {
        f"palpate_train/reports/templates/{path.name}" for path in html.TEMPLATES.iterdir()
    } <= packed

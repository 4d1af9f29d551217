"""The chart: its front, the costs of a graph, seeds and stress, and the content of the files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from appliance.core.errors import FormatError
from appliance.sim import skin
from tests.factories.chart_data import DOTS, FRONT, SHOWN, dot
from tests.factories.loud_model import loudness, sweeps
from tests.factories.page_reader import PageReader
from tests.factories.study_pages import committed, published
from train.evaluation.evaluate import Where
from train.metrics import score
from train.models import methods
from train.models.recipe import graph
from train.models.recipe.architectures import ARCHITECTURES
from train.onnx_tools.quantize import quantize
from train.studies import (
    chart_experiment,
    chart_page,
    comparison,
    cost,
    method_names,
    pages,
    pareto,
    scatter,
)
from train.studies.study import Study, StudyCase, StudyRun

KEYS = (
    "method",
    "precision",
    "weights",
    "macs",
    "file_kb",
    "rss_mb",
    "ms_p50",
    "ms_p99",
    "touch_s",
    "runs_on_box",
)
"""Required keys of each dot, beside `accuracy`."""


# the front


def test_the_front_is_what_no_other_dot_beats():
    """A dot on the front is cheaper or more accurate than every other dot.

    A tie in one axis is decided by the other. Equal dots are on the front together.
    """
    assert pareto.front([(1, 0.9), (2, 0.8), (2, 0.95), (3, 0.95), (0.5, 0.1)]) == [
        True,
        False,
        True,
        False,
        True,
    ]
    assert pareto.front([(1, 0.9), (1, 0.9)]) == [True, True]
    assert pareto.front([(1, 0.8), (1, 0.9)]) == [False, True]
    assert pareto.front([]) == []


def test_dots_without_a_figure_are_not_placed():
    """A dot without the chosen accuracy is neither on the chart nor on the front."""
    spots = pareto.placed(DOTS, "ms_p50", "lopo")
    assert len(spots) == 4
    assert [DOTS.index(spot.dot) for spot in spots if spot.best] == FRONT["lopo"]
    assert [spot.x for spot in spots] == sorted(spot.x for spot in spots)


def test_a_network_is_shown_once_where_it_costs_least():
    """It is shown in int8 if that is quicker, with its other precision beside it, and in the
    quicker of two libraries. With other costs it may be shown in another form.
    """
    spots = {DOTS.index(spot.dot): spot for spot in pareto.placed(DOTS, "ms_p50", "speed")}
    assert sorted(spots) == sorted(SHOWN)
    assert spots[0].other == (0.05, 0.91)
    assert spots[6].methods == {"minirocket"}
    assert spots[6].on_box  # its other precision is
    assert spots[6].other is None
    assert 5 in [DOTS.index(spot.dot) for spot in pareto.placed(DOTS, "rss_mb", "speed")]
    slow = [dot("lite", "float", 1.0, 0.8, family="x"), dot("lite", "int8", 2.0, 0.79, family="x")]
    (spot,) = pareto.placed(slow, "ms_p50", "speed")
    assert (spot.dot["precision"], spot.other) == ("float", (2.0, 0.79))


def test_two_names_of_one_network_are_one():
    """Two of the project's networks are one if weights, operations and all common accuracies are
    equal.

    Peers are never merged.
    """
    twin = dot("compact-20k", "int8", 0.04, 0.95)
    dots = [
        dot("compact", "int8", 0.04, 0.95, 0.93),
        twin | {"ms_p50": 0.03},
        dot("compact-50k", "int8", 0.04, 0.96),
    ]
    assert pareto.networks(dots) == [0, 0, 2]
    (spot, _) = pareto.placed(dots, "ms_p50", "speed")
    assert (spot.x, spot.methods) == (0.03, {"compact", "compact-20k"})
    assert pareto.subject(dots) == "compact"
    others = [
        one | {"family": "peers", "method": name}
        for one, name in zip(dots, ("a", "b", "c"), strict=True)
    ]
    assert pareto.networks(others) == [0, 1, 2]
    assert pareto.networks([one | {"weights": None} for one in dots]) == [0, 1, 2]
    assert pareto.subject(others) == ""


def test_chance_is_that_of_the_sets():
    """Chance is one over the number of materials of each set. For real sets the number is in the
    results of `development`.
    """
    (fabrics,) = {
        one["materials"]
        for one in committed("development")["cases"]
        if one["only"] == list(chart_experiment.SEVEN)
    }
    for key in pareto.ACCURACIES.keys() & chart_experiment.STUDY.cases.keys():
        classes = fabrics if chart_experiment.STUDY.cases[key].real else len(skin.MATERIALS)
        assert pareto.ACCURACIES[key].chance == pytest.approx(1 / classes), key


# costs


def test_weights_and_multiply_accumulates_are_counted():
    """A graph with sums by hand. int8 counts the same; scales and zero points are not weights."""
    plain, whole = loudness(), quantize(loudness(), sweeps().samples)
    assert cost.precision(plain) == "float"
    assert cost.precision(whole) == "int8"
    assert cost.macs(plain) == cost.macs(whole) == 39 * 3 * 4 * 2 + 3 * 2
    assert cost.weights(plain) == cost.weights(whole) == 3 * 4 * 2 + 3 + 3 * 2 + 2


def test_the_family_counts_its_costs_as_the_chart_does():
    """architectures.py computes for a shape the costs that cost.py counts in the graph.

    The means of the responses are an exception, and so is the spectrum: its part of the head, and
    the few numbers that it consists of.
    """
    (method,) = methods.find(["compact-10k"], methods.Effort(share=0.0))
    known = sweeps()
    model = method.train(known, known.samples, 1)
    shown, bands = model.fit.architecture.cost(known.format, 2), model.fit.bands
    alone = graph.trunk_graph(known.format, model.fit.scale, {}, ARCHITECTURES["bands"])
    more = [count(alone) + 2 * bands if bands else 0 for count in (cost.weights, cost.macs)]
    for one in (model, model.precisions["float"]):
        assert cost.weights(one.graph()) == shown.weights + more[0]
        assert cost.macs(one.graph()) == pytest.approx(
            shown.macs + more[1], rel=0.15
        )  # in so short a window the means count
    assert (
        cost.weights(alone) <= 7 * 4 + bands
    )  # window, unused frequencies (twice), shares of the bands


def test_a_gru_a_kernel_and_neighbours_are_counted():
    """One node each, with costs computed by hand."""
    nodes = {
        "GRU": (
            [7, 1, 5],
            helper.make_node("GRU", ["x", "w", "r"], ["y"], hidden_size=4),
            7 * 3 * 4 * (5 + 4),
        ),
        "CDist": (
            [1, 5],
            helper.make_node("CDist", ["x", "w"], ["y"], domain="com.microsoft"),
            1 * 12 * 5,
        ),
        "SVM": (
            [1, 5],
            helper.make_node(
                "SVMClassifier",
                ["x"],
                ["y"],
                domain="ai.onnx.ml",
                support_vectors=[0.0] * 15,
                coefficients=[0.0] * 3,
            ),
            18,
        ),
    }
    for shape, node, expected in nodes.values():
        weights = [
            onnx.numpy_helper.from_array(np.zeros(of, np.float32), name)
            for name, of in (
                ("w", [1, 12, 5] if node.op_type == "GRU" else [12, 5]),
                ("r", [1, 12, 4]),
            )
        ]
        x = helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)
        y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
        graph = helper.make_graph([node], "one", [x], [y], weights)
        domains = [
            helper.make_opsetid(name, v)
            for name, v in (("", 17), ("ai.onnx.ml", 3), ("com.microsoft", 1))
        ]
        assert cost.macs(helper.make_model(graph, opset_imports=domains)) == expected


def test_a_graph_of_unknown_shapes_is_refused():
    """A product with an unknown shape is reported by name instead of counted as nothing."""
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3])
    w = onnx.numpy_helper.from_array(np.zeros((3, 2), np.float32), "w")
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    model = helper.make_model(
        helper.make_graph(
            [helper.make_node("MatMul", ["x", "w"], ["y"], "product")], "g", [x], [y], [w]
        )
    )
    with pytest.raises(FormatError, match=r"'product'.*'x' is not known"):
        cost.macs(model)


def test_the_transforms_of_features_are_counted():
    """L has one transform of 1500 frames for each of 16 taxels, H 40 of 75 frames; raw counts have
    none.
    """
    assert cost.feature_macs("L", skin.FORMAT) == pytest.approx(16 * 1500 * np.log2(1500), abs=1)
    assert cost.feature_macs("H", skin.FORMAT) == pytest.approx(16 * 40 * 75 * np.log2(75), abs=1)
    assert cost.feature_macs("raw", skin.FORMAT) == 0


# joining


def test_seeds_are_joined():
    """The mean of the accuracies and of the ends of the intervals; the number of sweeps of one
    seed.
    """
    results = [
        {
            "window": {"right": right, "total": 100},
            "interval": [right / 100 - 0.1, right / 100 + 0.05],
            "seed": seed,
        }
        for right, seed in ((80, 2), (90, 1))
    ]
    assert chart_experiment.joined(results) == {
        "mean": 0.85,
        "low": 0.75,
        "high": 0.9,
        "n": 100,
        "seeds": [1, 2],
    }


def curve(severities: list[float], accuracy: list[float]) -> dict:
    """A curve as stress.merge returns it."""
    ends = {"low": [a - 0.1 for a in accuracy], "high": [min(a + 0.1, 1) for a in accuracy]}
    return {
        "severities": severities,
        "accuracy": accuracy,
        "total": 216,
        "unit": "",
        "about": "",
    } | ends


def test_stress_is_given_by_the_worst_and_at_the_targets():
    """The worst is the lowest mean over all severities above zero.

    Gain is the worse of both directions. Noise is read at .3.
    """
    curves = {
        "noise": curve([0, 0.1, 0.3, 0.5], [0.9, 0.8, 0.7, 0.6]),
        "hum": curve([0, 1, 2], [0.9, 0.5, 0.3]),
        "gain-up": curve([0, 0.1, 0.3], [0.9, 0.9, 0.7]),
        "gain-down": curve([0, 0.2], [0.9, 0.85]),
        "dead": curve([0, 1, 2], [0.9, 0.88, 0.1]),
    }
    shown = chart_experiment.under_stress({"curves": curves, "seeds": [1, 2]})
    assert (shown["stress"]["name"], shown["stress"]["mean"], shown["stress"]["n"]) == (
        "hum",
        0.4,
        108,
    )
    means = {key: entry["mean"] for key, entry in shown.items()}
    assert means["stress:none"] == 0.9
    assert means["stress:noise"] == 0.7
    assert means["stress:gain"] == 0.8
    assert means["stress:dead"] == 0.88
    assert "stress:lost" not in shown


def test_touch_time_is_read_or_refused(tmp_path: Path):
    """The error names a file of another kind."""
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"method": "compact", "early": {"share": 0.5}}))
    assert chart_experiment.touch_shares([path]) == {"compact": 0.5}
    path.write_text("[1]")
    with pytest.raises(
        FormatError, match=r"results\.json: not what python -m train.studies certainty wrote"
    ):
        chart_experiment.touch_shares([path])


@pytest.mark.slow
@pytest.mark.thorough  # a whole study
def test_the_whole_of_it_and_again_from_what_was_kept(tmp_path: Path):
    """A small chart end to end. Real sweeps that were not asked for are left out.

    A second run takes the cached results and gives the same accuracies.
    """
    cases = {
        "lopo": StudyCase(("sim:T-REAL:1001:1",), "leave:position", ("position<=2",)),
        "force": chart_experiment.STUDY.cases["force"],
        chart_experiment.TRAIN: StudyCase(("sim:T-REAL:1001:2",)),
        chart_experiment.STRESS: StudyCase(("sim:T-LAB:1002:1",)),
    }
    study = Study("chart", cases, ("L-gauss", "nobody"), ("H-knn",))
    where = Where(1, "", tmp_path / "cache")
    found = []
    for one in (where, replace(where, kept=True)):
        run = StudyRun(one, lambda line: None, quick=True)
        found.append(chart_experiment.results(study, run))
        assert run.left_out.keys() == {"nobody", "force"}
    ((first,), (again,)) = found
    assert first["accuracy"] == again["accuracy"]
    assert {"lopo", "stress", "stress:none"} <= first["accuracy"].keys()
    assert set(KEYS) | {"commit", "machine", "seeds"} <= first.keys()


# written files


def test_the_files(tmp_path: Path):
    """chart.json is a list of dots. Picture and page name them. A quick run is marked."""
    quick = [one | {"quick": True} for one in DOTS]
    page = published("chart", quick, tmp_path)
    assert json.loads((page.parent / "chart.json").read_text()) == quick
    text = page.read_text()
    assert "quick run" in text
    assert "quick run" not in chart_page.render(DOTS)[0]
    assert not re.search(
        r'(src|href)="(?!#|chart\.json|data:text/csv|\.\./)|https?://(?!www\.w3\.org)|@import|'
        r"url\((?!#)",
        text,
    )
    assert "{{" not in text


def test_what_the_box_answers_stands_beside_what_networks_name(tmp_path: Path):
    """The page reads it from the results of `alignment`. Missing or older results are not
    mentioned.
    """
    share = [0.88, 0.85, 0.91]
    point = {
        "n": 432,
        "attachments": 36,
        "accuracy": share,
        "wrong_share": [0.04, 0.02, 0.07],
        "network": [0.93, 0.9, 0.95],
    }
    file = tmp_path / "data" / "alignment.json"
    assert "the box also answers" not in published("chart", DOTS, tmp_path).read_text().lower()
    for text in (json.dumps({"T-HARD": {"accuracy": share}}), json.dumps({"rows": point})):
        file.write_text(text)
        assert pages.box_on_hard(file.parent) is None
    file.write_text(json.dumps({"T-HARD": point}))
    page = " ".join(published("chart", DOTS, tmp_path).read_text().split())
    for told in ("432 sweeps of T-HARD at 36 attachments", "88.0", "4.0", "93.0"):
        assert told in page


def test_no_name_can_break_out_of_the_data():
    """A label that looks like the end of a script stays text."""
    odd = [dot("</script><b>", "float", 1.0, 0.5)]
    text = chart_page.html(odd, "")
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert json.loads(data[1])["dots"][0]["method"] == "</script><b>"


def test_the_picture_is_whole_and_names_do_not_collide():
    """The picture is well-formed, equal in two runs, and in roles of colour.

    No two names overlap. The project's networks are named by their weights.
    """
    svg = scatter.chart(DOTS, ("speed", "lopo"))
    assert svg == scatter.chart(DOTS, ("speed", "lopo"))
    texts = list(ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text"))
    words = [node.text for node in texts]
    assert {
        "2.0 k",
        "Palpate, all views",
        "MiniRocket",
        "Named rightly: a speed it never felt",
        "100 %",
        "guessing: 14.3 %",
    } <= set(words)
    assert {
        "Palpate, all views: 95.0 % in 0.04 ms",
        "best peer, MiniRocket: 96.0 % in 9 ms",
    } <= set(words)
    assert "var(--accent" in svg
    crowd = [
        dot(f"method-{i}", "float", 1 + i / 50, 0.9 + i / 1000, family="L and H") for i in range(12)
    ]
    texts = ElementTree.fromstring(scatter.chart([*crowd, *DOTS])).iter(
        "{http://www.w3.org/2000/svg}text"
    )
    boxes = [box(node) for node in texts if (node.text or "").startswith("method-")]
    assert 2 <= len(boxes) < 12  # there is no room for the others
    for i, a in enumerate(boxes):
        assert not any(
            a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for b in boxes[:i]
        )


def box(node: ElementTree.Element) -> tuple[float, float, float, float]:
    """Approximate box of a text."""
    x, y, width = float(node.get("x", 0)), float(node.get("y", 0)), 5.0 * len(node.text or "")
    side = re.search(r"text-anchor: (\w+)", node.get("style", ""))
    left = x - {"start": 0, "middle": width / 2, "end": width}[side[1] if side else "start"]
    return left, y - 8, left + width, y


def test_the_front_of_the_picture_is_dark_and_the_rest_grey():
    """The project's networks have the accent colour. Others are dark on the front and grey behind
    it.
    """
    spots = pareto.placed(DOTS, "ms_p50", "speed")
    shown = {pareto.name(spot.dot): scatter.colour(spot) for spot in spots}
    assert shown == {
        "compact-1k int8": scatter.ACCENT,
        "default int8": scatter.ACCENT,
        "L-gauss float": scatter.GREY,
        "H-svm float": scatter.GREY,
        "minirocket float in aeon": scatter.BLACK,
    }


def test_methods_have_names_for_people():
    """The project's networks are named by their trained weights, which the command's name only
    limits.

    A method without a name for people keeps its own.
    """
    assert method_names.plain_name("compact-100k", 28638) == "Palpate, 29 k weights"
    assert method_names.plain_name("compact-1k", 2248) == "Palpate, 2.2 k weights"
    assert method_names.plain_name("compact-50k") == "Palpate, trained layers alone"
    assert method_names.plain_name("recurrent") == "recurrent"
    assert method_names.about("compact")
    assert not method_names.about("recurrent")
    assert method_names.NAMES.keys() <= methods.every().keys()
    assert {method_names.family(name) for name in (*chart_experiment.OURS, "nobody")} == {
        "Palpate",
        "related work",
    }


def test_an_older_chart_says_so_first():
    """A chart from before the packaged recipe says so first, with a link to today's chart."""
    old = [one | {"method": "compact"} if one["method"] == "palpate" else one for one in DOTS]
    text = chart_page.html(old, "")
    said, note = re.search(
        r"</h1>\s*<p[^>]*>(.*?)</p>\s*<p class=\"note\">(.*?)</p>", text, re.S
    ).groups()
    assert "Made without the default that the box ships now" in said
    assert '<a href="../development/chart.html">' in note
    today = chart_page.html([one | {"shipped": score.shipped()} for one in DOTS], "")
    assert "Made without the default" not in today
    assert "../development/chart.html" not in today


def test_what_fell_short_stands_beside_what_did_not():
    """Each protocol has a line: the project's accuracy, the best peer, the difference with its
    interval and a verdict in words.
    """
    text = PageReader(chart_page.html(DOTS, "")).text.replace("\N{NO-BREAK SPACE}", " ")
    assert (
        "a speed it never felt within a point −1.0 [−3.8, +1.8] 95.0 % 93.0 – 97.0 % 96.0 % 94.0 "
        "– 98.0 % MiniRocket" in text
    )
    assert (
        "(simulated) falls short −3.0 [−5.8, −0.2] 93.0 % 91.0 – 95.0 % 96.0 % 94.0 – 98.0 % H, SVM"
        in text
    )


@pytest.mark.parametrize(
    ("gap", "words"),
    [
        ((0.05, 0.01, 0.09), "ahead"),
        ((0.05, -0.01, 0.1), "ahead, not certain"),
        ((0.0, -0.1, 0.1), "level"),
        ((-0.01, -0.1, 0.05), "within a point"),
        ((-0.0101, -0.1, 0.05), "falls short, not certain"),
        ((-0.05, -0.09, -0.01), "falls short"),
    ],
)
def test_a_difference_in_words(gap: tuple[float, float, float], words: str):
    """A difference is not certain if its interval contains 0. A point below is still near."""
    assert comparison.verdict(gap) == words

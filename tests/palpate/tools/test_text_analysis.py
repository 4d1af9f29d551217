"""The form of lines of text is found, and what no profile can describe is explained."""

from __future__ import annotations

import functools
import json
import operator
from collections.abc import Callable

import numpy as np
import pytest

from palpate.tools import skin_new
from palpate.tools.stream_analysis import Read, obstacle

Line = Callable[[int, list[int]], str]


def _rows(x: list[int]) -> list[list[int]]:
    return [x[i : i + 4] for i in range(0, 16, 4)]


def _sentence(i: int, x: list[int]) -> str:
    body = "SKIN," + ",".join(map(str, x))
    return f"${body}*{functools.reduce(operator.xor, body.encode(), 0):02X}\r\n"


FORMS: dict[str, tuple[Line, dict, int]] = {
    "time": (
        lambda i, x: f"{5000 + 10 * i}," + ",".join(map(str, x)) + "\n",
        {"skip_columns": [0]},
        1,
    ),
    "count behind": (lambda i, x: ",".join(map(str, x)) + f",{i}\n", {"skip_columns": [16]}, 1),
    "seconds": (
        lambda i, x: f"{i // 20}\t" + "\t".join(map(str, x)) + "\r\n",
        {"skip_columns": [0]},
        1,
    ),
    "list": (lambda i, x: f"{x}\n", {}, 1),
    "labels": (
        lambda i, x: "\t".join(f"S{k}:{v}" for k, v in enumerate(x)) + "\n",
        {"around": "S#:" * 16},
        1,
    ),
    "json": (
        lambda i, x: json.dumps({"t": 10 * i, "v": _rows(x)}) + "\n",
        {"around": '"t":"v":', "skip_columns": [0]},
        1,
    ),
    "sentence": (_sentence, {"around": "$SKIN"}, 1),
    "decimal commas": (
        lambda i, x: ";".join(f"{v / 10:.1f}".replace(".", ",") for v in x) + "\n",
        {"decimal": ","},
        1,
    ),
    "carriage returns": (lambda i, x: " ".join(map(str, x)) + "\r", {"line_end": "\r"}, 1),
    "rows": (lambda i, x: "".join(f"{row}\n" for row in _rows(x)) + "\n", {}, 4),
    "numbered rows": (
        lambda i, x: "".join(f"{k} {row}\n" for k, row in enumerate(_rows(x))) + "---\n",
        {"skip_columns": [0]},
        4,
    ),
    "frame headers": (lambda i, x: f"Frame {i}\n" + "".join(f"{r}\n" for r in _rows(x)), {}, 4),
    "printed array": (lambda i, x: f"{np.array(_rows(x))}\n", {}, 4),
}


def sent(line: Line, n: int = 120) -> list[Read]:
    """A skin of 16 taxels that is touched now and then, at 100 Hz."""
    rng = np.random.default_rng(5)
    frames = rng.uniform(100, 140, 16) + rng.normal(0, 2, (n, 16))
    frames[n // 3 : n // 2, :6] += 300
    data = "".join(line(i, [int(v) for v in frame]) for i, frame in enumerate(frames)).encode()
    pieces = [data[i : i + 150] for i in range(0, len(data), 150)]
    return [Read(round(i * (n - 1) * 1e7 / (len(pieces) - 1)), one) for i, one in enumerate(pieces)]


@pytest.mark.parametrize("name", FORMS)
def test_a_form_is_proposed_with_the_keys_that_read_it(name: str) -> None:
    """Sixteen numbers of the widest type; time, count and row numbers are left out. Only proposals
    whose profile reads the frames are made."""
    line, keys, lines = FORMS[name]
    best = skin_new.proposals(sent(line))[0]
    assert (best.framing, best.values, best.dtype) == ("text", 16, "float32")
    assert (best.length, dict(best.keys)) == (lines, keys)
    assert best.rate_hz == pytest.approx(100, rel=0.1)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (lambda i, x: " ".join(f"{v:03X}" for v in x) + "\n", "stands between the numbers"),
        (lambda i, x: f"{'abcdefg'[i % 7]} {x}\n", "stands between the numbers"),
        (lambda i, x: " ".join(map(str, x[: 1 + i % 7])) + "\n", "its lines have"),
    ],
)
def test_text_without_a_form_is_explained(line: Line, why: str) -> None:
    """Hexadecimal, changing words, lines of any length: no proposal, and what stands in the way is
    shown with a line."""
    heard = sent(line)
    assert skin_new.proposals(heard) == []
    assert why in obstacle(heard)

"""The table of the bench's figures in the specifications. No other text repeats its figures."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from palpate_studies import bench_table
from palpate_train.metrics import score
from tests.factories.paths import ROOT

BEGIN, END = "<!-- bench -->", "<!-- /bench -->"
FIGURES = ROOT / "docs" / "data" / "bench.json"
DOCUMENTS = [ROOT / "README.md", ROOT / "docs" / "reference" / "specifications.md"]
MEASURED = {
    "inference": r"\binference\b[^\n]{0,80}?\d ?(ms|µs)\b",
    "latency": r"\b(last frame|sentence at the port)\b[^\n]{0,80}?\d ?ms\b",
    "memory": r"\d ?MiB\b",
    "processor share": r"\d ?% of (a|one) core\b",
    "start": r"\b(start|process)\b[^.\n]*\bREADY\b[^\n]{0,80}?\d s\b",
    "accuracy": r"\b\d+ of 60\b|\b60 simulated sweeps\b",
}
"""Patterns for figures of the bench in running text, with any value."""


@pytest.fixture
def figures() -> dict[str, Any]:
    """The figures in docs/data/bench.json."""
    return json.loads(FIGURES.read_bytes())


def running_text(path: Path) -> str:
    """The document without its table and without code, indented or fenced."""
    text = path.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    text = re.sub(r"^```.*?^```", "", before + after, flags=re.S | re.M)
    return re.sub(r"^ {4}.*$", "", text, flags=re.M)


def named(text: str, figures: dict[str, Any]) -> list[str]:
    """The figures of the bench that a text repeats, found by their names and by their printed
    values.
    """
    found = [match[0] for pattern in MEASURED.values() for match in re.finditer(pattern, text)]
    values = set(re.findall(r"[\d.]+ (?:ms|MiB|kB|s)\b|\d+\.\d %", bench_table.table(figures)))
    shown = {
        value for value in values if len(re.sub(r"\D", "", value)) > 2
    }  # 1.0 ms may be another figure
    return found + [value for value in shown if re.search(rf"(?<![\d.]){re.escape(value)}", text)]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_no_figure_of_the_bench_elsewhere(path: Path, figures: dict[str, Any]):
    """Running text and other tables contain neither its values nor other values of the same
    figures.
    """
    assert named(running_text(path), figures) == []


@pytest.mark.parametrize(
    "text",
    [
        "inference takes .18 ms",
        "the processor is busy to 2.7 % of a core",
        "| inference, packaged bundle, int8 | 0.18 ms | 4.3 ms |",
        "from the start of the process to READY .6 s",
        "| start of the process to READY | 0.6 s; worst of seven 0.7 s |",
        "| memory after 1,000 sweeps | 64 MiB |",
        "58 of 60 sweeps are named rightly",
        "from the last frame to the sentence 1.6 ms pass until RES is there",
    ],
)
def test_a_figure_in_running_text_would_be_found(text: str, figures: dict[str, Any]):
    """Two pages contradicted each other in each of these sentences once."""
    assert named(text, figures)


def test_a_value_of_the_table_would_be_found(figures: dict[str, Any]):
    """It is found by its value alone, among words that no pattern knows."""
    value = f"{figures['edge_to_sentence_ms']['p99']:.2f} ms"
    assert named(f"the robot has it after {value}, mostly", figures) == [value]


def test_figures_of_an_older_bundle_say_so_first(figures: dict[str, Any]):
    """The note stands before the caption. Figures of the packaged bundle begin with the caption."""
    figures["bundle"] = score.shipped()
    assert bench_table.table(figures).startswith("Measured by `make bench` with the simulated skin")
    figures["bundle"] = "0badbead"
    first, _, rest = bench_table.table(figures).partition("\n\n")
    assert (
        first == "**Made with an older default, bundle 0badbead; "
        f"the box ships bundle {score.shipped()} now.**"
    )
    assert rest.startswith("Measured by")


def test_the_table_has_a_row_for_each_figure(figures: dict[str, Any]):
    """Figures are in percent or have units. The accuracy says that it is simulated, of how many
    sweeps, and with which interval.
    """
    text = bench_table.table(figures)
    right, n = figures["accuracy"]["right"], figures["accuracy"]["total"]
    assert re.search(
        rf"simulated.*n = {n}, with 95 % interval.*\| {right} of {n}: \d+\.\d % \[\d+\.\d, "
        r"\d+\.\d\] \|",
        text,
    )
    for words, value in (
        ("last frame", r"median [\d.]+ ms, 99 % within [\d.]+ ms \(n = 60\)"),
        ("STOP edge", r"median [\d.]+ ms"),
        (r"packaged bundle \(int8\)", r"median [\d.]+ ms"),
        ("float32", r"median [\d.]+ ms"),
        ("paper's network", r"median [\d.]+ ms"),
        ("resident memory", r"[\d.]+ MiB; [+-][\d.]+ MiB"),
        ("one core", r"[\d.]+ %"),
        ("READY", r"median [\d.]+ s, longest [\d.]+ s"),
        ("size of the packaged bundle", r"[\d.]+ kB, of it the network [\d.]+ kB"),
    ):
        assert re.search(rf"^\| [^|]*{words}[^|]* \| {value}", text, flags=re.M), words


def test_memory_without_the_simulated_board_has_its_row(figures: dict[str, Any]):
    """Its row follows the row of the memory with the board, if the bench has measured it."""
    figures["rss_mb"] |= {"after_1000": 56.64, "without_board": 56.21}
    rows = bench_table.table(figures).splitlines()
    (at,) = (
        i for i, row in enumerate(rows) if row.startswith("| resident memory after 1,000 sweeps")
    )
    assert rows[at + 1] == "| of it without the simulated readout board | 56.2 MiB |"

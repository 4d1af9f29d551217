"""The one table of the box's figures: README and manual show docs/bench.json, and name none of its figures
elsewhere."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest

from appliance.core.errors import FormatError
from tests.factories.paths import ROOT
from train.cli.main import main
from train.reports import bench_table

BEGIN, END = "<!-- bench -->", "<!-- /bench -->"
FIGURES = ROOT / "docs" / "bench.json"
DOCUMENTS = [ROOT / "README.md", ROOT / "docs" / "manual.md"]
MEASURED = {
    "inference": r"\binference\b[^\n]{0,80}?\d ?(ms|µs)\b",
    "latency": r"\b(last frame|sentence at the port)\b[^\n]{0,80}?\d ?ms\b",
    "memory": r"\d ?MiB\b",
    "processor share": r"\d ?% of (a|one) core\b",
    "start": r"\b(start|process)\b[^.\n]*\bREADY\b[^\n]{0,80}?\d s\b",
    "accuracy": r"\b\d+ of 60\b|\b60 simulated sweeps\b",
}
"""How running text would name a figure of the bench, whatever its value."""


@pytest.fixture
def figures() -> dict[str, Any]:
    """Those of docs/bench.json."""
    return json.loads(FIGURES.read_bytes())


def running_text(path: Path) -> str:
    """The document without its table, and without what is indented or fenced as code."""
    text = path.read_text(encoding="utf-8")
    begin, end = text.index(BEGIN), text.index(END)
    text = re.sub(r"^```.*?^```", "", text[:begin] + text[end:], flags=re.S | re.M)
    return re.sub(r"^ {4}.*$", "", text, flags=re.M)


def named(text: str, figures: dict[str, Any]) -> list[str]:
    """The figures of the bench that a text names: by what they measure, and by their values as the table prints
    them."""
    found = [match[0] for pattern in MEASURED.values() for match in re.finditer(pattern, text)]
    values = set(re.findall(r"[\d.]+ (?:ms|MiB|kB|s)\b|\d+\.\d %", bench_table.table(figures)))
    shown = {value for value in values if len(re.sub(r"\D", "", value)) > 2}  # of 1.0 ms there may be others
    return found + [value for value in shown if re.search(rf"(?<![\d.]){re.escape(value)}", text)]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documents_show_the_figures_of_the_bench(path: Path, figures: dict[str, Any]):
    """What stands between the markers is the table of docs/bench.json, to the letter (`make bench` writes both)."""
    text = path.read_text(encoding="utf-8")
    assert text == bench_table.insert(text, figures, path.name)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_no_figure_of_the_bench_elsewhere(path: Path, figures: dict[str, Any]):
    """Running text and other tables have neither its values nor others for the same things."""
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
    """Each of those that README and manual once contradicted each other in."""
    assert named(text, figures)


def test_a_value_of_the_table_would_be_found(figures: dict[str, Any]):
    """By its value alone, in words that no pattern knows."""
    value = f"{figures['edge_to_sentence_ms']['p99']:.2f} ms"
    assert named(f"the robot has it after {value}, mostly", figures) == [value]


def test_the_command_writes_the_table_and_nothing_else(tmp_path: Path, figures: dict[str, Any]):
    """Text before and after the markers stays; a second run changes nothing; a changed figure changes the document."""
    document, file = tmp_path / "a.md", tmp_path / "bench.json"
    document.write_text(f"before\n\n{BEGIN}\nold\n{END}\n\nafter\n")
    file.write_text(json.dumps(figures))
    assert main(["bench-table", str(file), str(document)]) == 0
    written = document.read_text()
    assert written.startswith(f"before\n\n{BEGIN}\nMeasured by `make bench` with the simulated skin")
    assert written.endswith(f" |\n{END}\n\nafter\n")
    assert "old" not in written
    assert main(["bench-table", str(file), str(document)]) == 0
    assert document.read_text() == written
    changed = copy.deepcopy(figures)
    changed["rss_mb"]["after_1000"] += 1
    assert bench_table.insert(written, changed, "a.md") != written


def test_the_table_has_a_row_for_each_figure(figures: dict[str, Any]):
    """In percent and with units; the accuracy says that it is simulated, of how many sweeps, and its interval."""
    text = bench_table.table(figures)
    right, n = figures["accuracy"]["right"], figures["accuracy"]["total"]
    assert re.search(
        rf"simulated.*n = {n}, with 95 % interval.*\| {right} of {n}: \d+\.\d % \[\d+\.\d, \d+\.\d\] \|", text
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
    """Behind the memory with it, in figures of a bench that has measured it."""
    figures["rss_mb"] |= {"after_1000": 56.64, "without_board": 56.21}
    rows = bench_table.table(figures).splitlines()
    (at,) = (i for i, row in enumerate(rows) if row.startswith("| resident memory after 1,000 sweeps"))
    assert rows[at + 1] == "| of it without the simulated readout board | 56.2 MiB |"


@pytest.mark.parametrize("text", ["", BEGIN, f"{END}{BEGIN}", f"{BEGIN}{END}{BEGIN}{END}"])
def test_a_document_without_one_pair_of_markers_is_named(text: str, figures: dict[str, Any]):
    """FormatError with the document's name and what to do."""
    with pytest.raises(FormatError, match=r"a\.md has not one pair of markers"):
        bench_table.insert(text, figures, "a.md")


@pytest.mark.parametrize("content", [b"", b"[]", b'{"accuracy": {}}'])
def test_figures_that_are_not_those_of_a_bench_are_named(tmp_path: Path, content: bytes):
    """FormatError with the file and the command that writes it."""
    (tmp_path / "b.json").write_bytes(content)
    with pytest.raises(FormatError, match="run `make bench`"):
        bench_table.read(tmp_path / "b.json")

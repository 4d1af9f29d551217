"""The study `rules`: the packaged bundle without each of its rules, on few sweeps."""

import json
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate_studies import rules_study, tables
from palpate_studies.__main__ import main
from palpate_train.answer import rules
from palpate_train.data import sets
from palpate_train.export import trial
from tests.factories.paths import ROOT

pytestmark = pytest.mark.slow  # the fixture answers each sweep without each rule
SLIDES, MOVED = "sim:T-REAL/level-blind:101:1", "sim:T-HARD/level-blind:101:1"


@pytest.fixture(scope="module")
def few() -> dict[tuple[str, ...], dict]:
    """The rows of a run on twelve slides, by what is left out."""
    tested = sets.load(SLIDES)
    tested = tested.take([i for i in range(len(tested)) if i % 9 in (0, 4)])
    moved = sets.load(MOVED)
    given = tested, moved.take([*range(0, len(moved), 9)]), 6, lambda line: None
    found = rules_study.results(bundle.load(bundle.DEFAULT), *given)["rows"]
    return {tuple(row["without"]): row for row in found}


def test_each_rule_is_left_out_alone_and_in_pairs(few: dict[tuple[str, ...], dict]):
    """All rows answer the same sweeps."""
    there = rules.present(bundle.load(bundle.DEFAULT))
    pairs = [pair for pair in rules_study.PAIRS if set(pair) <= set(there)]
    assert list(few) == [(), *((name,) for name in there), *pairs]
    (total,) = {json.dumps(row["total"]) for row in few.values()}
    assert json.loads(total)["slides"] == 6
    for row in few.values():
        for kind, n in row["total"].items():
            assert 0 <= row["right"][kind] + row["wrong"][kind] <= n
        assert row["right"][trial.NONE] == 0 < row["ms"]


def test_what_a_rule_is_for_is_seen_without_it(few: dict[tuple[str, ...], dict]):
    """Broken taxels are refused without bridging; junk gets labels without a pattern."""
    every = few[()]
    assert few["taxels",]["right"]["altered"] < every["right"]["altered"]
    assert few["slide",]["wrong"]["junk"] > every["wrong"]["junk"]
    assert few["early",]["right"] == every["right"]


def test_the_table_has_each_row(few: dict[tuple[str, ...], dict]):
    """Its first row is that of all rules."""
    lines = tables.rules({"bundle": "abc", "rows": list(few.values())}).strip().splitlines()
    rows = [line.split("|")[1].strip() for line in lines if line.startswith("|")][2:]
    assert rows[0] == "(every rule)"
    assert rows[1:] == [" and ".join(names) for names in list(few)[1:]]


def test_the_command_writes_its_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """With slides of other places as displaced ones."""
    out = tmp_path / "rules.json"
    for name, value in {"STRESSED": SLIDES, "MOVED": MOVED, "EACH": 1}.items():
        monkeypatch.setattr(f"palpate_studies.commands.measure.{name}", value)
    assert main(["rules", "--out", str(out)]) == 0
    found = json.loads(out.read_bytes())
    assert found["sets"] == [SLIDES, MOVED]
    assert found["rows"][0]["total"]["displaced"] == 7
    assert "| hum |" in capsys.readouterr().out


def test_each_rule_says_what_it_buys():
    """The text of its module has the counts of docs/data/rules.json."""
    rows = {
        tuple(row["without"]): row
        for row in json.loads((ROOT / "docs/data/rules.json").read_text())["rows"]
    }
    texts = " ".join(
        " ".join(path.read_text().split())
        for path in (ROOT / "appliance/palpate/answer").glob("*.py")
    )
    whole = rows[()]
    alone = {names[0]: row for names, row in rows.items() if len(names) == 1}
    # early answers are none of whole sweeps
    for name, without in ((n, row) for n, row in alone.items() if n != "early"):
        said = [
            f"{without[how][of]} instead of {whole[how][of]} of {whole['total'][of]} {words}"
            for how, of, words in (
                ("right", "altered", "altered slides right"),
                ("right", "displaced", "displaced ones"),
                ("wrong", "junk", "junk windows named"),
            )
        ]
        assert f"Without {name}: {', '.join(said)};" in texts

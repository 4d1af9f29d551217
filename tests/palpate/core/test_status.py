"""The table of statuses, and whatever else says something about a status."""

from __future__ import annotations

import json
import re

import pytest

from palpate.bridges.modbus import STATUS_CODES
from palpate.client.answers import Answer
from palpate.core.status import ASIDE, DETAILS, HALT, REASONS, USE, WORDS, Reason, Remark, Status
from palpate.web.server import page_files
from tests.factories.paths import ROOT


def test_all_that_is_said_of_a_status_is_of_the_table():
    """PROTOCOL.md, page, Modbus, card: each status, in order; all except `ok` have words."""
    protocol = (ROOT / "firmware_config" / "PROTOCOL.md").read_text()
    listed = protocol.split("| status | meaning")[1].split("\n\n")[0]
    assert re.findall(r"(?m)^\| `([a-z-]+)` \|", listed) == [*Status]
    page = (ROOT / "docs" / "reference" / "statuses.md").read_text()
    rows = re.findall(r"(?m)^\| `([a-z-]+)` \| (\d+) \| ([^|]*) \| [^|]+ \| [^|]+ \|$", page)
    assert rows == [(s, str(w.code), w.robot) for s, w in WORDS.items()]
    assert {s: w.code for s, w in WORDS.items()} == STATUS_CODES
    _, script = page_files()["/statuses.js"]
    shown = json.loads(script.decode().removeprefix("export const STATUSES = ").rstrip(";\n"))
    assert shown == {s: [w.colour, w.word, w.advice] for s, w in WORDS.items()}
    assert set(DETAILS) == set(Reason)
    remark = Remark(Reason.UNLIKE_ALL, {"distance": 41.25, "label": "wood", "limit": 30.0})
    assert [part in remark.text for part in ("41.25", "wood", "30")] == [True] * 3
    assert "sweep 7" in Remark(Reason.UNLIKE_ALL_AGAIN, remark.numbers | {"sweep": 7}).text
    assert set(REASONS) == {s for s in Status if not s.classified}
    assert all(w.word and w.advice for s, w in WORDS.items() if s is not Status.OK)
    assert [s for s, w in WORDS.items() if w.robot == USE] == [Status.OK]
    assert all(w.colour == "bad" for w in WORDS.values() if w.robot == HALT)


@pytest.mark.parametrize("status", Status)
def test_a_client_hears_what_to_do(status):
    """A robot's program gets a text for each status, with the detail of the box."""
    fields = ["1", "0", status, "wood", "0.5", "0.1", "1", "0", "1", "b", "sim", "1", "taxel 2.3"]
    text = Answer.of(fields).what_to_do
    assert text.endswith("(taxel 2.3)")
    assert (ASIDE in text) == (status is Status.UNDECIDED)

"""The client's view of the box's sentences, written by the code of the box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.client.answers import Answer, BoxIdentity, BoxState
from palpate.core import sentences
from palpate.core.errors import FormatError
from palpate.core.status import Status
from palpate.core.types import Verdict
from palpate.io.robot_link import result
from tests.factories import speaking_box


def verdict(status: Status = Status.OK, detail: str = "", **more: object) -> Verdict:
    """A verdict with this status."""
    label = "wood" if status.classified else ""
    counts = (np.array([0.9]), 2, 1, 1_250_000)
    made = Verdict(7, 10**9, status, label, 0.9, 0.8, *counts, "9f3c2a1b", detail)
    return replace(made, **more)


SLID = {"measured_mm_s": 61.04, "direction": "cols-"}


@pytest.mark.parametrize("status", list(Status))
def test_an_answer_survives_its_sentence(status):
    """All fields of RES, for each status, with its advice and the detail."""
    read = Answer.read(result(verdict(status, "moved 2.1 mm"), "usb").decode())
    label = "wood" if status.classified else ""
    assert read == Answer(
        7, 1.0, status, label, 0.9, 0.8, 2, 1, 1.25, "9f3c2a1b", "usb", 1.0, "moved 2.1 mm"
    )
    assert read.early is False
    assert Answer.read(result(verdict(status, share=0.4), "usb").decode()).early
    final = status in (Status.UNDECIDED, Status.UNKNOWN, Status.RECORDED)
    assert [read.known, read.unsure, read.faulty, final].count(True) == 1
    assert read.what_to_do.endswith(" (moved 2.1 mm)")


def test_the_answer_of_a_finger_survives_its_sentence():
    """FIN is RES after the finger; the longest is not cut early."""
    whole = sentences.read(result(verdict(detail="moved", **SLID), "usb").strip())
    fin = sentences.sentence("FIN", "left", *whole.fields)
    answer = Answer.of_finger(sentences.read(fin.strip()).fields)
    assert (answer.finger, answer.label, answer.detail) == ("left", "wood", "moved")
    assert replace(answer, finger="") == Answer.of(whole.fields)
    assert Answer.read(fin.decode()) is None
    longest = verdict(Status.UNSURE, sweep=99999, label="w" * 24, time_ns=10**14)
    whole = sentences.read(result(longest, "replay").strip())
    line = sentences.sentence("FIN", "f" * 8, *whole.fields)
    assert len(line) <= sentences.MAX_LINE
    found = Answer.of_finger(sentences.read(line.strip()).fields)
    assert (found.label, found.source, found.share) == ("w" * 24, "replay", 1.0)


@pytest.mark.parametrize("known", [True, False])
def test_optional_fields_survive_their_sentence(known):
    """14 to 16, in any combination; a reader of 14 fields does without."""
    plain = Answer.read(result(verdict(), "usb", loss_known=known).decode())
    assert (plain.loss_known, plain.measured_mm_s) == (known, None)
    line = result(verdict(detail="moved 2.1 mm", **SLID), "usb", loss_known=known).decode()
    read = Answer.read(line)
    assert (read.measured_mm_s, read.direction, read.loss_known) == (61.0, "cols-", known)
    fields = sentences.read(line.encode()).fields
    assert len(fields) == 16
    older = Answer.of(fields[:14])
    assert replace(read, measured_mm_s=None, direction="") == older
    assert older.detail == "moved 2.1 mm"


@pytest.mark.parametrize(
    ("read", "fields"),
    [
        (Answer.of, ""),
        (Answer.of, "x"),
        (Answer.of, "7,1.0,strange,wood,0.9,0.8,1,0,1,b,usb,1.00,"),
        (Answer.of, "7,1.0,ok,wood,0.9,0.8,one,0,1,b,usb,1.00,"),
        (Answer.of, "7,1.0,ok,wood,0.9,0.8,1,0,1,b,usb,1.00,,,fast,rows+"),
        (Answer.of, "7,1.0,ok,wood,nan,0.8,1,0,1,b,usb,1.00,"),
        (Answer.of, "7,1.0,ok,wood,0.9,0.8,1,0,inf,b,usb,1.00,"),
        (Answer.of, "7,1.0,ok,wood,0.9,0.8,1,0,1,b,usb,1.00,,,nan,rows+"),
        (Answer.of_finger, "left"),
        (BoxState.of, "1,streaming"),
        (BoxIdentity.of, "mine,2"),
    ],
)
def test_a_sentence_of_another_form_is_named(read, fields):
    """Too few fields, an unknown status, a word or NaN for a number."""
    with pytest.raises(FormatError, match="older") as e:
        read(fields.split(","))
    assert fields.removeprefix("left") in str(e.value)


def test_a_damaged_line_is_no_answer():
    """A wrong checksum, none at all, half a line."""
    line = result(verdict(), "usb").decode()
    for text in (line.replace("wood", "wo0d"), line.partition("*")[0], line[:20]):
        assert Answer.read(text) is None


@pytest.mark.parametrize(
    ("skin", "sweeping", "ready"),
    [("streaming", 0, True), ("streaming", 1, False), ("lost", 0, False)],
)
def test_the_state_is_read_with_all_counts(skin, sweeping, ready):
    """STA as the box sends it; ready if the skin streams and no sweep is open."""
    line = speaking_box.state(skin, answered=3, sweeping=sweeping)
    read = BoxState.of(sentences.read(line).fields)
    assert (read.skin, read.ready, read.answered) == (skin, ready, 3)
    assert (read.frames, read.bundle) == (3000, "9f3c2a1b")


@pytest.mark.parametrize(
    ("last", "degraded"), [((), ""), ((1,), ""), ((1, "silent row 2"), "silent row 2")]
)
def test_a_state_names_broken_taxels(last, degraded):
    """Field 19 of STA; in a long line names are cut or left out, no count is."""
    fields = ("1.000", "streaming", 0, 1, 2, 3, 4, 5, 6, "9f3c2a1b", "usb", *[0] * 6)
    line = sentences.read(sentences.sentence("STA", *fields, *last))
    assert BoxState.of(line.fields).degraded == degraded
    long = (*fields[:3], *[9_999_999] * 4, *fields[7:11], *[88_888] * 6, "")
    cut = sentences.read(sentences.sentence("STA", *long, "silent taxel " + "2.3 " * 30))
    assert cut.fields[:18] == [str(field) for field in long]
    assert BoxState.of(cut.fields).degraded.startswith("silent")
    more = (*long[:11], *[888_888_888] * 6, "")
    whole = sentences.read(sentences.sentence("STA", *more, "silent taxel 2.3"))
    assert set(whole.fields[11:]) == {"888888888"}

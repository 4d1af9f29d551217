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


def verdict(status: Status, detail: str = "", share: float = 1.0) -> Verdict:
    """A verdict with this status."""
    label = "wood" if status.classified else ""
    return Verdict(
        7,
        10**9,
        status,
        label,
        0.9,
        0.8,
        np.array([0.9]),
        2,
        1,
        1_250_000,
        "9f3c2a1b",
        detail,
        share,
    )


@pytest.mark.parametrize("status", list(Status))
def test_an_answer_survives_its_sentence(status: Status):
    """All fields of RES, for each status."""
    read = Answer.read(result(verdict(status, "moved 2.1 mm"), "usb").decode())
    label = "wood" if status.classified else ""
    assert read.early is False
    assert Answer.read(result(verdict(status, share=0.4), "usb").decode()).early
    assert read == Answer(
        7, 1.0, status, label, 0.9, 0.8, 2, 1, 1.25, "9f3c2a1b", "usb", 1.0, "moved 2.1 mm"
    )


def test_the_answer_of_a_finger_survives_its_sentence():
    """FIN is RES with the finger in front of its fields; `read` takes RES alone."""
    of = replace(verdict(Status.OK, "moved"), measured_mm_s=30.5, direction="rows+")
    whole = sentences.read(result(of, "usb").strip())
    fin = sentences.sentence("FIN", "left", *whole.fields)
    answer = Answer.of_finger(sentences.read(fin.strip()).fields)
    assert (answer.finger, answer.label, answer.detail) == ("left", "wood", "moved")
    assert (answer.measured_mm_s, answer.direction) == (30.5, "rows+")
    assert replace(answer, finger="") == Answer.of(whole.fields)
    assert Answer.read(fin.decode()) is None
    with pytest.raises(FormatError, match="RES"):
        Answer.of_finger(["left"])


def test_a_finger_with_the_longest_name_keeps_all_its_fields():
    """A label of 24 characters, a name of 8: the sentence is not cut before the detail."""
    longest = replace(verdict(Status.UNSURE), sweep=99999, label="w" * 24, time_ns=10**14)
    whole = sentences.read(result(longest, "replay").strip())
    line = sentences.sentence("FIN", "f" * 8, *whole.fields)
    assert len(line) <= sentences.MAX_LINE
    found = Answer.of_finger(sentences.read(line.strip()).fields)
    assert (found.label, found.source, found.share) == ("w" * 24, "replay", 1.0)


def test_a_field_more_is_the_loss_that_cannot_be_seen():
    """RES with field 14: the loss is unknown; without it the loss is known."""
    lines = [
        result(verdict(Status.OK), "usb", loss_known=known).decode() for known in (True, False)
    ]
    assert [Answer.read(line).loss_known for line in lines] == [True, False]


@pytest.mark.parametrize("known", [True, False])
def test_a_measured_slide_survives_its_sentence(known: bool):
    """Speed and direction in fields 15 and 16, whether field 14 is empty or not. A reader of 14
    fields finds the same answer without them."""
    slid = replace(verdict(Status.OK, "moved 2.1 mm"), measured_mm_s=61.04, direction="cols-")
    line = result(slid, "usb", loss_known=known).decode()
    read = Answer.read(line)
    assert read
    assert (read.measured_mm_s, read.direction, read.loss_known) == (61.0, "cols-", known)
    fields = sentences.read(line.encode()).fields
    assert len(fields) == 16
    older = Answer.of(fields[:14])
    assert replace(read, measured_mm_s=None, direction="") == older
    assert older.detail == "moved 2.1 mm"


def test_a_measured_speed_of_another_form_is_named():
    """A word for the speed."""
    line = result(replace(verdict(Status.OK), measured_mm_s=30.0, direction="rows+"), "usb")
    fields = sentences.read(line).fields
    with pytest.raises(FormatError, match="older than"):
        Answer.of([*fields[:14], "fast", "rows+"])


@pytest.mark.parametrize("status", list(Status))
def test_each_status_is_one_kind(status: Status):
    """A status is known, unsure, faulty, or final without a label to use, and each has its
    advice."""
    answer = Answer.read(result(verdict(status), "usb").decode())
    final = status in (Status.UNDECIDED, Status.UNKNOWN, Status.RECORDED)
    assert [answer.known, answer.unsure, answer.faulty, final].count(True) == 1
    assert answer.what_to_do


def test_the_detail_stands_with_the_advice():
    """The detail of the box is kept."""
    answer = Answer.read(result(verdict(Status.STUCK_TAXEL, "taxel 2.3"), "usb").decode())
    assert answer.what_to_do.endswith("(taxel 2.3)")


@pytest.mark.parametrize(
    "fields",
    [
        "",
        "x",
        "7,1.0,strange,wood,0.9,0.8,1,0,1,b,usb,1.00,",
        "7,1.0,ok,wood,0.9,0.8,one,0,1,b,usb,1.00,",
    ],
)
def test_a_sentence_of_another_form_is_named(fields: str):
    """Too few fields, a status that is not known, a word for a number: an error that repeats
    them."""
    with pytest.raises(FormatError, match="older than"):
        Answer.of(fields.split(","))


def test_a_damaged_line_is_no_answer():
    """A wrong checksum, none at all, half a line."""
    line = result(verdict(Status.OK), "usb").decode()
    assert [
        Answer.read(text)
        for text in (line.replace("wood", "wo0d"), line.partition("*")[0], line[:20])
    ] == [None] * 3


@pytest.mark.parametrize(
    ("skin", "sweeping", "ready"),
    [("streaming", 0, True), ("streaming", 1, False), ("lost", 0, False)],
)
def test_the_state_is_read_with_all_counts(skin: str, sweeping: int, ready: bool):
    """STA as the box sends it; ready if the skin streams and no sweep is open."""
    line = speaking_box.state(skin, answered=3, sweeping=sweeping)
    read = BoxState.of(sentences.read(line).fields)
    assert (read.skin, read.ready, read.answered) == (skin, ready, 3)
    assert (read.frames, read.bundle) == (3000, "9f3c2a1b")


@pytest.mark.parametrize(
    ("kind", "fields"), [(BoxState, ["1", "streaming"]), (BoxIdentity, ["mine", "2"])]
)
def test_too_few_fields_are_named(kind: type[BoxState | BoxIdentity], fields: list[str]):
    """A state or an identity that is cut short."""
    with pytest.raises(FormatError, match="older than"):
        kind.of(fields)


@pytest.mark.parametrize(
    ("last", "degraded"), [((), ""), ((1,), ""), ((1, "silent row 2"), "silent row 2")]
)
def test_a_state_names_broken_taxels(last: tuple[object, ...], degraded: str):
    """Field 19 of STA; a box that bridges none does not send it."""
    fields = ("1.000", "streaming", 0, 1, 2, 3, 4, 5, 6, "9f3c2a1b", "usb", *[0] * 6)
    line = sentences.read(sentences.sentence("STA", *fields, *last))
    assert BoxState.of(line.fields).degraded == degraded


def test_a_long_state_loses_the_names_of_broken_taxels_first():
    """The names are cut or left out; no count is cut."""
    counts = [9_999_999] * 4
    fields = ("1.000", "streaming", 0, *counts, 5, 6, "9f3c2a1b", "usb", *[88_888] * 6, "")
    cut = sentences.read(sentences.sentence("STA", *fields, "silent taxel " + "2.3 " * 30))
    assert cut.fields[:18] == [str(field) for field in fields]
    assert BoxState.of(cut.fields).degraded.startswith("silent")
    more = (*fields[:11], *[888_888_888] * 6, "")
    whole = sentences.read(sentences.sentence("STA", *more, "silent taxel 2.3"))
    assert set(whole.fields[11:]) == {"888888888"}

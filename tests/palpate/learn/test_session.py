"""A session of teaching: its commands, the processes beside the loop, and each failure of these."""

from __future__ import annotations

import errno
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from palpate.core.clock import SystemClock
from palpate.core.config import TeachConfig
from palpate.core.disk_thread import DiskWork
from palpate.core.errors import ApplianceError, ConfigError
from palpate.core.sentences import Reply
from palpate.core.types import Status
from palpate.learn import process, session
from palpate.learn.process import TeachingProcess
from palpate.learn.session import Teacher, TeachingSession
from palpate.sim import skin
from palpate.sweeps import sweep_folder
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_folder import NOT_THIS
from tests.factories.feeds import HEALTH, OK, cut
from tests.factories.slow_disk import SlowDisk

WAIT_S = 120


def program(code: str) -> list[str]:
    """The command of a process that runs this code."""
    return [sys.executable, "-c", code]


def printed(*lines: dict[str, Any], then: str = "") -> list[str]:
    """The command of a process that prints these lines."""
    text = "".join(json.dumps(line) + "\n" for line in lines)
    return program(f"print({text!r}, end='', flush=True)\n{then}")


ASSESSED = {"type": "assessed", "text": "80 % right", "advice": "3 more of cork"}
TAUGHT = {"type": "taught", "text": "bundle 1234 is installed", "labels": ["cork", "pine"]}


class Taught:
    """A recording with its session; `learn` and `assess` are the commands of its processes."""

    def __init__(self, folder: Path, codes: int = 0, disk: DiskWork | None = None) -> None:
        self.folder, self.said, self.number = folder, [], 0
        self.learn, self.assess = printed(TAUGHT), printed(ASSESSED)
        self.recording = RecordingSession(
            *(folder / "sweeps", skin.FORMAT, Labels(), SystemClock(), self.said.append, 3),
            disk=disk,
        )
        self.session = TeachingSession(
            self.recording,
            TeachConfig(),
            lambda by: self.learn,
            lambda line: self.said.append(line.decode()),
            codes=codes,
        )

    def order(self, name: str, text: str = "") -> Reply:
        """Carry out a command."""
        return {**self.session.recording_commands, **self.session.commands}[name](text)

    def sweeps(self, material: str, count: int, status: Status = Status.RECORDED) -> None:
        """Record sweeps of a material."""
        self.order("TEACH", material)
        for _ in range(count):
            self.number += 1
            sweep = replace(cut(), id=self.number, start_ns=SystemClock().now_ns())
            verdict = replace(OK, sweep=self.number, status=status, label="", scores=np.empty(0))
            for observer in (self.recording, self.session):
                observer.sweep(sweep, verdict, {})

    def until(self, done: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Take turns until the session is in this state."""
        end = time.monotonic() + WAIT_S
        while not done(about := self.session.about()):
            assert time.monotonic() < end, about
            self.session.turn(HEALTH)
            time.sleep(0.01)
        return about


@pytest.fixture
def taught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Taught]:
    """A session whose processes are the commands above."""
    monkeypatch.setattr(session, "PAUSE_NS", 0)
    one = Taught(tmp_path)
    monkeypatch.setattr(session, "learning", lambda *_: one.assess)
    yield one
    one.session.close()
    one.recording.close()


def test_it_assesses_from_the_second_sweep_of_two_materials_on(taught):
    """Before, there is nothing to say."""
    taught.sweeps("cork", 3)
    taught.sweeps("pine", 1)
    about = taught.until(lambda about: not about["assessing"])
    assert about["learnt"] is None
    assert about["materials"] == {"cork": 3, "pine": 1}
    taught.sweeps("pine", 1)
    about = taught.until(lambda about: about["learnt"])
    assert about["learnt"]["advice"] == "3 more of cork"
    assert not about["trouble"]


def test_sweeps_without_a_fault_of_two_materials_are_needed(taught):
    """Faulty ones are stored, neither counted nor taught; one material is refused, with sweeps of
    something else beside it, too."""
    taught.sweeps("cork", 2)
    taught.sweeps("cork", 2, Status.NO_CONTACT)
    assert taught.session.materials() == {"cork": 2}
    taught.sweeps("cork", 5)
    taught.sweeps(NOT_THIS, 3)
    assert taught.session.materials() == {"cork": 7, NOT_THIS: 3}
    about = taught.until(lambda about: not about["assessing"])
    assert about["learnt"] is None
    with pytest.raises(ApplianceError, match=r"1 materials"):
        taught.order("USE")


def test_sweeps_that_were_no_slides_are_said_and_not_counted(taught):
    """At once or by the process; each once; files stay."""
    taught.assess = printed(
        ASSESSED
        | {"no_slides": [{"number": 2, "text": "sweep 2 of cork is not learnt from: rest"}]}
    )
    taught.sweeps("cork", 3)
    taught.sweeps("cork", 1, Status.NO_SLIDE)
    taught.sweeps("pine", 2)
    assert taught.session.materials() == {"cork": 3, "pine": 2}
    taught.until(lambda about: about["learnt"])
    assert taught.session.materials() == {"cork": 2, "pine": 2}
    taught.sweeps("pine", 1)
    taught.until(lambda about: not about["assessing"])
    said = [line for line in map(str, taught.said) if "TCH,refused" in line]
    assert len(said) == 2
    assert "sweep 4: no-slide*" in said[0]
    assert "refused,sweep 2 of cork" in said[1]
    assert taught.recording.about()["counts"] == [("cork", "", 2), ("pine", "", 3)]
    assert len(list((taught.folder / "sweeps").glob("*.npy"))) == 7


def test_use_makes_a_bundle_and_says_so(taught):
    """Steps are shown with the time left; the end is a sentence for a robot."""
    step = {"type": "step", "step": "heads", "done": 0.2, "left_s": 4.0}
    go = taught.folder / "go"
    wait = f"import os, time\nwhile not os.path.exists({str(go)!r}): time.sleep(.01)"
    taught.learn = printed(step, then=f"{wait}\nprint({json.dumps(TAUGHT)!r})")
    taught.sweeps("cork", 2)
    taught.sweeps("pine", 2)
    assert taught.order("USE") == [2, 4]
    about = taught.until(lambda about: (about["using"] or {}).get("step") == "heads")
    assert about["using"]["left_s"] == 4.0
    with pytest.raises(ApplianceError, match="already"):
        taught.order("USE")
    with pytest.raises(ApplianceError, match="afterwards"):
        taught.order("FORGET", "cork")
    go.touch()
    about = taught.until(lambda about: about["taught"] and not about["using"])
    assert about["taught"]["labels"] == ["cork", "pine"]
    assert any(str(line).startswith("$PPLP,TCH,taught,") for line in taught.said)


@pytest.mark.parametrize(
    ("learn", "why"),
    [
        (printed({"type": "error", "text": "the pair is too alike"}), "the pair is too alike"),
        (program("import sys; sys.exit(3)"), "the process that learns ended with 3"),
        (program("import os; os.kill(os.getpid(), 9)"), "there was not enough memory"),
        (program("print('{half a line')"), "the process that learns ended with 0"),
        (program("print('not json')\nprint('{\"type\": 3')"), "ended with 0"),
        (["/nowhere/python"], "cannot be started"),
    ],
)
def test_a_failed_process_is_said_and_changes_nothing(taught, learn, why):
    """The reason is shown, and the next attempt is possible."""
    taught.sweeps("cork", 2)
    taught.sweeps("pine", 2)
    taught.learn = learn
    if "nowhere" in learn[0]:
        with pytest.raises(ConfigError, match=why):
            taught.order("USE")
    else:
        taught.order("USE")
        assert why in taught.until(lambda about: about["trouble"])["trouble"]
    assert taught.session.materials() == {"cork": 2, "pine": 2}
    assert len(list((taught.folder / "sweeps").glob("*.npy"))) == 4
    taught.learn = printed(TAUGHT)
    taught.until(lambda about: not about["using"])
    taught.order("USE")
    taught.until(lambda about: about["taught"])


def test_an_assessment_that_cannot_start_is_said(taught):
    """The turn of the loop raises nothing."""
    taught.assess = ["/nowhere/python"]
    taught.sweeps("cork", 2)
    taught.sweeps("pine", 2)
    assert "started" in taught.until(lambda about: about["trouble"])["trouble"]


@pytest.mark.parametrize(
    ("quiet_s", "why"), [(1e6, "not done within 300 s"), (200.0, "no further for 200 s")]
)
def test_a_process_that_hangs_is_killed(quiet_s, why):
    """With a reason and its children: after its limit or without a line."""

    class HandClock(SystemClock):
        """A clock that a test sets."""

        t_ns = 0

        def now_ns(self) -> int:
            return self.t_ns

    code = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        'print(\'{"type": "step", "child": %d}\' % child.pid, flush=True)\n'
        "while True: pass"
    )
    clock = HandClock()
    one = TeachingProcess(program(code), 300.0, clock, group=True, quiet_s=quiet_s)
    news: list[dict[str, Any]] = []
    end = time.monotonic() + WAIT_S
    while not news and time.monotonic() < end:
        news += one.news()
        time.sleep(0.02)
    clock.t_ns = 290_000_000_000 if quiet_s < 300 else 301_000_000_000
    news += one.news()
    assert one.ended
    assert why in news[-1]["text"]
    status = Path(f"/proc/{news[0]['child']}/stat")
    while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize("label", ["", " ", "käse", "a,b", "x" * 25])
def test_a_label_that_cannot_be_sent_is_refused(taught, label):
    """Before any sweep of it is recorded."""
    with pytest.raises(ApplianceError, match=r"name of|cannot be"):
        taught.order("TEACH", label)
    assert taught.session.materials() == {}


def test_a_delivered_bundle_keeps_its_limits():
    """Sweeps of something else are refused beside one, and taken without."""
    with pytest.raises(ConfigError, match=NOT_THIS):
        session.refuse_trained(("oak",), [NOT_THIS])
    session.refuse_trained((), [NOT_THIS])


def test_another_spelling_of_something_else_is_no_material(taught):
    """A box that answers `ok, Not this` would mislead; neither a first sweep nor a new name."""
    taught.sweeps("cork", 1)
    for order in (("TEACH", "Not this"), ("MATERIAL", "NOT THIS"), ("RENAME", "cork,Not This")):
        with pytest.raises(ApplianceError, match="write 'not this'"):
            taught.order(*order)
    assert taught.order("TEACH", NOT_THIS) == [NOT_THIS, 0]


def test_class_bits_that_are_too_few_are_said_before_recording(tmp_path):
    """By TEACH; or at the start, until one is forgotten."""
    narrow = Taught(tmp_path, codes=4)
    for material in ("cork", "pine", "felt"):
        narrow.sweeps(material, 1)
    assert narrow.session.about()["trouble"] == ""
    with pytest.raises(ConfigError, match=r"4 labels"):
        narrow.order("TEACH", "oak")
    assert narrow.order("TEACH", "felt") == ["felt", 1]
    assert narrow.order("TEACH", NOT_THIS) == [NOT_THIS, 0]  # nothing that is sent
    assert narrow.session.materials() == {NOT_THIS: 0, "cork": 1, "pine": 1, "felt": 1}
    narrow.recording.close()
    narrower = Taught(tmp_path, codes=2)
    assert narrower.session.about()["trouble"].endswith("forget a material")
    with pytest.raises(ConfigError, match="3 labels"):
        narrower.order("USE")
    narrower.order("FORGET", "cork")
    narrower.order("FORGET", "pine")
    assert narrower.session.about()["trouble"] == ""
    narrower.recording.close()


def test_names_begin_at_the_first_place_and_fill_no_box(taught: Taught, monkeypatch):
    """Another place is the present material's; so many names wait for a first sweep."""
    places = []
    for order in (("POSITION", "1"), ("TEACH", "cork"), ("NEXT", ""), ("TEACH", "pine")):
        taught.order("TEACH", "cork")
        taught.order(*order)
        places.append(taught.recording.about()["position"])
    assert places == ["1", "1", "2", "1"]
    monkeypatch.setattr(session, "MOST_NAMED", 2)
    taught.sweeps("cork", 1)
    for name in ("felt", "pine", "felt"):
        taught.order("TEACH", name)
    with pytest.raises(ApplianceError, match="2 m"):
        taught.order("TEACH", "oak")
    taught.order("FORGET", "pine")
    assert taught.order("TEACH", "oak") == ["oak", 0]


def test_a_forgotten_material_is_gone_and_its_sweeps_stay(taught):
    """Also after a restart; recorded again, it counts from 1."""
    taught.sweeps("cork", 2)
    taught.sweeps("pine", 2)
    assert taught.order("FORGET", "cork") == ["cork", 2]
    assert taught.session.materials() == {"pine": 2}
    assert len(list((taught.folder / "sweeps").glob("*.npy"))) == 4
    taught.sweeps("cork", 1)
    assert taught.session.materials() == {"pine": 2, "cork": 1}
    with pytest.raises(ApplianceError, match="'felt'"):
        taught.order("FORGET", "felt")
    taught.recording.close()
    again = Taught(taught.folder)
    taught.recording = again.recording  # for the end of the test
    assert again.session.materials() == {"pine": 2, "cork": 1}


def test_use_does_not_overtake_what_the_disk_still_has_to_do(tmp_path):
    """Its process would read a forgotten material or a discarded sweep in the folder."""
    disk = SlowDisk()
    one = Taught(tmp_path, disk=disk)
    for material in ("cork", "pine", "felt"):
        one.sweeps(material, 2)
    disk.settle()
    for order, answer in (("FORGET", ["cork", 2]), ("DISCARD", [6, 5, "sweep-000006"])):
        reply = one.order(order, "cork" * (order == "FORGET"))
        with pytest.raises(ApplianceError, match="answer"):
            one.order("USE")
        disk.settle()
        assert reply.result(0) == answer
    assert one.order("USE") == [2, 3]
    one.session.close()
    one.recording.close()


def test_sweeps_that_the_disk_still_has_to_write_are_counted_and_taught(tmp_path, monkeypatch):
    """TEACH and FORGET count them, and USE begins once they are there; nothing overtakes it."""
    disk = SlowDisk()
    one = Taught(tmp_path, disk=disk)
    begun: list[int] = []
    monkeypatch.setattr(one.session, "_learn", lambda by: begun.append(one.recording.stored) or [])
    monkeypatch.setattr(session, "TeachingProcess", mock.Mock())
    for material, count in (("cork", 2), ("pine", 1), ("felt", 1)):
        one.sweeps(material, count)
        assert one.order("TEACH", material) == [material, count]
    reply = one.order("USE")
    for order in (("USE", ""), ("FORGET", "cork")):
        with pytest.raises(ApplianceError, match="answer"):
            one.order(*order)
    disk.settle()
    assert reply.result(0) == [3, 4]
    assert begun == [4]
    one.session.close()
    one.recording.close()
    fresh = Taught(tmp_path / "fresh", disk=disk)
    fresh.sweeps("cork", 1)
    reply = fresh.order("FORGET", "cork")
    disk.settle()
    assert reply.result(0) == ["cork", 1]
    assert fresh.session.materials() == {}
    fresh.sweeps("pine", 1)
    reply = fresh.order("USE")
    disk.settle()
    with pytest.raises(ApplianceError, match="at least two"):
        reply.result(0)
    fresh.recording.close()


def test_sweeps_are_assessed_again_after_a_discard(taught):
    """Removed; also with another in its place in one turn."""
    taught.sweeps("cork", 3)
    taught.order("DISCARD", "3")
    assert taught.session.materials() == {"cork": 2}
    with pytest.raises(ApplianceError, match="2, not 3"):
        taught.order("DISCARD", "3")
    taught.sweeps("cork", 2)
    taught.sweeps("pine", 2)
    taught.until(lambda about: not about["assessing"])
    taught.order("DISCARD")
    taught.sweeps("pine", 1)
    taught.session.turn(HEALTH)
    assert taught.session.about()["assessing"]


def test_the_teacher_leads_from_material_to_material(taught):
    """Each label until its sweeps are there, those of earlier sessions not counted."""
    taught.sweeps("pine", 1)
    teacher = Teacher(taught.session, taught.recording, ["cork", "pine"], 2)
    teacher.turn(HEALTH)
    assert taught.recording.about()["material"] == "cork"
    taught.sweeps("cork", 2)
    teacher.turn(HEALTH)
    assert taught.recording.about()["material"] == "pine"
    taught.sweeps("pine", 1)
    teacher.turn(HEALTH)
    assert not teacher.done
    taught.sweeps("pine", 1)
    teacher.turn(HEALTH)
    assert teacher.done


def test_a_slow_disk_gives_the_next_sweeps_no_label(tmp_path):
    """The teacher goes on as soon as the last wanted sweep was answered, and ends with all."""
    disk = SlowDisk()
    one = Taught(tmp_path, disk=disk)
    teacher = Teacher(one.session, one.recording, ["cork", "pine"], 2)
    for material in ("cork", "pine"):
        teacher.turn(HEALTH)
        assert one.recording.about()["material"] == material
        one.sweeps(material, 1, Status.NO_CONTACT)
        one.sweeps(material, 2)
        assert one.session.materials()[material] == 0
    teacher.turn(HEALTH)
    assert teacher.done
    assert one.session.materials() == {"cork": 2, "pine": 2}
    one.session.close()
    one.recording.close()


def test_the_teacher_asks_again_for_a_sweep_that_could_not_be_stored(tmp_path, monkeypatch):
    """The disk was full for a moment; the label comes back at the end."""
    disk = SlowDisk()
    one = Taught(tmp_path, disk=disk)
    teacher = Teacher(one.session, one.recording, ["cork", "pine"], 1)
    teacher.turn(HEALTH)
    one.sweeps("cork", 1)
    with monkeypatch.context() as full:
        full.setattr(sweep_folder, "save", mock.Mock(side_effect=OSError(errno.ENOSPC, "full")))
        disk.settle()
    assert one.session.materials() == {"cork": 0}
    teacher.turn(HEALTH)
    one.sweeps("cork", 1)
    teacher.turn(HEALTH)
    one.sweeps("pine", 1)
    with monkeypatch.context() as full:
        full.setattr(sweep_folder, "save", mock.Mock(side_effect=OSError(errno.ENOSPC, "full")))
        teacher.turn(HEALTH)
    assert not teacher.done
    assert one.recording.about()["material"] == "cork"
    one.sweeps("cork", 1)
    teacher.turn(HEALTH)
    one.sweeps("pine", 1)
    teacher.turn(HEALTH)
    assert teacher.done
    assert one.session.materials() == {"cork": 1, "pine": 1}
    one.session.close()
    one.recording.close()


def test_the_teacher_asks_for_a_label_as_often_as_it_is_named(taught):
    """A label that is named again gets as many sweeps again."""
    teacher = Teacher(taught.session, taught.recording, ["cork", "pine", "cork"], 1)
    for material in ("cork", "pine", "cork"):
        teacher.turn(HEALTH)
        assert not teacher.done
        assert taught.recording.about()["material"] == material
        taught.sweeps(material, 1)
    teacher.turn(HEALTH)
    assert teacher.done
    assert taught.session.materials() == {"cork": 2, "pine": 1}


@pytest.mark.parametrize("order", [("FORGET", "cork"), ("RENAME", "cork,oak")])
def test_the_teacher_goes_on_from_a_material_that_is_gone(taught, order: tuple[str, str]):
    """A label that a person has forgotten or renamed holds up none of the others."""
    teacher = Teacher(taught.session, taught.recording, ["cork", "pine"], 2)
    teacher.turn(HEALTH)
    taught.order(*order)
    teacher.turn(HEALTH)
    assert taught.recording.about()["material"] == "pine"


def test_a_box_without_the_extra_says_what_to_install(monkeypatch):
    """Before a person records anything."""
    monkeypatch.setattr(process, "find_spec", lambda name: None if name == "scipy" else name)
    with pytest.raises(ConfigError, match="needs"):
        process.check_installed()


def test_a_mislabelled_sweep_is_moved_and_the_sweeps_are_assessed_again(taught):
    """Not while a bundle is made."""
    suspect = {"sweep": "sweep-000002", "material": "cork", "looks_like": "pine"}
    other = suspect | {"sweep": "sweep-000001"}
    taught.assess = printed(ASSESSED | {"suspects": [other, suspect]})
    taught.sweeps("cork", 3)
    taught.sweeps("pine", 2)
    taught.until(lambda about: about["learnt"])
    taught.assess = printed(ASSESSED | {"suspects": []})
    taught.order("MOVE", "2,pine")
    assert taught.session.about()["learnt"]["suspects"] == [other]
    assert taught.session.materials() == {"cork": 2, "pine": 3}
    taught.until(lambda about: about["learnt"]["suspects"] == [])
    taught.order("TEACH", "elm")
    taught.order("RENAME", "elm,oak")
    taught.order("UNDO")
    taught.order("RENAME", "elm,ash")
    assert taught.session.materials() == {"ash": 0, "cork": 2, "pine": 3}
    taught.order("RENAME", "cork,oak")
    taught.order("UNDO")
    assert taught.session.materials() == {"ash": 0, "cork": 2, "pine": 3}
    taught.order("USE")
    with pytest.raises(ApplianceError):
        taught.order("MOVE", "1,pine")


def test_a_renamed_material_needs_no_further_code(tmp_path):
    """Where the class bits have no code left, a material can still be renamed."""
    one = Taught(tmp_path, codes=4)
    one.sweeps("cork", 1)
    one.sweeps("pine", 1)
    one.order("TEACH", "elm")
    with pytest.raises(ConfigError):
        one.order("MOVE", "1,oak")
    assert one.order("RENAME", "cork,oak") == ["oak", 1]
    one.recording.close()

"""The service as a person sees it: the status file, its reader, and log lines."""

from __future__ import annotations

import json
import os
import stat
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate import __version__
from palpate.core.errors import ApplianceError, FormatError
from palpate.core.observer import Health
from palpate.core.status import REASONS
from palpate.core.types import Status
from palpate.service import status
from palpate.service.status_file import StatusFile
from palpate.service.systemd import VerdictLog
from palpate.sim import devices, rig
from tests.factories import feeds
from tests.factories.simulated_box import SECOND, Rigged, idle_devices

HEALTH = feeds.HEALTH._replace(ready=False)
AWAY = HEALTH._replace(skin="absent", trouble="no skin on USB; check cable", streams=False)
OK = replace(feeds.OK, displacement=None)
SHORT = replace(
    OK, sweep=8, status=Status.SHORT, label="", probability=0.0, fused=0, scores=np.empty(0)
)


class ClockedStatus:
    """A status file on a virtual clock."""

    def __init__(self, folder: Path, **facts: object) -> None:
        self.clock, self.path = rig.VirtualClock(), folder / "status.json"
        held = {name: lambda value=value: value for name, value in facts.items()}
        self.file = StatusFile(self.path, self.clock, held)

    def turns(self, seconds: float, health: Health = HEALTH, step_s: float = 0.01) -> int:
        """Take turns; how often the file was written anew."""
        inodes, end_ns = [], self.clock.now_ns() + round(seconds * SECOND)
        while self.clock.now_ns() < end_ns:
            self.file.turn(health)
            inodes.append(self.path.stat().st_mtime_ns if self.path.exists() else 0)
            self.clock.sleep_until(self.clock.now_ns() + round(step_s * SECOND))
        return len(set(inodes))

    def read(self) -> dict:
        """The result for a reader now."""
        return status.read(self.path, self.clock.now_ns())

    def text(self) -> str:
        """The same in words."""
        return "\n".join(status.lines(self.read(), self.clock.now_ns()))


@pytest.fixture
def status_file(tmp_path: Path) -> ClockedStatus:
    """A status file that was not written yet."""
    return ClockedStatus(tmp_path)


def test_it_is_written_once_a_second_and_soon_after_news(status_file):
    """Within a tenth, and of a storm no oftener; the last twenty are kept."""
    assert status_file.turns(4) in (4, 5)
    status_file.file.turn(HEALTH)
    status_file.file.answered(OK)
    status_file.turns(0.12)
    assert [v["sweep"] for v in status_file.read()["verdicts"]] == [7]
    status_file.turns(0.12, AWAY)
    assert status_file.read()["skin"] == "absent"
    written = 0
    for i in range(100):
        status_file.file.answered(replace(SHORT, sweep=i))
        before = status_file.path.stat().st_ino if status_file.path.exists() else None
        status_file.file.turn(HEALTH)
        written += status_file.path.stat().st_ino != before
        status_file.clock.sleep_until(status_file.clock.now_ns() + SECOND // 100)
    assert 9 <= written <= 11
    assert len(status_file.read()["verdicts"]) == 20


def test_every_user_may_read_it_whole(status_file):
    """Mode 644 under any umask; a reader that had it open has all of it."""
    before = os.umask(0o027)
    try:
        status_file.turns(0.01)
    finally:
        os.umask(before)
    assert stat.S_IMODE(status_file.path.stat().st_mode) == 0o644
    with status_file.path.open() as f:
        status_file.turns(2)
        assert json.load(f)["answered"] == 7
    assert [p.name for p in status_file.path.parent.iterdir()] == ["status.json"]


def test_in_words_it_says_how_it_is_and_what_to_do(tmp_path):
    """Newest verdict first; advice where something is wrong."""
    facts = {"trial": "start 1 of 3, 7 of 20 sweeps", "shadow": "", "steps": [1]}
    status_file = ClockedStatus(tmp_path, **facts)
    moved = "moved 2.1 mm too far towards row 4"
    for verdict in (replace(OK, sweep=6, detail=moved), OK, SHORT):
        status_file.file.answered(verdict)
    status_file.turns(135)
    head, *text = status_file.text().splitlines()
    assert "2 min 15 s" in head
    assert f"{os.getpid()}, palpate {__version__}, " in head
    assert [line.split() for line in text[:4]] == [
        ["skin", "streaming", "(5,000,000", "frames,", "3", "lost)"],
        ["bundle", "9f3c2a1b"],
        ["sweeps", "7", "answered"],
        ["trial", *facts["trial"].split()],
    ]
    assert [line.split()[1] for line in text[4:]] == ["8", "7", "6"]
    assert "short" in text[4]
    assert text[5].split()[-6:] == ["plastic", "rough", "98.7", "%", "1.2", "ms"]
    assert text[6].endswith(f"1.2 ms; {moved}")
    assert status.exit_code(status_file.read()) == 0
    assert "degraded" not in status_file.text()
    worse = {"garbage_bytes": 9, "enumerations": 2, "dropped": 4, "bundle": ""}
    worse |= {"degraded": "silent taxel 2.3", "trouble": "\x1b[2Jgone\n"}
    status_file.turns(1.5, AWAY._replace(**worse))
    told = status_file.text()
    for words in (
        "degraded silent taxel 2.3: ",
        "?[2Jgone?",
        "bundle   none",
        "9 bytes",
        "in 2 t",
        "4 sentences",
    ):
        assert words in told
    assert status.exit_code(status_file.read()) == 69


def test_a_program_that_has_ended_is_not_running(status_file):
    """No file, or `why` has the reason; exit code 1."""
    assert status.exit_code(status_file.read()) == 1
    assert "does not run" in status_file.text()
    status_file.turns(0.01)
    assert status_file.read()["running"]
    written = json.loads(status_file.path.read_text())
    status_file.clock.sleep_until(status_file.clock.now_ns() + 11 * SECOND)
    assert "11" in status_file.text()
    gone = subprocess.Popen(["true"])
    gone.wait(60)
    for wrong in ({"pid": gone.pid}, {"time_ns": 10**18}):
        now = {"time_ns": status_file.clock.now_ns()}
        status_file.path.write_text(json.dumps(written | now | wrong))
        assert "closing" in status_file.text()
        assert status.exit_code(status_file.read()) == 1
    status_file.file.stopping()
    assert not status_file.path.exists()


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"schema": 2}', "[" * 100_000, '{"schema": 1, "pid": "x"}']
)
def test_a_file_of_another_form_is_named(status_file, text):
    """A status of another version is an error, not a guess, and so is a folder at its path."""
    status_file.path.write_text(text)
    with pytest.raises(FormatError):
        status_file.read()
    status_file.path.unlink()
    status_file.path.mkdir()
    with pytest.raises(ApplianceError, match="cannot"):
        status_file.read()


def test_trouble_with_the_file_is_logged_once(tmp_path, logged):
    """One line, another only after it had worked."""
    status_file = ClockedStatus(tmp_path / "run")
    status_file.turns(5)
    assert len(logged) == 1
    assert "classifying" in logged[0]
    status_file.path.parent.mkdir()
    status_file.turns(2)
    assert status_file.read()["running"]
    status_file.path.unlink()
    status_file.path.parent.rmdir()
    status_file.turns(2)
    status_file.file.stopping()
    assert len(logged) == 2


SURE = "plastic rough, 98.7 %"


@pytest.mark.parametrize(
    ("verdict", "line"),
    [
        (OK, f"sweep 7: {SURE} (1.2 ms)"),
        (replace(OK, fused=3), f"sweep 7: {SURE} after 3 sweeps (1.2 ms)"),
        (replace(OK, share=0.4), f"sweep 7: {SURE}, early at 40 % of the window (1.2 ms)"),
        (replace(OK, status=Status.UNSURE), f"sweep 7: unsure, perhaps {SURE} (1.2 ms)"),
        (
            replace(OK, displacement="moved 2 mm", detail="moved 2 mm"),
            f"<4>sweep 7: {SURE} (1.2 ms); moved 2 mm",
        ),
        (SHORT, f"<4>sweep 8: no answer, short: {REASONS[Status.SHORT]}"),
        (
            replace(SHORT, status=Status.STUCK_TAXEL, detail="taxel 2.3"),
            f"<4>sweep 8: no answer, stuck-taxel: {REASONS[Status.STUCK_TAXEL]}; taxel 2.3",
        ),
        (
            replace(SHORT, status=Status.ABORTED),
            f"sweep 8: no answer, aborted: {REASONS[Status.ABORTED]}",
        ),
    ],
)
def test_the_log_has_one_line_a_verdict(verdict, line, logged):
    """In words; a verdict that needs attention is a warning."""
    VerdictLog().answered(verdict)
    assert logged == [line]


def once(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """A fault of the bus that changes one transfer."""
    left = [change]
    return lambda data: left.pop()(data) if left else data


def burst(line: str, edges: int, apart_s: float) -> Callable[[Rigged], None]:
    """A fault of a trigger line: so many edges, the last one down."""

    def drive(box: Rigged) -> None:
        for i in range(edges):
            box.edge(line, 0.1 + i * apart_s, i % 2 == 0)

    return drive


def mangled(change: Callable[[bytes], bytes]) -> Callable[[Rigged], None]:
    """A fault of the bus that changes one transfer."""
    return lambda box: setattr(box.simulated.backend, "mangle", once(change))


def asleep(box: Rigged) -> None:
    """The loop comes two seconds late."""
    box.simulated.clock.sleep_until(box.simulated.clock.now_ns() + 2 * SECOND)


@pytest.mark.parametrize(
    ("name", "field", "fault", "text"),
    [
        ("stale_frames", 12, mangled(lambda data: data * 2), "4 repeated or late"),
        ("overflows", 13, mangled(lambda data: data + bytes(5000)), "1 transfers too large"),
        ("fifo_overflows", 14, asleep, "FIFO was full"),
        ("glitches", 15, burst(devices.START, 2, 1e-4), "1 glitches; "),
        ("lost_edges", 16, burst(devices.STOP, 3000, 1e-6), "edges lost; "),
        ("storms", 17, burst(devices.STOP, 60, 1e-4), "1 storms of edges; "),
    ],
)
def test_what_is_counted_is_shown(rigged, tmp_path, name, field, fault, text):
    """In STA, STATE, file and words, and not before it."""
    simulated = idle_devices(60)
    file = StatusFile(tmp_path / "status.json", simulated.clock, {})
    sets = ("trigger.storm_edges=50",) if name == "storms" else ()
    box = rigged(simulated, sets, observers=[file])
    box.seconds(1.5)

    def shown() -> tuple[int, int, int, bool]:
        report = status.read(tmp_path / "status.json", simulated.clock.now_ns())
        answer = box.ask("$PPLP,STATE").split("*")[0].split(",")[4:]
        sentence = next(h for h in reversed(box.heard) if ",STA," in h).split("*")[0].split(",")[2:]
        in_words = text in "\n".join(status.lines(report, simulated.clock.now_ns()))
        return int(sentence[field - 1]), int(answer[field - 1]), report[name], in_words

    assert shown() == (0, 0, 0, False)
    fault(box)
    box.seconds(2.5)
    sent, answered, written, in_words = shown()
    assert sent == answered == written == getattr(box.box.health, name) > 0
    assert in_words

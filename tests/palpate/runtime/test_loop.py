"""The whole box on simulated devices: bytes and edges in, sentences and lines out."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np
import pynmea2
import pytest

from palpate.client.answers import Answer
from palpate.core import config
from palpate.core.observer import Health, Observer
from palpate.core.types import Status, Sweep, Verdict
from palpate.io.robot_link import StdoutPort
from palpate.runtime import assembly
from palpate.sim import devices, rig, skin
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import SECOND, SETTLE_S, Rigged, played, tubes

RATE = round(skin.FORMAT.rate_hz)
READY, BUSY, FAULT = devices.READY, devices.BUSY, devices.FAULT
START, STOP, RESULT_VALID = devices.START, devices.STOP, devices.RESULT_VALID


def answers(box: Rigged) -> list[Answer]:
    """The RES sentences that the robot has read."""
    return [a for a in map(Answer.read, box.heard) if a]


def levels(simulated: devices.SimDevices, name: str) -> list[bool]:
    """The levels that were written to a line, in order."""
    return [level for _, line, level in simulated.gpio.written if line == name]


def slide(label: str = "wood", seed: int = 3) -> np.ndarray:
    """Three seconds of sliding [2250, 4, 4]."""
    place = skin.placements("T-LAB", seed)[0]
    return skin.sweep(label, place, np.random.default_rng(seed), rest_s=0, slide_s=3, after_s=0)


def touched(frames: np.ndarray, quiet_s: float = 0.5) -> devices.SimDevices:
    """Simulated devices that play one act: idle, three seconds of `frames` [2250, 4, 4], idle."""
    off = np.zeros((round(quiet_s * RATE), 4, 4), np.uint8)
    act = rig.Act(np.concatenate([off, frames, off]), len(off), len(off) + len(frames), "")
    return played([act])


def quiet(level: tuple[int, int] = (0, 1)) -> devices.SimDevices:
    """Simulated devices whose skin is idle for a minute; a test drives the lines itself."""
    counts = np.random.default_rng(0).integers(*level, (60 * RATE, 4, 4)).astype(np.uint8)
    return played([rig.Act(counts, 10**7, 10**7 + 1, "")])


def test_sweeps_become_sentences(rigged):
    """Five sweeps: each once, nothing lost; the window is the middle of the act."""
    simulated = tubes(1000, 5)
    box = rigged(simulated)
    verdicts = box.until(lambda: simulated.finished(box.box.answered))
    box.seconds(0.1)
    heard = answers(box)
    assert [a.sweep for a in heard] == list(range(1, 6))
    assert [a.label for a in heard] == [v.label for v in verdicts]
    assert {a.status for a in heard} <= {"ok", "unsure"}
    assert sum(a.lost for a in heard) == box.box.counters.lost_frames == 0
    assert all(pynmea2.parse(line, check=True) for line in box.heard)
    assert all(",sim," in line for line in box.heard if ",RES," in line)
    for sweep, act in zip(box.kept, simulated.robot.played, strict=True):
        begins = (act.start + act.stop) // 2 - 750 + np.arange(-1, 2)
        assert any((act.frames[k : k + 1500] == sweep.frames.taxels).all() for k in begins)


def test_lines_follow_the_sweep(rigged):
    """READY and BUSY; class bits before RESULT VALID; both fall at the next."""
    simulated = tubes(1002, 2)
    box = rigged(simulated)
    box.until(lambda: simulated.finished(box.box.answered))
    box.seconds(0.1)
    written = simulated.gpio.written
    cycle = [(READY, False), (BUSY, True), (READY, True), (BUSY, False)]
    changes = [w[1:] for w in written if w[1] in (READY, BUSY)]
    assert changes == [(READY, True), *cycle, *cycle]
    assert levels(simulated, RESULT_VALID) == [True, False, True]
    falls = next(t for t, name, level in written if name == RESULT_VALID and not level)
    assert falls == [t for t, name, level in written if name == BUSY and level][1]


def test_dead_process_is_not_ready(default_bundle):
    """After the process was killed the kernel releases its lines, and READY reads low."""
    simulated = quiet()
    box = assembly.box(config.load(None), default_bundle, simulated, StdoutPort(), ExitStack())
    for _ in range(5):
        box.step()
    assert levels(simulated, READY) == [True]
    for request in list(simulated.gpio.requests):
        request.release()
    assert levels(simulated, READY) == [True, False]


def test_unplugged_during_a_sweep(rigged):
    """`sensor-lost` at once and FAULT; then `not-ready`; replugged it works."""
    simulated = tubes(1003, 3)
    box = rigged(simulated)
    box.until(lambda: box.box.answered == 1)
    begin = simulated.clock.now_ns()
    simulated.backend.at(begin + 2 * SECOND, simulated.backend.unplug)
    simulated.backend.at(begin + round(3.9 * SECOND), simulated.backend.plug)
    lost = box.until(lambda: box.box.answered == 2)
    assert lost[0].status is Status.SENSOR_LOST
    assert simulated.clock.now_ns() - begin < 2.2 * SECOND
    box.until(lambda: simulated.finished(box.box.answered))
    box.seconds(0.1)
    lost, last = (a.status for a in answers(box)[1:])
    assert lost == "sensor-lost"
    assert last in ("ok", "unsure", "not-ready")
    assert levels(simulated, FAULT) == [True, False]


def test_a_board_that_sends_no_frame_is_never_ready(rigged, logged):
    """FAULT and `not-ready`, until the first frame."""
    simulated = quiet()
    board = simulated.backend.board
    take, board.take = board.take, lambda: (take(), b"")[1]
    box = rigged(simulated)
    box.pulse(START, 2)
    assert [v.status for v in box.seconds(5)] == [Status.NOT_READY]
    assert (levels(simulated, READY), levels(simulated, FAULT)) == ([], [True])
    assert "skin: streaming" not in logged
    assert sum("frame" in line for line in logged) == 1
    board.take = take
    box.seconds(1)
    assert (levels(simulated, READY), levels(simulated, FAULT)) == ([True], [True, False])
    assert logged.count("skin: streaming") == 1


@pytest.mark.parametrize(
    ("edges", "want"),
    [
        ([(START, 0.5), (STOP, 1.5)], ["short"]),
        ([(START, 0.5)], ["long"]),
        ([(START, 0.5), (STOP, 14)], ["long"]),
        ([(STOP, 0.5)], ["no-start"]),
        ([(START, 0.5), (START, 1.5), (STOP, 4.5)], ["no-stop", "no-contact"]),
        ([(START, 0.5), (STOP, 3.5)], ["no-contact"]),
    ],
)
def test_triggers_out_of_order(rigged, edges, want):
    """Short, long, lone and double edges: a defined answer each, in sentences."""
    box = rigged(quiet())
    for name, after_s in edges:
        box.pulse(name, after_s)
    box.seconds(16 if want == ["long"] else 6)
    assert [a.status for a in answers(box)] == want


def test_storm_of_edges(rigged):
    """10,000 in a second: `edges-lost`, no frame lost, and the next sweep is fine."""
    box = rigged(touched(slide(), quiet_s=6.5))
    box.seconds(0.5)
    for i in range(10_000):
        box.edge(START, 0.5 + i * 1e-4, i % 2 == 0)
    box.seconds(4)
    storm = box.box.answered
    assert 1 <= storm <= 10
    box.until(lambda: box.box.answered == storm + 1)
    box.seconds(0.1)
    heard = [a.status for a in answers(box)]
    assert "edges-lost" in heard[:-1]
    assert heard[-1] in ("ok", "unsure")
    assert box.box.counters.lost_frames == 0


@pytest.mark.parametrize(("at", "count", "place"), [((1, 2), 77, "2.3"), ((2, 1), 0, "3.2")])
def test_a_broken_taxel_is_bridged_and_named_everywhere(rigged, at, count, place):
    """READY stays; after seconds STA and state have it."""
    frames = slide("plastic rough")
    frames[:, *at] = count
    box = rigged(touched(frames))
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert (verdict.status, verdict.label) == ("ok", "plastic rough")
    assert verdict.detail == f"degraded: silent taxel {place}"
    assert box.box.health.ready
    assert box.box.health.degraded == f"silent taxel {place}"
    assert f"silent taxel {place}" in box.box.health.text
    box.seconds(1.1)
    fields = next(line for line in reversed(box.heard) if ",STA," in line)
    assert fields.split("*")[0].split(",")[-2:] == ["", f"silent taxel {place}"]


def test_commands(rigged, default_bundle):
    """Each is answered; the answer to a wrong command shows the right one."""
    box, labels = rigged(quiet()), default_bundle.manifest.labels
    box.seconds(1)
    commands = {
        "ID": f"{default_bundle.id}",
        "STATE": ",streaming,0,0,",
        "TEST": ",TEST,ok,",
        "TARE": ",TARE,ok,largest 0.0 raw counts",
        "NEW": ",NEW,ok",
        "ABORT": ",ABORT,error,no sweep is open",
        "DANCE": "known are",
    }
    for code, label in enumerate(labels, 1):
        commands[f"LABEL,{code}"] = f",LABEL,ok,{code},{label},{len(labels)}*"
    for code in (0, len(labels) + 1, "wood"):
        commands[f"LABEL,{code}"] = f"label {code} is not there; use 1 to {len(labels)}*"
    for command, answer in commands.items():
        assert answer in box.ask(f"$PPLP,{command}")
    assert "SIM0001" in box.ask("$PPLP,ID")


def test_tare_moves_the_contact_threshold(rigged):
    """After a tare an offset is not taken for contact. A tare during a sweep is refused."""
    box = rigged(quiet((40, 42)))
    box.seconds(1)
    assert "largest 4" in box.ask("$PPLP,TARE")
    box.pulse(START, 0.1)
    box.pulse(STOP, 3)
    box.seconds(0.2)
    assert "TARE,error,tare" in box.ask("$PPLP,TARE")
    assert [v.status for v in box.until(lambda: box.box.answered == 1)] == [Status.NO_CONTACT]


@pytest.mark.parametrize("by_command", [True, False])
def test_an_open_sweep_is_answered_aborted(rigged, by_command):
    """By ABORT, and its stop edge gets no further answer; or when the loop is stopped."""
    box = rigged(quiet())
    box.pulse(START, 0.2)
    if by_command:
        box.pulse(STOP, 3)
        box.seconds(0.5)
        assert ",ABORT,ok" in box.ask("$PPLP,ABORT")
        box.seconds(4)
    else:
        end = box.simulated.clock.now_ns() + SECOND
        box.box.run(lambda: box.simulated.clock.now_ns() > end)
        box.listen(SETTLE_S)
    assert [a.status for a in answers(box)] == ["aborted"]


def test_state_is_sent_once_a_second(rigged):
    """One STA sentence a second, with the frames so far."""
    box = rigged(quiet())
    box.seconds(10)
    states = [h.split(",") for h in box.heard if ",STA," in h]
    assert len(states) in (10, 11)
    assert int(states[-1][6]) > 6500
    assert {s[3] for s in states[1:]} == {"streaming"}


@pytest.mark.slow
def test_a_robot_that_does_not_read_costs_no_frame(rigged):
    """Sentences are dropped and counted, no sweep is lost."""
    simulated = tubes(1006, 20)
    box = rigged(simulated, sets=("serial.queue=4", "serial.state_s=0.05"))
    while not simulated.finished(box.box.answered):
        box.box.step()
    assert box.port.dropped > 0
    assert (box.box.counters.lost_frames, box.box.answered) == (0, 20)


def test_trouble_is_logged_once(rigged, logged):
    """When it begins and when it ends; the log has the open port once."""
    simulated = quiet()
    box = rigged(simulated)
    box.seconds(1)
    simulated.backend.unplug()
    box.seconds(2)
    simulated.backend.plug()
    box.seconds(1)
    lines = [line.removeprefix("<4>") for line in logged if "skin: " in line]
    assert lines[0] == lines[-1] == "skin: streaming"
    assert 3 <= len(lines) <= 4
    assert [line for line in logged if "serial" in line] == [f"serial: {box.port.name} open"]


def test_a_box_without_a_port_logs_none(default_bundle, logged):
    """The box runs without it."""
    simulated = quiet()
    with ExitStack() as stack:
        settings = config.load(None, site=NO_SITE)
        alone = assembly.box(settings, default_bundle, simulated, None, stack)
        while simulated.clock.now_ns() < 2 * SECOND:
            alone.step()
    assert "skin: streaming" in logged
    assert not [line for line in logged if "serial" in line or " open" in line]


def test_observers_are_called_in_order_and_sweeps_after_all_answers(rigged):
    """Health comes last."""

    class EffectLog(Observer):
        """Logs its calls under its name."""

        def __init__(self, name: str, effects: list[str]) -> None:
            self._name, self._effects = name, effects

        def answered(self, verdict: Verdict) -> None:
            self._effects.append(f"{self._name} answered {verdict.sweep}")

        def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
            self._effects.append(f"{self._name} sweep {sweep.id} {circumstances['source']}")

        def turn(self, health: Health) -> None:
            """Log the call if a sweep was answered in this turn."""
            if self._effects and "turn" not in self._effects[-1]:
                self._effects.append(f"{self._name} turn {health.answered}")

    effects: list[str] = []
    box = rigged(quiet(), observers=[EffectLog("a", effects), EffectLog("b", effects), Observer()])
    box.seconds(0.5)
    for after_ms, level in ((100, True), (101, False), (102, True), (103, False)):
        box.edge(STOP, after_ms / 1000, level)
    box.seconds(0.5)
    answered = [f"{name} answered {n}" for n in (1, 2) for name in "ab"]
    passed = [f"{name} sweep {n} sim" for n in (1, 2) for name in "ab"]
    assert effects == [*answered, *passed, "a turn 2"]
    assert [a.status for a in answers(box)] == ["no-start", "no-start"]

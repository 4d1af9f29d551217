"""The whole box on simulated devices: USB bytes and GPIO edges in, sentences and lines out, and
each way to fail."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import pynmea2
import pytest

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core import config
from palpate.core.health import Health
from palpate.core.observer import Observer
from palpate.core.types import Status, Sweep, Verdict
from palpate.io.robot_link import StdoutPort
from palpate.runtime import assembly
from palpate.sim import devices, rig, script, skin
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import SECOND, SETTLE_S, Rigged

RATE = round(skin.FORMAT.rate_hz)


LINES = devices.READY, devices.FAULT


def answers(box: Rigged) -> list[Answer]:
    """The RES sentences that the robot has read."""
    return [a for a in map(Answer.read, box.heard) if a]


def touched(frames: np.ndarray) -> list[rig.Act]:
    """One act: idle, three seconds of `frames` [2250, 4, 4], idle."""
    off = np.zeros((RATE // 2, 4, 4), np.uint8)
    return [rig.Act(np.concatenate([off, frames, off]), len(off), len(off) + len(frames), "")]


def slide(label: str = "wood", seed: int = 3) -> np.ndarray:
    """Three seconds of sliding [2250, 4, 4]."""
    place = skin.placements("T-LAB", seed)[0]
    return skin.sweep(label, place, np.random.default_rng(seed), rest_s=0, slide_s=3, after_s=0)


def simulated_devices(acts: list[rig.Act] | Iterator[rig.Act]) -> devices.SimDevices:
    """Simulated devices that play `acts`."""
    return devices.build(skin.FORMAT, acts, rig.VirtualClock(), "sim")


def quiet() -> devices.SimDevices:
    """Simulated devices whose skin is idle for a minute; a test drives the lines itself."""
    off = np.zeros((60 * RATE, 4, 4), np.uint8)
    return simulated_devices([rig.Act(off, 10**7, 10**7 + 1, "")])


def test_sweeps_become_sentences(rigged: Callable[..., Rigged]):
    """Twelve sweeps: each answered once, with a right checksum, nothing lost, at the far end of the
    serial line."""
    simulated = simulated_devices(script.tubes(1000, 12))
    box = rigged(simulated)
    verdicts = box.until(lambda: simulated.finished(box.box.answered))
    box.seconds(0.1)
    heard = answers(box)
    assert [a.sweep for a in heard] == list(range(1, 13))
    assert [a.label for a in heard] == [v.label for v in verdicts]
    assert {a.status for a in heard} <= {"ok", "unsure"}
    assert sum(a.lost for a in heard) == 0
    assert box.box.counters.lost_frames == 0
    for line in box.heard:
        pynmea2.parse(line, check=True)
    assert all(",sim," in line for line in box.heard if ",RES," in line)


def test_windows_are_the_middle_of_what_was_slid(rigged: Callable[..., Rigged]):
    """The window of the network equals the middle of the act that the robot played."""
    simulated = simulated_devices(script.tubes(1001, 3))
    box = rigged(simulated)
    box.until(lambda: simulated.finished(box.box.answered))
    for sweep, act in zip(box.kept, simulated.robot.played, strict=True):
        middle = (act.start + act.stop) // 2
        near = [
            (act.frames[middle - 750 + k : middle + 750 + k] == sweep.frames.taxels).all()
            for k in (-1, 0, 1)
        ]
        assert any(near)


def test_lines_follow_the_sweep(rigged: Callable[..., Rigged]):
    """READY falls and BUSY rises with the sweep. Class bits are set before RESULT VALID, and both
    fall when the next sweep starts."""
    simulated = simulated_devices(script.tubes(1002, 2))
    box = rigged(simulated)
    box.until(lambda: simulated.finished(box.box.answered))
    box.seconds(0.1)

    def changes(*names: str) -> list[tuple[int, str, bool]]:
        return [w for w in simulated.gpio.written if w[1] in names]

    cycle = [
        (devices.READY, False),
        (devices.BUSY, True),
        (devices.READY, True),
        (devices.BUSY, False),
    ]
    assert [w[1:] for w in changes(devices.READY, devices.BUSY)] == [
        (devices.READY, True),
        *cycle,
        *cycle,
    ]
    assert [level for _, _, level in changes(devices.RESULT_VALID)] == [True, False, True]
    falls = changes(devices.RESULT_VALID)[1][0]
    second = [t for t, _, level in changes(devices.BUSY) if level][1]
    assert falls == second


def test_dead_process_is_not_ready(default_bundle: bundle.Bundle):
    """After the process was killed the kernel releases its lines, and READY reads low."""
    simulated = quiet()
    box = assembly.box(config.load(None), default_bundle, simulated, StdoutPort("sim"), ExitStack())
    for _ in range(5):
        box.step()
    assert [v for _, n, v in simulated.gpio.written if n == devices.READY] == [True]
    for request in list(simulated.gpio.requests):
        request.release()
    assert [v for _, n, v in simulated.gpio.written if n == devices.READY] == [True, False]


def test_unplugged_during_a_sweep(rigged: Callable[..., Rigged]):
    """The sweep is answered `sensor-lost` at once, and FAULT rises. A trigger meanwhile is
    `not-ready`. After replugging the box works again."""
    simulated = simulated_devices(script.tubes(1003, 3))
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
    assert [a.status for a in answers(box)][1:] in (
        ["sensor-lost", "ok"],
        ["sensor-lost", "not-ready"],
        ["sensor-lost", "unsure"],
    )
    fault_line = [level for _, name, level in simulated.gpio.written if name == devices.FAULT]
    assert fault_line == [True, False]


def test_a_board_that_sends_no_frame_is_never_ready(
    rigged: Callable[..., Rigged], caplog: pytest.LogCaptureFixture
):
    """The board answers and sends nothing: READY stays low and FAULT high, a trigger is
    `not-ready`, and READY rises with the first frame, as the log says."""
    caplog.set_level(logging.INFO)
    simulated = quiet()
    board = simulated.backend.board
    take, board.take = board.take, lambda: (take(), b"")[1]
    box = rigged(simulated)
    box.pulse(devices.START, 2)
    assert [v.status for v in box.seconds(5)] == [Status.NOT_READY]
    levels = {name: [v for _, n, v in simulated.gpio.written if n == name] for name in LINES}
    assert levels == {devices.READY: [], devices.FAULT: [True]}
    assert "skin: streaming" not in caplog.messages
    assert sum("sent no frame" in message for message in caplog.messages) == 1
    board.take = take
    box.seconds(1)
    levels = {name: [v for _, n, v in simulated.gpio.written if n == name] for name in LINES}
    assert levels == {devices.READY: [True], devices.FAULT: [True, False]}
    assert caplog.messages.count("skin: streaming") == 1


def test_trigger_while_not_ready_is_answered(rigged: Callable[..., Rigged]):
    """Without a skin the start edge is answered, and its stop edge is not."""
    simulated = quiet()
    simulated.backend.unplug()
    box = rigged(simulated)
    box.pulse(devices.START, 0.5)
    box.pulse(devices.STOP, 3)
    verdicts = box.seconds(4)
    assert [v.status for v in verdicts] == [Status.NOT_READY]


@pytest.mark.parametrize(
    ("edges", "want"),
    [
        ([(devices.START, 0.5), (devices.STOP, 1.5)], ["short"]),
        ([(devices.START, 0.5)], ["long"]),
        ([(devices.START, 0.5), (devices.STOP, 14)], ["long"]),
        ([(devices.STOP, 0.5)], ["no-start"]),
        (
            [(devices.START, 0.5), (devices.START, 1.5), (devices.STOP, 4.5)],
            ["no-stop", "no-contact"],
        ),
        ([(devices.START, 0.5), (devices.STOP, 3.5)], ["no-contact"]),
    ],
)
def test_triggers_out_of_order(
    rigged: Callable[..., Rigged], edges: list[tuple[str, float]], want: list[str]
):
    """Short, long, lone and double edges: a defined answer each, as sentences."""
    box = rigged(quiet())
    for name, after_s in edges:
        box.pulse(name, after_s)
    box.seconds(16)
    assert [a.status for a in answers(box)] == want


def test_storm_of_edges(rigged: Callable[..., Rigged]):
    """10,000 edges in a second: answered `edges-lost`, no frame lost, and the next sweep is
    fine."""
    frames = slide()
    quiet_act = rig.Act(np.zeros((6 * RATE, 4, 4), np.uint8), 10**7, 10**7 + 1, "")
    simulated = simulated_devices([quiet_act, *touched(frames)])
    box = rigged(simulated)
    box.seconds(0.5)
    for i in range(10_000):
        box.edge(devices.START, 0.5 + i * 1e-4, i % 2 == 0)
    box.seconds(4)
    storm = box.box.answered
    assert 1 <= storm <= 10
    box.until(lambda: box.box.answered == storm + 1)
    box.seconds(0.1)
    heard = answers(box)
    assert "edges-lost" in {a.status for a in heard[:-1]}
    assert heard[-1].status in ("ok", "unsure")
    assert box.box.counters.lost_frames == 0


@pytest.mark.parametrize(("packet_frames", "statuses"), [(2, {"ok", "unsure"}), (4, {"gap"})])
def test_missing_frames(rigged: Callable[..., Rigged], packet_frames: int, statuses: set[str]):
    """A lost packet within the window: two frames are interpolated and counted, four make it a
    `gap`."""
    simulated = simulated_devices(touched(slide()))
    simulated.backend.board = rig.ReadoutBoard(
        skin.FORMAT, simulated.robot, simulated.clock, packet_frames=packet_frames
    )
    count = itertools.count()
    simulated.backend.mangle = lambda data: b"" if next(count) == 1500 // packet_frames else data
    box = rigged(simulated)
    box.until(lambda: box.box.answered == 1)
    box.seconds(0.1)
    (answer,) = answers(box)
    assert answer.status in statuses
    assert answer.lost == box.box.counters.lost_frames == packet_frames


def spoiled(fault: str) -> np.ndarray:
    """A slide with a faulty skin."""
    frames = slide("plastic rough")
    if fault == "saturated":
        frames[:] = 255 - (np.arange(len(frames)) % 7 == 0)[:, None, None]
    elif fault == "stuck-taxel":
        frames[:, 1, 2] = 77
    elif fault == "dead-taxel":
        frames[:, 2, 1] = 0
    elif fault == "no-contact":
        frames = np.random.default_rng(0).integers(0, 2, frames.shape).astype(np.uint8)
    return frames


@pytest.mark.parametrize(
    ("fault", "detail"),
    [
        ("saturated", "taxel 1.1"),
        ("no-contact", "raw counts"),
    ],
)
def test_a_spoiled_skin_is_seen_before_the_network_is_asked(
    rigged: Callable[..., Rigged], fault: str, detail: str
):
    """Saturation and no contact: a status with the place, and no label."""
    box = rigged(simulated_devices(touched(spoiled(fault))))
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert (verdict.status, verdict.label) == (fault, "")
    assert detail in verdict.detail
    assert len(verdict.scores) == 0


@pytest.mark.parametrize(("fault", "place"), [("stuck-taxel", "2.3"), ("dead-taxel", "3.2")])
def test_a_broken_taxel_is_bridged_and_named_everywhere(
    rigged: Callable[..., Rigged], fault: str, place: str
):
    """The answer is ok with the taxel in its detail. READY stays; after some seconds of the same
    slide STA and the state name the taxel, too."""
    box = rigged(simulated_devices(touched(spoiled(fault))))
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert (verdict.status, verdict.label) == ("ok", "plastic rough")
    assert verdict.detail == f"degraded: silent taxel {place}"
    assert box.box.health.ready
    assert box.box.health.degraded == f"silent taxel {place}"
    assert box.box.health.text.startswith(f"skin streaming, silent taxel {place}. ")
    box.seconds(1.1)
    fields = next(line for line in reversed(box.heard) if ",STA," in line)
    assert fields.split("*")[0].split(",")[-2:] == ["", f"silent taxel {place}"]


def test_sweeps_of_one_object_are_fused(rigged: Callable[..., Rigged]):
    """Before NEW OBJECT sweeps are answered alone. After it they are fused, until the next NEW
    OBJECT."""
    tubes = script.tubes(1005, 6, only="wood")
    acts = [replace(a, new_object=i in (1, 4)) for i, a in enumerate(tubes)]
    box = rigged(simulated_devices(acts))
    verdicts = box.until(lambda: box.box.answered == 6)
    assert [v.fused for v in verdicts] == [1, 1, 2, 3, 1, 2]


def test_fusing_can_be_turned_off(rigged: Callable[..., Rigged]):
    """With `classifier.fuse=none` NEW OBJECT changes nothing."""
    acts = [replace(a, new_object=i == 0) for i, a in enumerate(script.tubes(1005, 3))]
    box = rigged(simulated_devices(acts), sets=("classifier.fuse=none",))
    assert [v.fused for v in box.until(lambda: box.box.answered == 3)] == [1, 1, 1]


def test_commands(rigged: Callable[..., Rigged], default_bundle: bundle.Bundle):
    """Identity, state, self-test, tare, new object and abort are answered. The answer to a wrong
    command shows the right command."""
    box = rigged(quiet())
    box.seconds(1)
    assert default_bundle.id in box.ask("$PPLP,ID")
    assert "SIM0001" in box.ask("$PPLP,ID")
    assert ",streaming,0,0," in box.ask("$PPLP,STATE")
    assert ",TEST,ok," in box.ask("$PPLP,TEST")
    assert ",TARE,ok,largest 0.0 raw counts" in box.ask("$PPLP,TARE")
    assert ",NEW,ok" in box.ask("$PPLP,NEW")
    assert ",ABORT,error,no sweep is open" in box.ask("$PPLP,ABORT")
    labels = default_bundle.manifest.labels
    for code, label in enumerate(labels, 1):
        assert f",LABEL,ok,{code},{label},{len(labels)}*" in box.ask(f"$PPLP,LABEL,{code}")
    for code in (0, len(labels) + 1, "wood"):
        assert f",LABEL,error,label {code} is not there; use 1 to {len(labels)}*" in box.ask(
            f"$PPLP,LABEL,{code}"
        )
    assert "known are" in box.ask("$PPLP,DANCE")


def test_tare_moves_the_contact_threshold(rigged: Callable[..., Rigged]):
    """After a tare an offset is not taken for contact. A tare during a sweep is refused."""
    offset = np.random.default_rng(0).integers(40, 42, (9 * RATE, 4, 4)).astype(np.uint8)
    box = rigged(simulated_devices([rig.Act(offset, 10**7, 10**7 + 1, "")]))
    box.seconds(1)
    assert "largest 4" in box.ask("$PPLP,TARE")
    box.pulse(devices.START, 0.1)
    box.pulse(devices.STOP, 3)
    box.seconds(0.2)
    assert ",TARE,error,tare needs" in box.ask("$PPLP,TARE")
    assert [v.status for v in box.until(lambda: box.box.answered == 1)] == [Status.NO_CONTACT]


def test_abort_answers_the_open_sweep(rigged: Callable[..., Rigged]):
    """ABORT answers the sweep; its stop edge gets no further answer."""
    box = rigged(quiet())
    box.pulse(devices.START, 0.2)
    box.pulse(devices.STOP, 3)
    box.seconds(0.5)
    assert ",ABORT,ok" in box.ask("$PPLP,ABORT")
    box.seconds(4)
    assert [a.status for a in answers(box)] == ["aborted"]


def test_stopping_answers_what_is_open(rigged: Callable[..., Rigged]):
    """The loop ends when it is stopped, and the sweep that was open is answered `aborted`."""
    box = rigged(quiet())
    box.pulse(devices.START, 0.2)
    end = box.simulated.clock.now_ns() + SECOND
    box.box.run(lambda: box.simulated.clock.now_ns() > end)
    box.listen(SETTLE_S)
    assert [a.status for a in answers(box)] == ["aborted"]


def test_state_is_sent_once_a_second(rigged: Callable[..., Rigged]):
    """One STA sentence a second, with the frames so far."""
    box = rigged(quiet())
    box.seconds(10)
    states = [h.split(",") for h in box.heard if ",STA," in h]
    assert len(states) in (10, 11)
    assert int(states[-1][6]) > 6500
    assert {s[3] for s in states[1:]} == {"streaming"}


@pytest.mark.slow
def test_a_robot_that_does_not_read_costs_no_frame(rigged: Callable[..., Rigged]):
    """The serial line is full: sentences are dropped and counted, and no frame or sweep is
    lost."""
    simulated = simulated_devices(script.tubes(1006, 20))
    box = rigged(simulated, sets=("serial.queue=4", "serial.state_s=0.05"))
    while not simulated.finished(box.box.answered):
        box.box.step()
    assert box.port.dropped > 0
    assert box.box.counters.lost_frames == 0
    assert box.box.answered == 20


def test_trouble_is_logged_once(rigged: Callable[..., Rigged], logged: list[str]):
    """Trouble is logged when it begins and when it ends, not at every turn."""
    simulated = quiet()
    box = rigged(simulated)
    box.seconds(1)
    simulated.backend.unplug()
    box.seconds(2)
    simulated.backend.plug()
    box.seconds(1)
    skin_lines = [line.removeprefix("<4>") for line in logged if "skin: " in line]
    assert skin_lines[0] == "skin: streaming"
    assert skin_lines[-1] == "skin: streaming"
    assert 3 <= len(skin_lines) <= 4


def test_the_log_names_the_port(rigged: Callable[..., Rigged], logged: list[str]):
    """The log names the open port once. Without a port the log has no such line."""
    box = rigged(quiet())
    box.seconds(2)
    assert [line for line in logged if "serial" in line] == [f"serial: {box.port.name} open"]
    logged.clear()
    simulated = quiet()
    with ExitStack() as stack:
        settings = config.load(None, site=NO_SITE)
        alone = assembly.box(settings, bundle.load(bundle.DEFAULT), simulated, None, stack)
        while simulated.clock.now_ns() < 2 * SECOND:
            alone.step()
    assert "skin: streaming" in logged
    assert not [line for line in logged if "serial" in line or " open" in line]


class EffectLog(Observer):
    """Logs its calls under its name."""

    def __init__(self, name: str, effects: list[str]) -> None:
        self._name, self._effects = name, effects

    def answered(self, verdict: Verdict) -> None:
        """Note it."""
        self._effects.append(f"{self._name} answered {verdict.sweep}")

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Note it."""
        self._effects.append(f"{self._name} sweep {sweep.id} {circumstances['source']}")

    def turn(self, health: Health) -> None:
        """Log the call if a sweep was answered in this turn."""
        if self._effects and "turn" not in self._effects[-1]:
            self._effects.append(f"{self._name} turn {health.answered}")


def test_observers_are_called_in_order_and_sweeps_after_all_answers(rigged: Callable[..., Rigged]):
    """Two answers in one turn reach the port and each observer before any sweep is passed on;
    health comes last."""
    effects: list[str] = []
    box = rigged(quiet(), observers=[EffectLog("a", effects), EffectLog("b", effects), Observer()])
    box.seconds(0.5)
    for after_ms, level in ((100, True), (101, False), (102, True), (103, False)):
        box.edge(devices.STOP, after_ms / 1000, level)
    box.seconds(0.5)
    assert effects == [
        "a answered 1",
        "b answered 1",
        "a answered 2",
        "b answered 2",
        "a sweep 1 sim",
        "b sweep 1 sim",
        "a sweep 2 sim",
        "b sweep 2 sim",
        "a turn 2",
    ]
    assert [a.status for a in answers(box)] == ["no-start", "no-start"]

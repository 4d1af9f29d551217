"""The soak: the findings of its judge in records with one fault, its continuation after an
interruption, its page."""

from __future__ import annotations

import copy
import json
import re
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core import config
from palpate.core.sentences import sentence
from palpate.io.robot_link import StdoutPort
from palpate.runtime import assembly
from palpate.sim import devices, script, skin
from palpate.sim.rig import VirtualClock
from palpate_train.reports.plot_style import SCHEMES
from tests.factories.page_reader import PageReader
from tests.factories.paths import NO_SITE
from tests.rig import soak, soak_judge, soak_page
from tests.rig.soak_boxes import Gone, Reckoned, Script, ThisMachine, process
from tests.rig.soak_judge import SAMPLE

RATE = skin.FORMAT.rate_hz
SILENT_CPU_S, SILENT_S = 30, 300
"""Limits of the wait for a starting box. Its first sentence needs a second or two of processor
time, and any real time; but it fails if it gets no processor time at all for SILENT_S."""
LATEST_S = 60
"""The first answer comes after six seconds of the box's time."""
UNANSWERED, ORDER, LOST, DROPPED, WRONG, MEMORY, FILES = range(7)
"""Targets, as soak_judge.targets lists them."""


class FakeBox:
    """A box without faults and with its own clock, which each call of `heard` advances. change:
    alters its lines.

    dropped: frames that it has lost without reporting them, as a function of its time. runs: number
    of starts.
    """

    name = "this machine"

    def __init__(self, change: Callable[[str], list[str]] = lambda line: [line]) -> None:
        self.now_s, self.begun_s, self.runs, self.closed = 100.0, 0.0, 0, 0
        self.change, self.dropped = change, lambda s: 0
        self.mute_s = float("inf")

    def start(self, seed: int, sweeps: Script) -> None:
        """Begin."""
        self.begun_s, self.said, self.states, self.sweeps = self.now_s, 0, 0, sweeps
        self.runs += 1

    def clock(self) -> float:
        """Its time."""
        return self.now_s

    def heard(self, wait_s: float) -> list[tuple[float, str]]:
        """Its sentences in so many seconds."""
        self.now_s += wait_s
        if self.now_s > self.mute_s:
            return []
        lines = []
        while self.states < self.now_s - self.begun_s:
            frames = round(self.states * RATE) - self.dropped(self.states)
            state = sentence(
                "STA", self.states, "streaming", 0, self.said, frames, 0, 0, 1, 0, "b", "sim"
            )
            lines += self.changed(self.begun_s + self.states, state)
            self.states += 1
        while self.edges(self.now_s)[1] > self.said:
            self.said += 1
            lines += self.changed(self.now_s, self.answer("ok", self.sweeps[self.said].alone))
        return lines

    def answer(self, status: str, alone: str) -> bytes:
        """The RES of the sweep that was said last."""
        label = alone if alone in skin.MATERIALS else ""
        status = status if label else "unknown"
        return sentence(
            "RES", self.said, 1, status, label, 0.9, 0.8, 1, 0, 1.25, "b", "sim", "1.00", ""
        )

    def changed(self, at_s: float, line: bytes) -> list[tuple[float, str]]:
        """A line with its time, after `change`."""
        return [(at_s, new) for new in self.change(line.decode().strip())]

    def edges(self, at_s: float) -> tuple[int, int]:
        """Edges by its time and the script."""
        return self.sweeps.edges((at_s - self.begun_s) * RATE)

    def taken(self, at_s: float) -> float:
        """All frames of its time."""
        return (at_s - self.begun_s) * RATE

    def process(self) -> tuple[int, int, float, int, int]:
        """Always the same."""
        return 70_000, 60_000, self.now_s / 50, 8, 1

    def about(self) -> dict[str, object]:
        """Made up."""
        return {"what": "a made-up box", "machine": "none", "versions": {"python": "3"}}

    def stop(self) -> list[tuple[float, str]]:
        """The open sweep is aborted."""
        due, self.said = self.edges(self.now_s)[0], self.said + 1
        assert due == self.said, "stopped where it is not certain that a sweep has begun"
        aborted = sentence("RES", due, 1, "aborted", "", 0, 0, 0, 0, 0.1, "b", "sim", "1.00", "")
        return self.changed(self.now_s, aborted)

    def close(self) -> None:
        """Count the calls."""
        self.closed += 1


def soaked(box: FakeBox, length_s: float = 150) -> soak_judge.SoakRun:
    """A run of a box."""
    run = soak_judge.SoakRun(seed=1)
    soak.record(box, run, length_s, lambda: None, log=lambda line: None)
    return run


def sums(run: soak_judge.SoakRun) -> dict:
    """Sums of a run that was written to JSON and read."""
    return soak_judge.sums(json.loads(json.dumps({"runs": [soak.asdict(run)]})))


def missed(result: dict) -> list[int]:
    """Numbers of the targets that were not reached."""
    return [i for i, (*_, met) in enumerate(soak_judge.targets(result)) if met is False]


def on(number: int, new: Callable[[str], list[str]]) -> Callable[[str], list[str]]:
    """Change the answer with this number."""
    return lambda line: new(line) if line.startswith(f"$PPLP,RES,{number},") else [line]


def renumbered(line: str, number: int) -> str:
    """An answer with another number."""
    fields = line.split("*")[0].split(",")
    return sentence("RES", number, *fields[3:]).decode().strip()


@pytest.fixture(scope="module")
def clean() -> soak_judge.SoakRun:
    """A run in which nothing is wrong."""
    return soaked(FakeBox())


def test_a_box_without_fault_reaches_every_target(clean):
    """All sweeps are answered, the last as aborted; no loss, no fault; memory of three minutes is
    not judged."""
    result = sums(clean)
    assert result["due"] == result["answers"] > 40
    assert (
        result["cut"],
        result["unanswered"],
        result["faults"],
        result["unaccounted"],
        result["differs"],
    ) == (
        1,
        0,
        0,
        0,
        0,
    )
    assert (
        result["right"]["n"] + result["refused"]["n"] + result["wrong"]["n"]
        == result["answers"] - 1
    )
    assert [met for *_, met in soak_judge.targets(result)] == [True] * 5 + [None, True]
    assert clean.ended == "time"
    assert clean.length_s >= 150


def test_a_missing_answer_is_found():
    """A sweep without a sentence is unanswered, and the missing number is noted."""
    result = sums(soaked(FakeBox(on(17, lambda line: []))))
    assert result["unanswered"] == 1
    assert missed(result) == [UNANSWERED, ORDER]


def test_a_missed_start_edge_is_found():
    """A box that misses a start edge counts on without a gap, and has one answer too few at the
    end."""
    box = FakeBox()
    run = soaked(box)
    del run.answers[-1]
    result = sums(run)
    assert result["unanswered"] == 1
    assert missed(result) == [UNANSWERED]


def test_a_double_answer_is_found():
    """The same sentence twice is noted; the sweep is answered nevertheless."""
    result = sums(soaked(FakeBox(on(17, lambda line: [line, line]))))
    assert result["unanswered"] == 0
    assert missed(result) == [ORDER]


@pytest.mark.parametrize("number", [16, 18, 40])
def test_a_wrong_number_is_found(number):
    """An answer with the number of an earlier or later sweep is noted, and its own sweep has no
    answer."""
    result = sums(soaked(FakeBox(on(17, lambda line: [renumbered(line, number)]))))
    assert UNANSWERED in missed(result)
    assert ORDER in missed(result)


def test_a_number_too_many_makes_no_answer_wrong(clean):
    """Where a missed edge made two answers of one sweep, the later answers are compared with the
    material touched then."""

    def ahead(line: str) -> list[str]:
        number = int(line.split(",")[2]) if ",RES," in line else 0
        return [renumbered(line, number + 1)] if number >= 17 else [line]

    run = soaked(FakeBox(ahead))
    assert [row[2:] for row in run.answers] == [row[2:] for row in clean.answers]


def test_an_answer_that_nobody_asked_for_is_found():
    """A right number, but before the robot has sent the start edge."""
    run = soaked(FakeBox(on(17, lambda line: [line, renumbered(line, 18), renumbered(line, 19)])))
    assert "answer 19 came before its start edge" in run.faults[0][1]


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("$PPLP,STA,1,streaming,0,0,9,0,0,1,0,b,sim*00", "broken"),
        ("$PPLP,RES,1", "broken"),
        (
            sentence("STA", 9, "absent", 0, 0, 9, 0, 0, 1, 0, "b", "sim").decode().strip(),
            "the skin is absent",
        ),
    ],
)
def test_a_broken_sentence_and_a_lost_skin_are_noted(line, what):
    """A wrong checksum, half a sentence, a state other than streaming after frames have come."""
    run = soaked(FakeBox(on(3, lambda answer: [answer, line])), 30)
    assert [what in fault for _, fault in run.faults] == [True]


@pytest.mark.slow
def test_frames_that_nobody_counted_are_found():
    """Fifty frames that are gone without a word are a loss; a lag of fifty that is made up for is
    not."""
    box, late = FakeBox(), FakeBox()
    box.dropped = lambda s: 50 * (s > 70)
    late.dropped = lambda s: 50 * (30 < s < 80 or 115 < s < 135)
    result = sums(soaked(box))
    assert result["unaccounted"] == 50
    assert missed(result) == [LOST]
    assert missed(sums(soaked(late))) == []


def test_frames_out_of_nowhere_are_found():
    """A box that counts more frames than the board took has not accounted for them either."""
    box = FakeBox()
    box.dropped = lambda s: -50 * (s > 70)
    assert missed(sums(soaked(box))) == [LOST]


def test_wrong_verdicts_beyond_the_network_by_itself_are_found(clean):
    """A box that errs where its network does not leaves the expected band; refusals are not
    wrong."""
    result, refused = copy.deepcopy(clean), copy.deepcopy(clean)
    for row in result.answers[:12]:
        row[3], row[4] = "ok", next(m for m in skin.MATERIALS if m != row[2])
    for row in refused.answers[:12]:
        row[3], row[4] = "unknown", ""
    assert missed(sums(result)) == [WRONG]
    assert missed(sums(refused)) == []
    assert sums(refused)["differs"] > 0


@pytest.mark.parametrize(
    ("column", "target"), [("dropped", DROPPED), ("files", FILES), ("threads", FILES)]
)
def test_counters_that_grow_are_found(clean, column, target):
    """Dropped sentences, and growing numbers of files or threads, each miss their own target."""
    run = copy.deepcopy(clean)
    run.samples[-1][SAMPLE.index(column)] += 1
    assert missed(sums(run)) == [target]


def samples(rss_kib: np.ndarray, began_s: float = 0.0) -> dict:
    """A run with memory only, a sample every ten seconds."""
    return {
        "samples": [
            [began_s + 10.0 * i, float(k), 0, 0.0, 8, 1, 1, 0, 0, 1, 0, 0.0]
            for i, k in enumerate(rss_kib)
        ]
    }


def test_growing_memory_is_found_and_steady_memory_is_not():
    """Growth of 1 MiB an hour is found in an hour; the same noise without it is flat; the interval
    holds the truth."""
    noise = np.random.default_rng(1).normal(0, 40, 360)
    hours = np.arange(360) / 360
    grown, flat = (soak_judge.slope([samples(70_000 + noise + kib * hours)]) for kib in (1024, 0))
    assert grown["low"] < 1024 < grown["high"]
    assert grown["low"] > soak_judge.GROWTH_KIB_H > flat["high"]
    assert flat["low"] < 0 < flat["high"]


def test_the_interval_knows_that_neighbours_are_alike():
    """Steps that last for minutes widen the interval, compared with independent noise of the same
    size."""
    rng = np.random.default_rng(2)
    steps, noise = np.repeat(rng.normal(0, 40, 18), 20), rng.normal(0, 40, 360)
    wide, narrow = (soak_judge.slope([samples(70_000 + values)]) for values in (steps, noise))
    assert wide["high"] - wide["low"] > 3 * (narrow["high"] - narrow["low"])


def test_runs_have_a_level_each_and_one_slope():
    """A process that was started again on another level is not growth; two that grow are; two
    samples decide nothing."""
    flat = [samples(np.full(120, 70_000.0)), samples(np.full(120, 75_000.0), 1200)]
    grown = [samples(70_000 + np.arange(120)), samples(60_000 + np.arange(120), 1200)]
    assert soak_judge.slope(flat) | {"kib_h": 0.0, "low": 0.0, "high": 0.0} == soak_judge.slope(
        flat
    )
    assert soak_judge.slope(grown)["kib_h"] == pytest.approx(360)
    assert soak_judge.slope([samples(np.full(2, 7.0))])["high"] is None
    assert soak_judge.slope([])["high"] is None


def test_memory_is_judged_once_the_second_half_is_long_enough(clean):
    """An hour of growth misses the target, an hour without it reaches it."""
    for kib, met in ((1.0, False), (0.0, True)):
        run = copy.deepcopy(clean)
        row = run.samples[-1]
        run.samples = [[10.0 * i, 70_000 + kib * i, *row[2:]] for i in range(360)]
        assert [t[3] for t in soak_judge.targets(sums(run))][MEMORY] is met


def test_a_box_that_falls_silent_or_ends_is_noted_and_let_go():
    """After a minute without a word the run ends; the record is saved, and the box closed."""
    box, saved = FakeBox(), []
    box.mute_s = box.now_s + 40
    run = soak_judge.SoakRun(seed=1)
    soak.record(box, run, 3600, lambda: saved.append(len(run.answers)), log=lambda line: None)
    assert run.ended == "gone"
    assert "nothing for 60 s" in run.faults[-1][1]
    assert saved[-1] == len(run.answers) > 5
    assert box.closed == 1


@pytest.mark.slow
def test_a_soak_goes_on_where_it_was_interrupted(tmp_path):
    """The first run is kept as it was, a second run takes the rest with the next seed, a third has
    nothing to do."""
    box, lines = FakeBox(), []
    settings = {"log": lines.append}
    path = soak.soak(box, 7, 0.05, tmp_path, stopped=lambda: box.now_s > 170, **settings)
    first = json.loads(path.read_text())
    assert [run["ended"] for run in first["runs"]] == ["interrupted"]
    soak.soak(box, 7, 0.05, tmp_path, **settings)
    both = json.loads(path.read_text())
    assert both["runs"][0] == first["runs"][0]
    assert both["started"] == first["started"]
    assert [run["seed"] for run in both["runs"]] == [7, 8]
    assert both["runs"][1]["began_s"] == first["runs"][0]["length_s"]
    assert 180 <= sum(run["length_s"] for run in both["runs"]) < 190
    assert missed(soak_judge.sums(both)) == []
    soak.soak(box, 7, 0.05, tmp_path, **settings)
    assert box.runs == 2
    assert "are there already" in lines[-1]


def test_a_soak_that_is_killed_leaves_a_whole_record():
    """At any moment each sweep that is due has its answer, even if the run has not ended and a
    sweep is open."""
    box, run = FakeBox(), soak_judge.SoakRun(seed=1)
    recorder = soak.Recorder(box, run, Script(1))
    recorder.start()
    for _ in range(60):
        recorder.listen(1.0, lambda: False)
        assert missed(sums(run)) == []
    assert 10 < run.due < len(run.answers) + 2
    assert run.ended == ""


def test_another_seed_begins_anew(tmp_path):
    """Runs of other acts, code or machines are not joined."""
    box = FakeBox()
    settings = {"log": lambda line: None}
    soak.soak(box, 7, 0.01, tmp_path, **settings)
    path = soak.soak(box, 8, 0.01, tmp_path, **settings)
    assert [run["seed"] for run in json.loads(path.read_text())["runs"]] == [8]


def test_soaks_side_by_side_are_joined(tmp_path):
    """Runs follow each other in time, each with its own counters; faults of both count."""
    settings = {"log": lambda line: None}
    first, second = (
        json.loads(soak.soak(FakeBox(), seed, 0.05, tmp_path / str(seed), **settings).read_text())
        for seed in (7, 8)
    )
    second["runs"][0]["faults"].append([12.0, "made up"])
    both = soak.joined([first, second])
    assert both["runs"][0] == first["runs"][0]
    later_s = first["runs"][0]["length_s"]
    moved = both["runs"][1]
    assert moved["began_s"] == later_s
    assert moved["faults"] == [[round(12.0 + later_s, 2), "made up"]]
    for rows in ("answers", "samples"):
        assert [row[0] for row in moved[rows]] == [
            round(row[0] + later_s, 2) for row in second["runs"][0][rows]
        ]
    joined, alone = soak_judge.sums(both), [soak_judge.sums(record) for record in (first, second)]
    for name in ("hours", "due", "answers", "received", "faults"):
        assert joined[name] == pytest.approx(sum(one[name] for one in alone))
    assert joined["faults"] == 1


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"commit": "b" * 12}, "commit is 'bbbbbbbbbbbb' in one record"),
        ({}, "two runs have the seed 7"),
    ],
)
def test_soaks_that_do_not_belong_together_are_not_joined(tmp_path, other, message):
    """Different code, or the same sweeps twice."""
    record = json.loads(soak.soak(FakeBox(), 7, 0.01, tmp_path, log=lambda line: None).read_text())
    with pytest.raises(ValueError, match=message):
        soak.joined([record, record | other])


def test_drawing_names_what_does_not_belong_together(tmp_path, monkeypatch, capsys):
    """The command ends with the reason instead of a traceback, and draws nothing."""
    for folder in ("a", "b"):
        soak.soak(FakeBox(), 7, 0.01, tmp_path / folder, log=lambda line: None)
    works = ["--work", f"{tmp_path}/a", "--beside", f"{tmp_path}/b"]
    monkeypatch.setattr("sys.argv", ["soak", "--draw", *works, "--out", f"{tmp_path}/soak.json"])
    monkeypatch.setattr(soak, "BOXES", {FakeBox.name: FakeBox})
    with pytest.raises(SystemExit, match="2"):
        soak.main()
    assert "two runs have the seed 7" in capsys.readouterr().err
    assert not (tmp_path / "soak.json").exists()


def test_edges_and_frames_are_reckoned_from_the_first_sentences():
    """The first answer gives the start of the script, the first counted frames that of the board;
    before, edges and frames are zero."""
    sweeps = Script(1)
    robot = Reckoned(sweeps)
    assert robot.edges(1e9) == (0, 0)
    begun_s = 1000.0
    at = [begun_s + sweeps[k].stop / RATE for k in (1, 2)]
    robot.hear(
        begun_s + 1, sentence("STA", 1, "streaming", 0, 0, 750, 0, 0, 1, 0, "b", "sim").decode()
    )
    robot.hear(
        at[0], sentence("RES", 1, 1, "ok", "wood", 1, 1, 1, 0, 1, "b", "sim", "1.00", "").decode()
    )
    assert robot.edges(at[1] - 0.1) == (2, 1)
    assert robot.edges(at[1] + 0.1) == (2, 2)
    assert robot.taken(begun_s + 3) == pytest.approx(2250)


def test_a_slow_first_answer_does_not_move_the_others():
    """Each answer is compared with its own sweep if later answers are quicker; an answer with a
    wrong number shifts nothing."""
    sweeps, begun_s = Script(1), 1000.0
    robot = Reckoned(sweeps)
    for k, late_s in ((1, 0.12), (2, 0.03), (3, 0.001), (4, 0.02)):
        at_s = begun_s + sweeps[k].stop / RATE + late_s
        robot.hear(
            at_s,
            sentence("RES", k, 1, "ok", "wood", 1, 1, 1, 0, 1, "b", "sim", "1.00", "").decode(),
        )
        assert robot.edges(at_s)[1] == k
    at_s = begun_s + sweeps[5].stop / RATE
    robot.hear(
        at_s, sentence("RES", 7, 1, "ok", "wood", 1, 1, 1, 0, 1, "b", "sim", "1.00", "").decode()
    )
    assert robot.edges(at_s + 0.01)[1] == 5


def test_the_script_tells_what_is_touched_and_what_the_network_says():
    """Labels and edges are those of the simulator's acts; the network by itself is mostly right."""
    sweeps, acts = Script(3), list(script.tubes(3, 12))
    assert [sweeps[k].label for k in range(1, 13)] == [act.label for act in acts]
    assert [sweeps[k + 1].stop - sweeps[k + 1].start for k in range(12)] == [
        act.stop - act.start for act in acts
    ]
    assert sweeps[2].start == len(acts[0].frames) + acts[1].start
    assert sum(sweeps[k].alone == sweeps[k].label for k in range(1, 13)) >= 8


@pytest.mark.slow
def test_a_simulated_world_that_remembers_nothing_stays_as_large_as_it_is():
    """After twenty sweeps it holds one act and no written line; the script has ended, and its end
    is still known."""
    sim = devices.build(skin.FORMAT, script.tubes(1, 20), VirtualClock(), "sim", remember=False)
    with ExitStack() as stack:
        settings = config.load(None, [], site=NO_SITE)
        box = assembly.box(settings, bundle.load(bundle.DEFAULT), sim, StdoutPort("sim"), stack)
        while not sim.finished(box.answered):
            box.step()
    assert (sim.robot.acts, box.answered, len(sim.robot.played), len(sim.gpio.written)) == (
        20,
        20,
        1,
        0,
    )


def test_a_process_is_read_from_proc():
    """RSS and PSS in KiB, processor seconds, files and threads, also if the program's name has
    brackets and spaces."""
    stat = "12 (palpate (x) y) S " + " ".join(map(str, [*range(4, 14), 250, 50, 0, 0, 20, 0, 3, 0]))
    assert process("55 [rollup]\nRss:   70540 kB\nPss:  64586 kB\nPss_Dirty:  9 kB\n", stat, 8) == (
        70540,
        64586,
        3.0,
        8,
        3,
    )


def heard(box: ThisMachine) -> list[tuple[float, str]]:
    """The next sentences of a box.

    Raises AssertionError if none come although the box has used SILENT_CPU_S of processor time, or
    none for SILENT_S. A box that makes progress is waited for, however busy this machine is.
    """
    begun_s, begun_cpu_s = time.monotonic(), box.process()[2]
    while not (lines := box.heard(0.2)):
        used_s = box.process()[2] - begun_cpu_s
        assert used_s < SILENT_CPU_S, (
            f"the box has said nothing in {used_s:.1f} s of processor time"
        )
        assert used_s or time.monotonic() - begun_s < SILENT_S, (
            f"the box has done nothing for {SILENT_S} s"
        )
    return lines


def states(lines: list[tuple[float, str]]) -> int:
    """State sentences; a working box sends one each second."""
    return sum(line.startswith("$PPLP,STA,") for _, line in lines)


class Mute(FakeBox):
    """A box that sends nothing before sample number `from_look`, and uses this much processor time
    between two samples."""

    def __init__(self, step_s: float, from_look: int) -> None:
        super().__init__()
        self.step_s, self.from_look, self.looks, self.cpu_s = step_s, from_look, 0, 0.0

    def heard(self, wait_s: float) -> list[tuple[float, str]]:
        """Nothing, or a line."""
        self.looks += 1
        return [(0.0, "there")] if self.looks >= self.from_look else []

    def process(self) -> tuple[int, int, float, int, int]:
        """The processor time up to the present sample."""
        self.cpu_s += self.step_s
        return 1, 1, self.cpu_s, 1, 1


def test_a_box_that_gets_on_is_waited_for_and_no_other(monkeypatch: pytest.MonkeyPatch):
    """A box that uses much processor time and sends nothing has failed, as has a box that gets none
    for minutes. A box that gets a little each time is waited for, whatever the real time."""
    monkeypatch.setattr(sys.modules[__name__], "SILENT_S", 0.0)
    assert heard(Mute(SILENT_CPU_S / 1000, 500)) == [(0.0, "there")]
    with pytest.raises(AssertionError, match=f"said nothing in {SILENT_CPU_S}"):
        heard(Mute(SILENT_CPU_S / 10, 500))
    with pytest.raises(AssertionError, match="has done nothing for"):
        heard(Mute(0.0, 500))


@pytest.mark.slow
def test_this_machine_sweeps_answers_and_ends():
    """The installed command on a pseudo-terminal: an answer, a look at its process, and an orderly
    end."""
    box, sweeps, lines = ThisMachine(), Script(1), []
    try:
        box.start(1, sweeps)
        while not any(Answer.read(line) for _, line in lines):
            lines += heard(box)
            assert states(lines) < LATEST_S, (
                f"no answer in {LATEST_S} s of the box's time: {lines[-5:]}"
            )
        rss_kib, pss_kib, cpu_s, files, threads = box.process()
        assert 20_000 < rss_kib < 500_000
        assert 0 < pss_kib <= rss_kib
        assert cpu_s > 0
        assert files > 3
        assert threads >= 1
        assert next(filter(None, (Answer.read(line) for _, line in lines))).sweep == 1
        assert box.edges(time.monotonic())[1] >= 1
        box.stop()
        with pytest.raises(Gone, match="the box ended with 0"):
            box.heard(0)
    finally:
        box.close()


@pytest.fixture
def result(clean) -> dict:
    """Results of two boxes, the second interrupted and with a fault, a third left out."""
    run, other = soak.asdict(clean), soak.asdict(copy.deepcopy(clean))
    other["faults"] = [[3.0, "answer 7 came again"]]
    about = {
        "what": "a made-up box",
        "machine": "none",
        "versions": {"python": "3"},
        "commit": "abc",
        "seed": 1,
        "format": "4x4",
        "started": "2026-01-01T00:00:00+00:00",
    }
    boxes = {
        name: about | {"box": name, "runs": runs}
        for name, runs in (("this machine", [run]), ("virtual box", [other]))
    }
    return {
        "left_out": {"third box": "it was not there"},
        "boxes": {name: box | {"sums": soak_judge.sums(box)} for name, box in boxes.items()},
    }


def test_the_page_needs_nothing_else_and_tells_all(result):
    """Both boxes, every target, the fault and the parts left out; no address, no script; the
    picture is sound XML."""
    html, svg = soak_page.render(result)
    assert {e.tag.rpartition("}")[2] for e in ET.fromstring(svg).iter()} >= {
        "svg",
        "title",
        "path",
        "text",
    }
    assert not re.search(
        r"<script(?! type=\"application/json\")|<link|<img|@import|url\((?!#)|href=\"(?!#|\.\./)",
        html,
    )
    for text in (
        "this machine",
        "virtual box",
        "third box; it was not there",
        "answer 7 came again",
        "missed",
        "growth of memory",
        "too short to judge",
        "abc",
    ):
        assert text in html, text
    assert svg.replace(SCHEMES, "") in html
    assert len(svg) < 60_000
    text = PageReader(html).text
    assert re.search(r"This machine: \d of 7 targets reached\.", text)
    assert re.search(
        r"The virtual box: \d of 7 targets reached; missed: sentences out of order, broken or "
        r"missing, 1",
        text,
    )


def test_a_day_of_sweeps_stays_a_small_picture(result):
    """Of 25,000 sweeps the slowest of each group is drawn, and with it the slowest of all."""
    rows = result["boxes"]["this machine"]["runs"][0]["answers"]
    many = [[3.45 * i, i + 1, *rows[0][2:6], 1.5, 0] for i in range(25_000)]
    many[12_345][6] = 700.0
    result["boxes"]["this machine"]["runs"][0]["answers"] = many
    dots = soak_page.dots(result["boxes"]["this machine"])
    assert len(dots[0]) <= soak_page.DOTS
    assert max(dots[1]) == 700.0


def test_records_are_written_a_row_a_line_and_read_again(tmp_path):
    """The written record reads back the same, and a text with brackets is left alone."""
    content = {
        "runs": [{"samples": [[1.5, "a, b", None], [2, "[ c ]", 0]], "empty": [], "n": {"x": 1}}]
    }
    soak.write(tmp_path / "sub" / "x.json", content)
    text = (tmp_path / "sub" / "x.json").read_text()
    assert json.loads(text) == content
    assert '[1.5, "a, b", null]' in text


def test_draw_says_which_target_was_missed(tmp_path, clean, capsys):
    """Page, picture and results exist; the command fails because of one missed target, and names
    it."""
    record = {
        "box": "this machine",
        "what": "",
        "machine": "",
        "versions": {},
        "commit": "c",
        "seed": 1,
        "format": "f",
        "started": "now",
        "runs": [soak.asdict(clean)],
    }
    soak.write(tmp_path / "this-machine.json", record)
    results = tmp_path / "soak.json"
    assert soak.draw([tmp_path], results, tmp_path / "page")
    first = (tmp_path / "page" / "index.html").read_text()
    (tmp_path / "page" / "index.html").unlink()
    assert soak.draw([tmp_path / "no records"], results, tmp_path / "page")
    assert (tmp_path / "page" / "index.html").read_text() == first
    soak.write(tmp_path / "other" / "virtual-box.json", record | {"box": "virtual box"})
    assert soak.draw(
        [tmp_path / "other"], results, tmp_path / "page"
    )  # a box that was not recorded again keeps its record
    kept = json.loads(results.read_text())
    assert list(kept["boxes"]) == ["this machine", "virtual box"]
    record["runs"][0]["due"] += 1
    soak.write(tmp_path / "this-machine.json", record)
    assert not soak.draw([tmp_path], results, tmp_path / "page")
    assert "FAIL this machine  sweeps without an answer: 1" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "page").iterdir()} == {
        "index.html",
        "soak.svg",
    }

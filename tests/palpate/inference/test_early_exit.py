"""Early exit on simulated devices, with heads that can be computed by hand; and each failure."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from palpate.answer.early import Early, decides
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle, Manifest, Thresholds
from palpate.cli.main import main
from palpate.client.answers import Answer
from palpate.core.config import ClassifierConfig, SweepConfig
from palpate.core.types import SweepFormat, Verdict
from palpate.inference import classifier
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.io.robot_link import StdoutPort
from palpate.runtime.loop import Box
from palpate.sim import devices, gpio, rig, script, skin
from palpate.sweeps.capture import CaptureWriter, Playback
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories.settings import load as load_settings
from tests.factories.simulated_box import SECOND, SETTLE_S, OnSweep, Rigged
from tests.factories.toy_bundle import sweep_of

onnx = pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
helper = onnx.helper

FMT = SweepFormat(2, 2, 100.0, 100, "uint8")
STEPS, NEEDS, LEAD, SLIDE = 4, (20, 40, 60, 80), 10, 120
SETS = ("classifier.early=true", "sweep.lead_ms=100")
Make = Callable[..., Rigged]


def toy(least: tuple[float, ...] = (0.9,) * STEPS, agree: int = 1, early: bool = True) -> Bundle:
    """A bundle whose logit of "left" is a tenth of the left minus the right taxels' mean. The logit
    of "right" is 0. Head d gets the mean of exactly the frames of its step."""
    node, value = helper.make_node, helper.make_tensor_value_info
    nodes = [node("Cast", ["sweep"], ["float"], to=1), node("Reshape", ["float", "series"], ["x"])]
    for name in ("early", "logits"):
        nodes += [
            node("MatMul", [f"{name}_share", "x"], [f"{name}_mean"]),
            node("MatMul", [f"{name}_mean", "weights"], [f"{name}_flat"]),
            node("Reshape", [f"{name}_flat", f"{name}_shape"], [name]),
        ]
    frames = np.arange(FMT.window)
    constants = {
        "series": np.array([FMT.window, 4]),
        "early_share": np.float32([(frames < n) / n for n in NEEDS]),
        "logits_share": np.full((1, FMT.window), 0.01, np.float32),
        "weights": np.float32([[1, 0], [-1, 0], [1, 0], [-1, 0]]) / 20,
        "early_shape": np.array([1, STEPS, 2]),
        "logits_shape": np.array([1, 2]),
    }
    outputs = [value("logits", 1, [1, 2]), value("early", 1, [1, STEPS, 2])]
    graph = helper.make_graph(
        nodes,
        "toy",
        [value("sweep", onnx.TensorProto.UINT8, [1, FMT.window, 2, 2])],
        outputs[: 1 + early],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    rule = Early(least, agree) if early else None
    limits = Thresholds(5.0, 255.0)
    manifest = Manifest("toy", "1", FMT, "raw", ("left", "right"), limits, {}, early=rule)
    golden = slid(20)[None, LEAD : LEAD + FMT.window]
    return Bundle(manifest, "0" * 8, model.SerializeToString(), golden, np.float32([[2, 0]]))


def slid(*differences: int) -> np.ndarray:
    """A slide [SLIDE, 2, 2] with left minus right in each fifth; the last value holds."""
    diff = np.repeat(differences, FMT.window // 5)[: FMT.window]
    diff = np.concatenate([diff[:1].repeat(LEAD), diff, diff[-1:].repeat(SLIDE)])[:SLIDE]
    frames = np.full((SLIDE, 2, 2), 100)
    frames[:, :, 0] += diff[:, None]
    return (frames + np.arange(SLIDE)[:, None, None] % 2).astype(np.uint8)


def acts(*slides: np.ndarray, new_object: tuple[int, ...] = ()) -> list[rig.Act]:
    """Finger off, a slide from edge to edge, off; NEW OBJECT before these acts."""
    off = np.zeros((40, 2, 2), np.uint8)
    return [
        rig.Act(np.concatenate([off, s, off]), 40, 40 + SLIDE, "left", i in new_object)
        for i, s in enumerate(slides)
    ]


def simulated_slides(
    *slides: np.ndarray, stops: bool = True, packet_frames: int = 3, clock: Any = None, **more: Any
) -> devices.SimDevices:
    """Simulated devices on which the finger slides like this."""
    made = devices.build(
        FMT, acts(*slides, **more), clock or rig.VirtualClock(), "sim", stops=stops
    )
    made.backend.board = rig.ReadoutBoard(FMT, made.robot, made.clock, packet_frames=packet_frames)
    return made


def all_of(box: Rigged) -> list[Verdict]:
    """The verdicts until the robot has finished, and of two more seconds."""
    return box.until(lambda: box.simulated.finished(box.box.answered)) + box.seconds(2)


def answers(rigged: Make, *slides: np.ndarray, model: Bundle | None = None, **more: Any) -> list:
    """Summary of all answers to these slides, with early exit."""
    return summary(all_of(rigged(simulated_slides(*slides, **more), SETS, model or toy())))


def summary(verdicts: list[Verdict]) -> list[tuple[str, str, float]]:
    """Status, label and share of each."""
    return [(str(v.status), v.label, v.share) for v in verdicts]


def levels(simulated: devices.SimDevices, *names: str) -> list[tuple[str, bool]]:
    """The levels that were written to these lines, in order."""
    return [(name, level) for _, name, level in simulated.gpio.written if name in names]


@pytest.mark.parametrize(
    ("scores", "agree", "want"),
    [
        ([0.9], 1, True),
        ([0.89], 1, False),
        ([0.95, 0.85], 1, True),
        ([0.95, 0.79], 1, False),
        ([0.95], 2, False),
        ([0.6, 0.85], 2, True),
        ([0.4, 0.85], 2, False),
        ([0.4, 0.6, 0.99], 2, False),
        ([0.4, 0.6, 0.99, 1.0], 3, True),
        ([0.02], 1, True),
        ([np.nan], 1, False),
    ],
)
def test_the_rule(scores, agree, want):
    """The step's least probability and the same label in the last `agree` steps; above 1 never."""
    rule = Early((0.9, 0.8, 1.1, 0.5), agree)
    assert decides(np.array([[p, 1 - p] for p in scores]), rule) is want


def test_an_early_answer(rigged):
    """Left less right: -10, then 60. After 0.4 of the window the mean is 25, so sigmoid(2.5): more
    than 0.9. Where two steps must agree, the third answers: the first was "right"."""
    box = rigged(simulated_slides(slid(-10, 60)), SETS, toy())
    (verdict,) = all_of(box)
    assert summary([verdict]) == [("ok", "left", 0.4)]
    assert verdict.probability == pytest.approx(1 / (1 + np.exp(-2.5)), abs=1e-6)
    assert verdict.fused == 1
    assert 0 <= verdict.latency_ns < 1_000_000
    (answer,) = [a for a in map(Answer.read, box.heard) if a]
    assert (answer.status, answer.label, answer.share) == ("ok", "left", 0.4)
    assert answers(rigged, slid(-10, 60), model=toy(agree=2)) == [("ok", "left", 0.6)]


@pytest.mark.parametrize(("sets", "least"), [((), 0.9), (SETS, 1.1)])
def test_otherwise_the_answer_is_the_usual_one(rigged, sets, least):
    """Off or insufficient: the middle window, once, bit for bit."""
    (want,) = all_of(rigged(simulated_slides(slid(20, 20)), (), toy(early=False)))
    simulated = simulated_slides(slid(20, 20))
    (verdict,) = all_of(rigged(simulated, sets, toy((least,) * STEPS)))
    assert summary([verdict]) == [("ok", "left", 1.0)]
    assert verdict.scores.tobytes() == want.scores.tobytes()
    assert (devices.DECIDED, True) not in levels(simulated, devices.DECIDED)


def test_no_choice_widens_the_limits_of_early_answers(default_bundle, monkeypatch):
    """A strict one narrows them as those of whole sweeps; a loose one leaves them."""
    given, clock = mock.Mock(), rig.VirtualClock()
    monkeypatch.setattr(classifier, "EarlyDistances", given)
    for name in ("balanced", "loose", "strict"):
        EarlyExit(Classifier(default_bundle, clock, ClassifierConfig(strangers=name)))
    balanced, loose, strict = (call.args[1] for call in given.call_args_list)
    m = default_bundle.manifest
    assert balanced == loose == m.early.limits
    assert m.known.strict < m.known.balanced
    share = m.known.strict / m.known.balanced
    assert strict == pytest.approx([share * limit for limit in m.early.limits])


def test_the_robot_stops_and_is_faster(rigged):
    """Each touch is as short as its share, the packet, and 20 ms to react."""
    simulated = simulated_slides(slid(60), slid(-10, 60), slid(10))
    box = rigged(simulated, SETS, toy())
    verdicts = box.until(lambda: box.box.answered == 1)
    assert box.box.newest_frame().any()
    box.seconds(0.1)
    assert not box.box.newest_frame().any()
    shares = [0.2, 0.4, 1.0]
    assert summary(verdicts + all_of(box)) == [("ok", "left", s) for s in shares]
    touched = [a.stop - a.start for a in simulated.robot.played]
    assert all(LEAD + n < t <= LEAD + n + 6 for t, n in zip(touched[:2], NEEDS, strict=False))
    assert touched[2] == SLIDE
    assert box.box.counters.lost_frames == 0


def test_lines_change_in_order(rigged):
    """Sentence, class bits, RESULT VALID, then DECIDED with READY and BUSY, then the observers,
    since a disk may be slow; DECIDED falls when the next sweep starts."""
    simulated = simulated_slides(slid(60), slid(10))
    heard_before: list[bool] = []
    kept_after: list[bool] = []
    keep = OnSweep(lambda sweep, verdict: kept_after.append(bool(heard_before)))
    box = rigged(simulated, SETS, toy(), observers=[keep])
    stop = simulated.gpio.watchers[devices.DECIDED]

    def watch(t_ns: int) -> None:
        box.listen(SETTLE_S)
        heard_before.append(any(",RES,1," in line for line in box.heard))
        stop(t_ns)

    simulated.gpio.watchers[devices.DECIDED] = watch
    all_of(box)
    ready, busy, decided = devices.READY, devices.BUSY, devices.DECIDED
    valid, bit = devices.RESULT_VALID, devices.BITS[0]
    start, free = [(ready, False), (busy, True)], [(ready, True), (busy, False)]
    first = [(ready, True), *start, (bit, True), (valid, True), *free, (decided, True)]
    second = [(valid, False), *start, (decided, False), (valid, True), *free]
    assert levels(simulated, ready, busy, decided, valid, bit) == first + second
    assert heard_before == [True]
    assert kept_after == [True, True]


def test_a_start_edge_with_the_answer(rigged):
    """In the turn of an early answer the next sweep starts: RESULT VALID and DECIDED were high, and
    fall. Frame 69 comes with frame 89, and the finger still slides."""
    simulated = simulated_slides(slid(60), stops=False, packet_frames=30)
    box = rigged(simulated, SETS, toy())
    simulated.gpio.drive(devices.START, True, simulated.backend.board.frame_ns(85))
    box.until(lambda: box.box.answered == 1)
    lines = devices.RESULT_VALID, devices.DECIDED
    rose_and_fell = [(name, level) for level in (True, False) for name in lines]
    assert levels(simulated, *lines) == rose_and_fell
    assert summary(box.seconds(1)) == [("ok", "left", 0.2)]


def test_a_robot_that_slides_on_gets_no_second_answer(rigged):
    """The usual stop edge gives none; the next sweep is usual."""
    simulated = simulated_slides(slid(60), slid(60), stops=False)
    assert summary(all_of(rigged(simulated, SETS, toy()))) == [("ok", "left", 0.2)] * 2
    assert [a.stop - a.start for a in simulated.robot.played] == [SLIDE] * 2


@pytest.mark.parametrize("packet_frames", [1, 7, 30])
def test_how_frames_come_changes_nothing(rigged, packet_frames):
    """Single or packets over a step: the same scores bit for bit."""
    slides = slid(-10, 20, 60), slid(-10, -10, 60), slid(60)
    want = all_of(rigged(simulated_slides(*slides), SETS, toy()))
    have = all_of(rigged(simulated_slides(*slides, packet_frames=packet_frames), SETS, toy()))
    assert summary(have) == summary(want) == [("ok", "left", s) for s in (0.6, 0.8, 0.2)]
    assert [v.scores.tobytes() for v in have] == [v.scores.tobytes() for v in want]


def test_one_run_of_the_graph_at_each_step(rigged, monkeypatch):
    """Four times, or two for step two; the newest frame completes it."""
    asked: list[int] = []
    rests: list[np.ndarray] = []
    heads = Classifier.outputs

    def watched(self: Classifier, taxels: np.ndarray, *outputs: str) -> list[np.ndarray]:
        if "early" in outputs:
            asked.append(box.box.answered)
            rests.append(taxels[NEEDS[-1] :])
        return heads(self, taxels, *outputs)

    monkeypatch.setattr(Classifier, "outputs", watched)
    box = rigged(simulated_slides(slid(10), slid(-10, 60)), SETS, toy())
    all_of(box)
    assert asked == [0] * 4 + [1] * 2
    assert all((rest == rest[0]).all() and rest.all() for rest in rests)


@pytest.mark.parametrize("fault", ["saturated", "stuck-taxel", "dead-taxel", "no-contact", ""])
def test_a_spoiled_skin_is_not_decided_early(rigged, fault):
    """The whole sweep reports the fault; without it, it is early."""

    def spoiled(fault: str) -> np.ndarray:
        """A slide that is clear to the toy, on a faulty skin."""
        frames = slid(60)
        if fault == "saturated":
            frames[:, :, 0] = 255 - (np.arange(SLIDE) % 4 == 0)[:, None]
        elif fault == "stuck-taxel":
            frames[:, 1, 0] = 200
        elif fault == "dead-taxel":
            frames[:, 1, 1] = 0
        elif fault == "no-contact":
            frames = frames // 50
        return frames

    want = [(fault, "", 1.0)] if fault else [("ok", "left", 0.2)]
    assert answers(rigged, spoiled(fault), model=toy((0.5,) * STEPS)) == want


def test_a_taxel_that_moves_late_is_no_fault(rigged):
    """Constant in the first step, varying in the second: no answer there, an answer here."""
    frames = slid(60)
    frames[: LEAD + NEEDS[0], 0, 0] = 160
    assert answers(rigged, frames) == [("ok", "left", 0.4)]


def test_a_tare_counts():
    """With a tare as high as the load neither the early nor the whole sweep has contact."""
    classifier = Classifier(toy(), rig.VirtualClock())
    decider = EarlyExit(classifier)
    sweep = sweep_of(slid(60)[:20], share=0.2)
    assert decider(sweep) is not None
    classifier.tare = np.full((2, 2), 200.0)
    assert decider(sweep) is None


@pytest.mark.parametrize(
    ("at", "lost", "counted", "want"),
    [
        (30, 2, 2, ("ok", "left", 0.4)),
        (NEEDS[1] - 1, 2, 1, ("ok", "left", 0.4)),  # the other one is the next step's
        (30, 3, 3, ("gap", "", 1.0)),
        (NEEDS[1] - 1, 3, 3, ("gap", "", 1.0)),
        (NEEDS[1], 3, 0, ("ok", "left", 0.4)),
    ],
)
def test_missing_frames(rigged, at, lost, counted, want):
    """Two lost ones, also at a step's end, are interpolated; a wider gap prevents it."""
    simulated = simulated_slides(slid(-10, 60), packet_frames=1)
    count = itertools.count(-40 - LEAD - at)
    simulated.backend.mangle = lambda data: b"" if 0 <= next(count) < lost else data
    box = rigged(simulated, SETS, toy())
    assert summary(all_of(box)) == [want]
    assert [s.lost for s in box.kept] == [counted]


@pytest.mark.parametrize(
    ("what", "want"),
    [
        ("unplug", []),
        ("start", ["ok"]),  # the finger still slides: a sweep with an early answer of its own
        ("abort", []),
        ("lost", ["edges-lost"]),
        ("stop", ["no-start"]),  # the edge of the slide's end has no start any more
    ],
)
def test_what_goes_wrong_after_the_answer(rigged, what, want):
    """Unplugging, another start, abort, lost edges: no other answer."""
    simulated = simulated_slides(slid(60), stops=False)
    box = rigged(simulated, SETS, toy())
    verdicts = box.until(lambda: box.box.answered == 1)
    if what == "unplug":
        simulated.backend.unplug()
    elif what == "abort":
        assert "sweep" in box.ask("$PPLP,ABORT")
    elif what == "lost":
        for i in range(3000):
            box.edge(devices.START, 0.1 + i * 1e-4, i % 2 == 0)
    else:
        box.pulse(devices.START if what == "start" else devices.STOP, 0.1)
    assert summary(verdicts) == [("ok", "left", 0.2)]
    assert [str(v.status) for v in box.seconds(3)] == want


def test_what_goes_wrong_before_the_answer(rigged):
    """Unplugged in a sweep: `sensor-lost` at once, and no early answer after it is plugged in
    again. If the start edge comes while the skin is away, the clear slide is `not-ready`."""
    simulated = simulated_slides(slid(-10, 60), stops=False)
    box = rigged(simulated, SETS, toy())
    box.until(lambda: box.box.format == FMT and ("BUSY", True) in levels(simulated, "BUSY"))
    now = simulated.clock.now_ns()
    simulated.backend.at(now + SECOND // 4, simulated.backend.unplug)
    simulated.backend.at(now + SECOND // 2, simulated.backend.plug)
    assert [str(v.status) for v in all_of(box)] == ["sensor-lost"]
    simulated = simulated_slides(slid(60), stops=False)
    box = rigged(simulated, SETS, toy())
    start = simulated.backend.board.frame_ns(40)
    simulated.backend.at(start - SECOND // 10, simulated.backend.unplug)
    simulated.backend.at(start + SECOND // 20, simulated.backend.plug)
    assert [str(v.status) for v in all_of(box)] == ["not-ready"]


def test_an_early_answer_counts_as_one_sweep_of_its_object(rigged):
    """Fused 1, 2, 3, with the product."""
    simulated = simulated_slides(slid(60), slid(20), slid(30), new_object=(0,))
    verdicts = all_of(rigged(simulated, SETS, toy()))
    assert [(v.fused, v.share) for v in verdicts] == [(1, 0.2), (2, 1.0), (3, 0.2)]
    logits = np.cumsum([6.0, 2.0, 3.0])
    assert [v.probability for v in verdicts] == pytest.approx(1 / (1 + np.exp(-logits)), abs=1e-6)


def test_without_ok_the_sweep_goes_on(rigged):
    """Not early below `min_probability`; fused with the next, it is."""
    simulated = simulated_slides(slid(30), slid(30), new_object=(0,))
    verdicts = all_of(rigged(simulated, (*SETS, "classifier.min_probability=0.99"), toy()))
    found = [(str(v.status), v.fused, v.share) for v in verdicts]
    assert found == [("unsure", 1, 1.0), ("ok", 2, 0.2)]


@pytest.mark.slow
@pytest.mark.parametrize("packet_frames", [1, 30])
def test_a_capture_gives_the_same_answers(rigged, tmp_path, packet_frames):
    """Lost packets, any answer, a stop edge near the last step."""

    class Ticking(rig.VirtualClock):
        """Each call takes a microsecond, so that events of one turn have different times."""

        def now_ns(self) -> int:
            """A little later than before."""
            self.sleep_until(super().now_ns() + 1000)
            return super().now_ns()

    rng, model = np.random.default_rng(7), toy((0.97, 0.95, 0.93, 0.7))
    slides = [slid(*rng.integers(-30, 50, 5)) for _ in range(20)]
    simulated = simulated_slides(
        *slides, stops=False, packet_frames=packet_frames, clock=Ticking(), new_object=(5, 9)
    )
    played = acts(*slides, new_object=(5, 9))
    for i in range(10, 20):
        played[i] = replace(played[i], stop=played[i].start + LEAD + NEEDS[-1] + i - 12)
    simulated.robot._script = iter(played)
    simulated.backend.mangle = lambda data: b"" if rng.random() < 0.03 / packet_frames else data
    capture = CaptureWriter(tmp_path / "capture", FMT)
    box = rigged(simulated, SETS, model, capture=capture)
    first = all_of(box)
    capture.close()
    play = Playback(tmp_path / "capture")
    classifier = Classifier(model, play, load_settings(SETS).classifier)
    again, kept = [], []
    cutter = SweepCutter(FMT, SweepConfig(lead_ms=100))
    replayed = Box(
        *(play, play, cutter, classifier, play),
        early=EarlyExit(classifier),
        port=StdoutPort(play.commands),
        observers=[OnSweep(lambda sweep, verdict: kept.append(sweep))],
    )
    while not play.finished:
        again += replayed.step()
    assert {v.share for v in first} >= {0.4, 0.6, 1.0}
    assert len(first) == 20

    def all_values(v: Verdict) -> tuple[object, ...]:
        return v.sweep, v.fused, v.lost, v.scores.tobytes(), *summary([v])

    assert list(map(all_values, again)) == list(map(all_values, first))
    counts, want = ([s.frames.taxels.tobytes() for s in of] for of in (kept, box.kept))
    assert counts == want


def recorded(path: Path, windows: np.ndarray) -> Path:
    """A set of sweeps of "left", as `palpate run --sim` takes it."""
    labels, materials = [0] * len(windows), ["left", "right"]
    np.savez(path, samples=windows, labels=labels, materials=materials, rate_hz=100.0)
    return path


def test_the_command_replays_what_it_decided(tmp_path, capsys):
    """`run` with a capture and kept sweeps, then `replay` of each."""
    model, folder = toy(), tmp_path / "toy"
    folder.mkdir()
    golden = bundle.golden_file(model.golden, model.golden_logits)
    (folder / bundle.GOLDEN).write_bytes(golden)
    (folder / bundle.MODEL).write_bytes(model.model)
    names = bundle.MODEL, bundle.GOLDEN
    files = {n: bundle.file_entry((folder / n).read_bytes()) for n in names}
    (folder / bundle.MANIFEST).write_bytes(replace(model.manifest, files=files).json())
    windows = [slid(*d)[LEAD : LEAD + FMT.window] for d in ((60,), (10,), (-10, 60))]
    played = recorded(tmp_path / "s.npz", np.stack(windows))
    sets = [f"classifier.bundle={folder}", "classifier.early=true", f"store.folder={tmp_path}"]
    sets += ["store.black_box=9"]

    def printed(*args: str) -> list[list[str]]:
        assert main([*args, *(part for text in sets for part in ("--set", text))]) == 0
        lines = capsys.readouterr().out.splitlines()
        answers = [line.split(",") for line in lines if ",RES," in line]
        return [[a[2], *a[4:10], a[13]] for a in answers]

    capture = str(tmp_path / "capture")
    first = printed("run", "--sim", f"replay:{played}", "--virtual", "--capture", capture)
    assert [(a[1], a[-1]) for a in first] == [("ok", "0.20"), ("ok", "1.00"), ("ok", "0.40")]
    assert printed("replay", capture) == first
    kept = sorted((tmp_path / "black-box").glob("*.npy"))
    assert [printed("replay", str(path))[0] for path in kept] == first


def test_a_set_is_played_so_that_early_answers_see_it(tmp_path):
    """`sweep.lead_ms` after the start edge, in the middle."""
    windows = np.random.default_rng(0).integers(0, 256, (2, 100, 2, 2)).astype(np.uint8)
    played = script.load(recorded(tmp_path / "s.npz", windows), FMT)
    for act, window in zip(script.play(played, range(2)), windows, strict=True):
        first = act.start + round(SweepConfig().lead_ms / 1000 * FMT.rate_hz)
        assert (act.frames[first:][:100] == window).all()
        assert (act.start + act.stop) // 2 - 50 == first


def test_the_simulated_robot_stops_once():
    """Scheduled edges are cancelled, the stop edge comes after the reaction, frames are omitted.
    DECIDED just before the end of a slide changes nothing."""

    def started() -> tuple[rig.Robot, gpio.SimGpio]:
        lines = gpio.SimGpio(rig.VirtualClock(0), {"/dev/gpiochip0": ["START", "STOP"]})
        return rig.Robot(iter(acts(slid(60))), lines), lines

    robot, lines = started()
    robot.react(0)
    assert robot.skipped is None
    robot.next_act(100, lambda i: i * 10_000_000)
    start_ns = 140 * 10_000_000
    robot.react(start_ns + 300_000_000)
    robot.react(start_ns + 400_000_000)
    assert robot.skipped == (100 + 40 + 32, 100 + 40 + SLIDE)
    planned = sorted((t_ns - start_ns, name, level) for t_ns, _, name, level in lines._plan)
    assert planned[2:] == [(320_000_000, "STOP", True), (340_000_000, "STOP", False)]
    assert (robot.played[0].stop, len(robot.played[0].frames)) == (72, 40 + 32 + 40)
    robot, _ = started()
    robot.next_act(0, lambda i: i * 10_000_000)
    robot.react(159 * 10_000_000)
    assert (robot.skipped, robot.played[0].stop) == (None, 40 + SLIDE)


@pytest.mark.parametrize("hz", [(50,), (50, 150), (100, 200)], ids=["sine", "odd", "rectifier"])
@pytest.mark.slow
def test_hum_costs_hardly_an_early_answer(default_bundle, hz):
    """Unfinished sweeps pass the stages of whole ones: with hum of 8 counts as many of 12 slides
    are answered early as without, and none with a wrong label. More hum than was tried is
    answered by neither."""
    box = Classifier(default_bundle, rig.VirtualClock())
    early, labels = EarlyExit(box), default_bundle.manifest.labels
    slides = [
        (label, skin.window(label, skin.Placement(), np.random.default_rng(seed), skin.LEVEL_BLIND))
        for seed in (1, 2)
        for label in labels
    ]
    sines = [np.sin(2 * np.pi * one * np.arange(1500) / 750 + one) for one in hz]
    wave = sum(sines) / len(hz) ** 0.5

    def answered(counts: float) -> list[bool]:
        """Whether each slide that is answered early gets its label."""
        given = []
        for label, window in slides:
            hummed = (window + counts * np.reshape(wave, (-1, 1, 1))).round().clip(0, 255)
            for step in range(1, early.steps + 1):
                taxels = hummed[: 150 * step].astype(np.uint8)
                if verdict := early(sweep_of(taxels, share=step / 10)):
                    given.append(verdict.label == label)
                    break
        return given

    without, with_hum = answered(0), answered(8)
    assert all(with_hum)
    assert len(with_hum) >= len(without) - 1
    assert answered(40) == []

"""The room where what was seen once is judged again. In: a capture, a kept sweep, a folder of them. Out: its sentences.

A kept sweep is judged as it was: by the same rule, with the same tare, after the same sweeps of its object, at the same
time. So its verdict must be that of its sidecar, bit for bit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import Bundle
from appliance.core.config import ClassifierConfig, Config
from appliance.core.errors import FormatError
from appliance.core.schema import typed
from appliance.core.types import Status, Sweep, SweepFormat, Verdict, load, sidecar
from appliance.inference.classifier import Classifier
from appliance.inference.early_exit import Decider
from appliance.io.robot_link import StdoutPort, result
from appliance.recording.capture import Playback
from appliance.recording.sweep_window import SweepCutter
from appliance.runtime import assembly
from appliance.runtime.loop import Box, Pipeline

SAME, ALONE, DIFFERENT = "the same", "the same by itself", "DIFFERENT"
"""Bit for bit; so are the scores of this sweep, but not all earlier ones of its object are there; it is not."""
SILENT, OTHER, BROKEN = "no verdict to compare with", "of another bundle", "not readable"
FUSIONS = get_args(get_type_hints(ClassifierConfig)["fuse"])


class OtherBundle(FormatError):
    """A kept sweep that another bundle has judged."""


def replay(path: Path, settings: Config, model: Bundle, out: Callable[[str], object]) -> int:
    """Play what is at `path` and tell all sentences, and of each kept sweep whether its verdict is the same; 1 if not.

    Raises FormatError where it is not readable, of another format or of another bundle.
    """
    if path.is_dir():
        return _folder(path, Judge(settings, model), out)
    if path.suffix != ".npy":
        _capture(path, settings, model)
        return 0
    judge = Judge(settings, model)
    *_, judged = [judge(kept) for kept in _with_earlier(path)]
    return int(_tell(path, judged, out) == DIFFERENT)


@dataclass(frozen=True, slots=True)
class ReplayRule:
    """How a classifier makes answers of probabilities, under the names that sidecars have."""

    how: str
    sure: float
    most_sweeps: int

    def __post_init__(self) -> None:
        if self.how not in FUSIONS:
            raise TypeError(f"rule {self.how!r} is none of {', '.join(FUSIONS)}")


@dataclass(frozen=True, slots=True)
class Kept:
    """A kept sweep with what its sidecar says; an older one says less.

    object: whose sweeps were fused. rule: None where it is not told. tare: [R, C] digits. bundle: its id or "".
    verdict: as `Verdict.as_dict` gives it, or empty.
    """

    sweep: Sweep
    format: SweepFormat
    object: tuple[Path, int, int]
    rule: ReplayRule | None
    tare: NDArray[np.float64]
    bundle: str
    verdict: dict[str, Any]

    @classmethod
    def read(cls, path: Path) -> Kept:
        """The sweep at `path`. Raises FormatError."""
        sweep, fmt = load(path)
        about = sidecar(path)
        try:
            tare = np.broadcast_to(np.asarray(about.get("tare", 0.0), np.float64), (fmt.rows, fmt.cols))
            rule = typed(ReplayRule, about["rule"]) if "rule" in about else None
            whose = path.parent, int(about.get("run", 0)), sweep.object
            verdict = dict(about.get("verdict", {}))
            if any(type(verdict.get(name, 0)) is not int for name in ("fused", "time_ns")):
                raise TypeError("the verdict's fused and time_ns must be whole numbers")
            return cls(sweep, fmt, whose, rule, tare, about.get("bundle", ""), verdict)
        except (TypeError, ValueError) as e:
            raise FormatError(f"{path}: its sidecar cannot be used: {e}; take one that was not changed") from e


@dataclass(frozen=True, slots=True)
class Judged:
    """What came of a kept sweep. verdict: None where there is none any more."""

    verdict: Verdict | None
    outcome: str
    detail: str = ""


class Then:
    """A clock that stands where it is put: a verdict is given again at the time at which it was given."""

    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        """The time it was put to."""
        return self.t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Nothing here waits."""


class Judge:
    """Judges kept sweeps, given in their order, again. Holds what the sweeps of one object have said so far."""

    def __init__(self, settings: Config, model: Bundle) -> None:
        self._settings, self._model = settings, model
        self._clock = Then()
        self._classifier: Classifier | None = None
        self._made: object = None  # what the classifier was made for
        self._last: object = None  # (object, sweeps fused) of the last sweep with all earlier ones of its object

    def __call__(self, kept: Kept) -> Judged:
        """The verdict on `kept`, and whether it is that of its sidecar. Raises FormatError where it is not of the bundle."""
        if kept.bundle not in ("", self._model.id):
            raise OtherBundle(
                f"sweep {kept.sweep.id} was judged by bundle {kept.bundle}, this is {self._model.id}; "
                "name its own with --set classifier.bundle=DIR"
            )
        _check(f"sweep {kept.sweep.id}", kept.format, self._model)
        _check_length(kept.sweep, kept.format)
        was = kept.verdict
        fused = was.get("fused", 0)
        whole = fused <= 1 or self._last == (kept.object, fused - 1)
        if fused and whole:
            self._last = kept.object, fused
        classifier = self._prepared(kept)
        sweep = kept.sweep if whole else replace(kept.sweep, object=0)
        verdict = classifier(sweep) if sweep.share == 1 else Decider(classifier)(sweep)
        if not whole:
            own = verdict.own if verdict else Decider(classifier).scores(sweep)[-1]
            same = own.tolist() == was.get("own")
            return Judged(verdict, ALONE if same else DIFFERENT, "earlier sweeps of its object are not there")
        if verdict is None:
            return Judged(verdict, DIFFERENT, "it was answered early, which this bundle does not do")
        if not was:
            return Judged(verdict, SILENT)
        now = verdict.as_dict()
        changed = [_change(name, was[name], now.get(name)) for name in was if was[name] != now.get(name)]
        return Judged(verdict, DIFFERENT if changed else SAME, ", ".join(changed))

    def _prepared(self, kept: Kept) -> Classifier:
        """The classifier as it was, with what it has fused in this run."""
        made = kept.object[:2], kept.rule
        if self._classifier is None or made != self._made:
            self._made = made
            if kept.rule:
                self._classifier = Classifier(self._model, self._clock, *astuple(kept.rule))
            else:
                self._classifier = assembly.classifier(self._settings, self._model, self._clock)
        self._classifier.tare = kept.tare
        self._clock.t_ns = kept.verdict.get("time_ns", kept.sweep.complete_ns)
        return self._classifier


def _change(name: str, was: object, now: object) -> str:
    return f"other {name}" if isinstance(was, list) else f"{name} {was!r} is now {now!r}"


def _tell(path: Path, judged: Judged, out: Callable[[str], object]) -> str:
    if judged.verdict:
        out(result(judged.verdict, "replay").decode("ascii"))
    out(f"{path.name}: {judged.outcome}{judged.detail and f' ({judged.detail})'}\n")
    return judged.outcome


def _folder(folder: Path, judge: Judge, out: Callable[[str], object]) -> int:
    """All kept sweeps in `folder` and below. Those of another bundle are told, and no difference."""
    outcomes: Counter[str] = Counter()
    paths = sorted(folder.rglob("*.npy"), key=_order)
    if not paths:
        raise FormatError(f"{folder}: no kept sweep is there; name a folder of `palpate record` or of the black box")
    for path in paths:
        try:
            judged = judge(Kept.read(path))
        except FormatError as e:  # the others may be whole
            judged = Judged(None, OTHER if isinstance(e, OtherBundle) else BROKEN, str(e))
        outcomes[_tell(path, judged, out)] += 1
    out(f"{len(paths)} sweeps: {', '.join(f'{n} {outcome}' for outcome, n in outcomes.items())}\n")
    return int(bool(outcomes.keys() & {DIFFERENT, BROKEN}) or outcomes[OTHER] == len(paths))


def _order(path: Path) -> tuple[Path, int, str]:
    return path.parent, len(path.name), path.name


def _with_earlier(path: Path) -> list[Kept]:
    """The sweep at `path`, after those of its object that lie beside it. Raises FormatError."""
    found = [Kept.read(path)]
    if found[0].sweep.object:
        for earlier in sorted((p for p in path.parent.glob("*.npy") if _order(p) < _order(path)), key=_order)[::-1]:
            kept = Kept.read(earlier)
            if kept.object != found[0].object:
                break
            found.insert(0, kept)
    return found


def _check(what: str, fmt: SweepFormat, model: Bundle) -> None:
    if fmt != model.format:
        raise FormatError(
            f"{what} is of {fmt}, the bundle wants {model.format}; name its bundle with --set classifier.bundle=DIR"
        )


def _check_length(sweep: Sweep, fmt: SweepFormat) -> None:
    n = len(sweep.frames)
    if sweep.status is Status.OK and not (n == fmt.window if sweep.share == 1 else 0 < n < fmt.window):
        raise FormatError(
            f"sweep {sweep.id} has {n} frames, share {sweep.share}, of {fmt}; take one that was not changed"
        )


def _capture(path: Path, settings: Config, model: Bundle) -> None:
    """The box itself on a capture: what came in then comes in again."""
    play = Playback(path)
    _check(str(path), play.format, model)
    classifier = assembly.classifier(settings, model, play)
    port = StdoutPort("replay", play.commands)
    cutter = SweepCutter(model.format, settings.sweep)
    pipeline = Pipeline(play, play, cutter, classifier, assembly.early_exit(settings, classifier))
    Box(pipeline, play, port=port, source="replay").run(lambda: play.finished)

"""Classifies recorded data again (captures, kept sweeps, folders of sweeps) and compares the
verdicts.

A kept sweep is classified under its original conditions: the same rule, tare, time, and previous
sweeps of its object. So the verdict must equal the verdict in its sidecar, bit for bit.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.taxels import BrokenTaxels
from palpate.bundle import bundle as bundle_files
from palpate.bundle.bundle import GOLDEN_TOLERANCE, Bundle
from palpate.core import config
from palpate.core.config import ClassifierConfig, Config
from palpate.core.errors import FormatError
from palpate.core.schema import typed
from palpate.core.text import printable, say
from palpate.core.types import Status, Sweep, SweepFormat, Verdict
from palpate.deployment.release_trial import OTHERWISE
from palpate.inference.classifier import RULE, Classifier, EarlyExit
from palpate.io.robot_link import StdoutPort, result
from palpate.runtime.loop import Box
from palpate.sweeps.capture import Playback
from palpate.sweeps.sweep_folder import RecordedSweep, number_of
from palpate.sweeps.sweep_window import SweepCutter
from palpate.sweeps.unknown_sweeps import ALIKE

SAME, ALONE, DIFFERENT = "the same", "the same by itself", "DIFFERENT"
"""Outcomes of a comparison. SAME: the verdict is the same, bit for bit. ALONE: the scores of this
sweep are the same, but earlier sweeps of its object, or one that it resembles, are missing."""
SILENT, OTHER, BROKEN = "no verdict to compare with", "of another bundle", "not readable"
LATEST = 500
"""Number of the latest sweeps that a new release must answer as before."""
MOST_SHIFT, FEWEST_SHIFTED = 0.1, 10
"""Largest change of the logarithms of probabilities that half of the sweeps may have, and least
number of sweeps. Where counts are read 2 % too high, which costs 2.5 points, 3 % of 240 simulated
sweeps get another answer, and half of them are shifted by 0.19 or more. Onnxruntime 1.27 to 1.32
and numpy 2.0 to 2.3 shift none."""
CLASSIFIED = {status for status in Status if status.classified}


class OtherBundle(FormatError):
    """A kept sweep that another bundle has classified."""


def replay(path: Path, settings: Config, bundle: Bundle, out: Callable[[str], object]) -> int:
    """Replay the file or folder at `path`: write its sentences, and for each kept sweep whether the
    verdict is the same. out: called with each line. Returns 1 if a verdict differs, else 0. Raises
    FormatError for an unreadable file, another format or another bundle."""
    if path.is_dir():
        return _folder(path, SweepReplay(settings, bundle), out)
    if path.suffix != ".npy":
        _capture(path, settings, bundle)
        return 0
    classify = SweepReplay(settings, bundle)
    *_, last = [classify(kept) for kept in _with_earlier(path)]
    return int(_print(path, last, out) == DIFFERENT)


@dataclass(frozen=True, slots=True, eq=False)
class KeptSweep:
    """A kept sweep with the content of its sidecar; without a bundle it has fewer entries.

    object: the folder, run and object number that fused sweeps share. rule: the settings at the
    time of the sweep, None without an entry.
    tare: [R, C] or [R, C, A] raw counts, None without an entry. bundle: its id, or "". verdict: as
    `Verdict.as_dict` returns it, or empty. broken: taxels that were broken over the stream.
    """

    sweep: Sweep
    format: SweepFormat
    object: tuple[Path, int, int]
    rule: ClassifierConfig | None
    tare: NDArray[np.float64] | None
    bundle: str
    verdict: dict[str, Any]
    broken: BrokenTaxels | None = None

    @classmethod
    def read(cls, path: Path) -> KeptSweep:
        """The sweep at `path`. Raises FormatError."""
        recorded = RecordedSweep.load(path, {})
        sweep, format, about = recorded.sweep, recorded.format, recorded.about
        try:
            tare = np.asarray(about["tare"], np.float64) if "tare" in about else None
            tare = None if tare is None else np.broadcast_to(tare, format.shape)
            rule = _rule(about["rule"]) if "rule" in about else None
            touched = path.parent, int(about.get("run", 0)), sweep.object
            verdict = dict(about.get("verdict", {}))
            if any(type(verdict.get(name, 0)) is not int for name in ("fused", "after", "time_ns")):
                raise TypeError("the verdict's fused, after and time_ns must be whole numbers")
            broken = BrokenTaxels.read(about.get("broken"), format)
            return cls(sweep, format, touched, rule, tare, about.get("bundle", ""), verdict, broken)
        except (TypeError, ValueError) as e:
            raise FormatError(
                f"{path}: its sidecar cannot be used: {e}; use a sweep that was not changed"
            ) from e


def _rule(held: Any) -> ClassifierConfig:
    """Raises TypeError for an unknown choice, or for other keys."""
    if not isinstance(held, dict) or held.keys() != {*RULE}:
        raise TypeError(f"rule {held!r} does not have {', '.join(RULE)}")
    return typed(ClassifierConfig, held)


@dataclass(frozen=True, slots=True, eq=False)
class ReplayResult:
    """The result for a kept sweep. verdict: None if the replay gives no verdict. alone: its own
    probabilities, if earlier sweeps of its object are missing: its status says nothing then."""

    verdict: Verdict | None
    outcome: str
    detail: str = ""
    alone: NDArray[np.float64] | None = None


class ReplayClock:
    """A clock that stands still until it is set, so that a verdict gets its original time."""

    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Return at once; a replay does not wait."""


class SweepReplay:
    """Classifies kept sweeps again, in their order, and fuses the sweeps of each object."""

    def __init__(self, settings: Config, bundle: Bundle) -> None:
        self._settings, self._bundle = settings, bundle
        self._clock = ReplayClock()
        self._classifier: Classifier | None = None
        self._made: object = None  # folder, run and rule of the classifier

    def __call__(self, kept: KeptSweep) -> ReplayResult:
        """The verdict on `kept`, compared with its sidecar's. Raises FormatError."""
        if kept.bundle not in ("", self._bundle.id):
            raise OtherBundle(
                f"sweep {kept.sweep.id} was classified by bundle {kept.bundle}, this is "
                f"{self._bundle.id}; name the sweep's bundle with --set classifier.bundle=DIR"
            )
        _check(f"sweep {kept.sweep.id}", kept.format, self._bundle)
        _check_length(kept.sweep, kept.format)
        was = kept.verdict
        classifier = self._prepared(kept)
        whole = (after := was.get("after", 0)) in (0, classifier.after(kept.sweep))
        if not whole or (not after and was.get("own")):  # this replay may have other sweeps before
            classifier.forget()
        verdict, own = _answered(classifier, kept.sweep)
        if not whole:
            # what follows depends on the missing sweeps, too, unless another object began here
            if not (verdict and verdict.fused == was.get("fused") == 1):
                classifier.forget()
            outcome = ALONE if own.tolist() == was.get("own") else DIFFERENT
            return ReplayResult(verdict, outcome, "earlier sweeps of its object are not there", own)
        if verdict is None:
            why = "it was answered early, which this bundle does not do"
            return ReplayResult(verdict, DIFFERENT, why)
        if not (was and kept.bundle):  # recorded without a bundle
            return ReplayResult(verdict, SILENT)
        now = verdict.as_dict()
        text = _changes(was, now)
        if text and not _changes(_unlike_any(was), _unlike_any(now)):
            return ReplayResult(verdict, ALONE, "the sweep that it resembles is not there")
        return ReplayResult(verdict, DIFFERENT if text else SAME, text)

    def _prepared(self, kept: KeptSweep) -> Classifier:
        """The classifier with the original settings, and the fused sweeps of this replay."""
        made = kept.object[:2], kept.rule
        if self._classifier is None or made != self._made:
            self._made = made
            rule = kept.rule or self._settings.classifier
            self._classifier = Classifier(self._bundle, self._clock, rule)
        self._classifier.tare = self._bundle.manifest.tare if kept.tare is None else kept.tare
        self._classifier.taxels.broken = kept.broken
        self._clock.t_ns = kept.verdict.get("time_ns", kept.sweep.complete_ns)
        return self._classifier


def _changes(was: dict[str, Any], now: dict[str, Any]) -> str:
    return ", ".join(
        f"other {name}" if isinstance(value, list) else f"{name} {value!r} is now {now.get(name)!r}"
        for name, value in was.items()
        if value != now.get(name)
    )


def _unlike_any(verdict: dict[str, Any]) -> dict[str, Any]:
    """The verdict as if the material had not been met before."""
    return verdict | {"detail": ALIKE.sub("", str(verdict.get("detail")))}


def _print(path: Path, found: ReplayResult, out: Callable[[str], object]) -> str:
    if found.verdict:
        out(result(found.verdict, "replay").decode("ascii"))
    said = f"{path.name}: {found.outcome}{found.detail and f' ({found.detail})'}"
    out(f"{printable(said)}\n")
    return found.outcome


def _answered(classifier: Classifier, sweep: Sweep) -> tuple[Verdict | None, NDArray[np.float64]]:
    """The verdict on a sweep, None if an unfinished one is not answered, and the probabilities of
    this sweep alone."""
    if sweep.share == 1:
        verdict = classifier(sweep)
        return verdict, verdict.own
    found = EarlyExit(classifier).judged(sweep)
    given = classifier.verdict(found) if found.status is Status.OK else None
    return given, found.probabilities


def _folder(folder: Path, classify: SweepReplay, out: Callable[[str], object]) -> int:
    """Replay all kept sweeps in `folder` and below; another bundle is no difference."""
    outcomes: Counter[str] = Counter()
    paths = sorted(folder.rglob("*.npy"), key=_order)
    if not paths:
        raise FormatError(
            f"{folder}: no kept sweep is there; name a folder of `palpate record` or of the black "
            "box"
        )
    for path in paths:
        try:
            found = classify(KeptSweep.read(path))
        except FormatError as e:  # the others may be readable
            found = ReplayResult(None, OTHER if isinstance(e, OtherBundle) else BROKEN, str(e))
        outcomes[_print(path, found, out)] += 1
    out(f"{len(paths)} sweeps: {', '.join(f'{n} {outcome}' for outcome, n in outcomes.items())}\n")
    return int(bool(outcomes.keys() & {DIFFERENT, BROKEN}) or outcomes[OTHER] == len(paths))


def changed(folder: Path, settings: Config, bundle: Bundle, run: int = 0) -> tuple[int, list[str]]:
    """How many of the latest sweeps in `folder` this program answers by the bundle that answered
    them, and the sweeps that it answers otherwise, each with the change. A probability may differ
    by GOLDEN_TOLERANCE, and by MOST_SHIFT in half of the sweeps. run: only sweeps with higher
    numbers."""
    classify, count, found, shifted = SweepReplay(settings, bundle), 0, [], []
    paths = [path for path in folder.rglob("*.npy") if not run or number_of(path) > run]
    for path in sorted(paths, key=_order)[-LATEST:]:
        try:
            kept = KeptSweep.read(path)
            result = classify(kept)
        except FormatError:  # of another bundle, or damaged: it says nothing about the program
            continue
        count += result.outcome != SILENT
        if result.outcome == DIFFERENT and (why := _beyond(kept.verdict, result)):
            found.append(f"{path.name}: {why}")
        if result.verdict and (shift := _shift(kept.verdict, result.verdict)) > MOST_SHIFT:
            shifted.append(f"{path.name}: its probabilities differ by {100 * shift:.0f} %")
    return count, found or (shifted if len(shifted) > max(count, FEWEST_SHIFTED) / 2 else [])


def main(argv: Sequence[str]) -> int:
    """`python -m palpate.runtime.replay FOLDER BUNDLE RUN`: say how many of the sweeps of a run
    this program answers otherwise. The exit code is OTHERWISE if there are any."""
    folder, of, run = argv
    bundle = bundle_files.load(Path(of))
    count, found = changed(Path(folder), config.load(None), bundle, int(run))
    if found:
        say(f"{len(found)} of {count} sweeps are answered otherwise ({found[-1]})")
    return OTHERWISE if found else 0


def _beyond(was: dict[str, Any], found: ReplayResult) -> str:
    """The change of an answer if it is larger than the tolerance, else ""."""
    now, before = found.verdict, np.asarray(was.get("own", []), np.float64)
    if found.alone is not None:
        same = _near(before, found.alone)
    elif now is None:
        return "it is not answered any more"
    else:
        statuses = {was.get("status"), now.status}
        # near a limit, "ok" may become "unsure", and an unknown sweep may have no probabilities
        same = _near(before, now.own) and (len(statuses) == 1 or statuses <= CLASSIFIED)
        same = same or (statuses == {Status.UNKNOWN} and not (len(before) and len(now.own)))
    if same:
        return ""
    return f"it was {_said(was)}, and is {_said(now.as_dict()) if now else 'not answered'}"


def _near(before: NDArray[np.float64], own: NDArray[np.float64]) -> bool:
    return before.shape == own.shape and np.allclose(before, own, 0, GOLDEN_TOLERANCE)


def _shift(was: dict[str, Any], now: Verdict) -> float:
    """The median change of the logarithms of a sweep's probabilities."""
    before, own = np.asarray(was.get("own", []), np.float64), now.own
    if not len(own) or before.shape != own.shape:
        return 0.0
    tiny = np.finfo(np.float64).tiny
    return float(np.median(np.abs(np.log(np.maximum(before, tiny) / np.maximum(own, tiny)))))


def _said(verdict: dict[str, Any]) -> str:
    return f"{verdict.get('status')} {verdict.get('label', '')} {verdict.get('probability')}"


def _order(path: Path) -> tuple[Path, int, str]:
    return path.parent, len(path.name), path.name


def _with_earlier(path: Path) -> list[KeptSweep]:
    """The earlier sweeps of the object, then the sweep at `path`. Raises FormatError."""
    found = [KeptSweep.read(path)]
    if found[0].sweep.object:
        before = (p for p in path.parent.glob("*.npy") if _order(p) < _order(path))
        for earlier in sorted(before, key=_order, reverse=True):
            kept = KeptSweep.read(earlier)
            if kept.object != found[0].object:
                break
            found.insert(0, kept)
    return found


def _check(what: str, format: SweepFormat, bundle: Bundle) -> None:
    if format != bundle.format:
        raise FormatError(
            f"{what} is of {format}, the bundle wants {bundle.format}; name its bundle with --set "
            "classifier.bundle=DIR"
        )


def _check_length(sweep: Sweep, format: SweepFormat) -> None:
    n = len(sweep.frames)
    if sweep.status is Status.OK and not (
        n == format.window if sweep.share == 1 else 0 < n < format.window
    ):
        raise FormatError(
            f"sweep {sweep.id} has {n} frames, share {sweep.share}, of {format}; use a sweep that "
            "was not changed"
        )


def _capture(path: Path, settings: Config, bundle: Bundle) -> None:
    """Run the box on a capture, which replaces sensor, trigger, clock and commands."""
    play = Playback(path)
    _check(str(path), play.format, bundle)
    classifier = Classifier(bundle, play, settings.classifier)
    port = StdoutPort(play.commands)
    cutter = SweepCutter(bundle.format, settings.sweep)
    box = Box(
        *(play, play, cutter, classifier, play),
        early=EarlyExit(classifier) if settings.classifier.early else None,
        port=port,
        observers=[classifier],
        source="replay",
    )
    box.run(lambda: play.finished)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

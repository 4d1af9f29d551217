"""What needs no device: replay, settings. In: arguments. Out: lines on standard output, exit codes."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from . import build, config
from .box import Box
from .bundle import Bundle
from .capture import Playback
from .clock import SystemClock
from .early import Decider
from .errors import FormatError
from .recorder import Recorder
from .sink import StdoutPort, result
from .sweep import SweepFormat, load
from .tasks import model, settings


def run_replay(args: argparse.Namespace) -> int:
    """`palpate replay`: all sentences of a capture, or that of one saved sweep."""
    how = settings(args)
    held = model(how)
    if args.file.suffix == ".npy":
        sweep, fmt = load(args.file)
        _same(args.file, fmt, held)
        classifier = build.classifier(how, held, SystemClock())
        verdict = classifier(sweep) if sweep.share == 1 else Decider(classifier)(sweep)
        if verdict is None:
            raise FormatError(
                f"{args.file} was answered early, which this bundle does not do; name the one it was kept with"
            )
        sys.stdout.buffer.write(result(verdict, "replay"))
        return 0
    play = Playback(args.file)
    _same(args.file, play.format, held)
    classifier = build.classifier(how, held, play)
    port = StdoutPort("replay", play.commands)
    recorder = Recorder(held.format, how.sweep)
    early = build.early(how, classifier)
    box = Box(play, play, recorder, classifier, play, early=early, sinks=[port], port=port, source="replay")
    box.run(lambda: play.finished)
    return 0


def _same(file: Path, fmt: SweepFormat, held: Bundle) -> None:
    if fmt != held.format:
        raise FormatError(
            f"{file} holds {fmt}, the bundle wants {held.format}; name its bundle with --set classifier.bundle=DIR"
        )


def run_config(args: argparse.Namespace) -> int:
    """`palpate config`: each value with its source."""
    print(config.describe(settings(args)))
    return 0


RUNS = {"replay": run_replay, "config": run_config}

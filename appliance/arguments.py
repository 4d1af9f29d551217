"""The words of the command `palpate`. In: what each command runs. Out: a parser, which knows help and exit codes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from . import __version__

EXIT_CODES = """exit codes: 0 done, and all is well; 1 another error or a failed check; 2 wrong arguments;
3 configuration; 4 bundle; 6 gpio lines; 8 a file of another form; 130 interrupted. A skin or a serial port that is not
there ends nothing: it is waited for, and `check` names it"""
MOST_SWEEPS = 10
"""What a person may be asked to take for an enrolment; a mean of more would hardly be better."""


def settings() -> argparse.ArgumentParser:
    """What every command that has settings takes."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--board", help="board file to use: firmware_config/board-NAME.toml")
    common.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one value")
    common.add_argument("--config-dir", type=Path, metavar="DIR", help="where sensor.toml and the board files are")
    return common


def _shared() -> tuple[argparse.ArgumentParser, argparse.ArgumentParser, argparse.ArgumentParser]:
    """What several commands take: the settings, the world, the number of answers."""
    common = settings()
    world = argparse.ArgumentParser(add_help=False)
    world.add_argument(
        "--sim", metavar="skin|replay:FILE", help="simulated tubes, or a sweep set, instead of the devices"
    )
    world.add_argument("--virtual", action="store_true", help="with --sim: do not wait for the time to pass")
    world.add_argument("--seed", type=int, default=0, help="of the simulated tubes (default 0)")
    some = argparse.ArgumentParser(add_help=False)
    some.add_argument("--sweeps", type=int, metavar="N", help="stop after N answers")
    return common, world, some


def parser(runs: Mapping[str, Callable[[argparse.Namespace], int]]) -> argparse.ArgumentParser:
    """The parser of all commands; `runs` has what each command's name runs, `args.run` is that of the one given."""
    parser = argparse.ArgumentParser(
        "palpate", description="Names the material a robot has just touched.", epilog=EXIT_CODES
    )
    parser.add_argument("--version", action="version", version=f"palpate {__version__}")
    common, world, some = _shared()
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, text: str, *parents: argparse.ArgumentParser) -> Any:
        command = commands.add_parser(name, help=text, description=text, parents=[common, *parents], epilog=EXIT_CODES)
        command.set_defaults(run=runs[name])
        return command

    run = add("run", "classify sweeps until SIGTERM", world, some)
    run.add_argument("--capture", type=Path, metavar="FILE", help="write everything that comes in to FILE, for replay")
    run.add_argument("--keep", type=Path, metavar="DIR", help="save the window of each sweep to DIR, for replay")
    demo = add("demo", "watch simulated sweeps being classified", world, some)
    demo.add_argument("--raw", action="store_true", help="print the sentences alone")
    add("check", "self-test: bundle, golden sweeps, devices", world, some)
    enrol = add("enrol", "learn one more material from a few sweeps, without training; write a new bundle", world)
    enrol.add_argument("label", metavar="LABEL", help="its name; every sweep from now on is of it")
    enrol.add_argument("--out", type=Path, required=True, metavar="DIR", help="the new bundle's folder")
    enrol.add_argument("--replace", action="store_true", help="a bundle at DIR gives way to it")
    enrol.add_argument(
        "--sweeps", type=int, choices=range(1, MOST_SWEEPS + 1), default=5, dest="good", metavar="N",
        help=f"how many good sweeps it takes, 1 to {MOST_SWEEPS} (default 5)",
    )  # fmt: skip
    enrol.set_defaults(sweeps=None)
    add("replay", "play a capture or a saved sweep through the same rooms").add_argument("file", type=Path)
    add("config", "print each value with its source")
    bench = add("bench", "measure latency, memory, start and processor share on this machine")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    bench.add_argument("--seed", type=int, default=2000, help="of the simulated sweeps (default 2000)")
    bench.add_argument("--yardsticks", type=Path, default=Path("build/yardsticks"), help="fp32.onnx, paper_int8.onnx")
    bench.add_argument("--part", choices=("memory", "stream"), help="one part alone, as JSON, playing --acts")
    bench.add_argument("--acts", type=Path, metavar="FILE", help=argparse.SUPPRESS)
    return parser

"""The arguments of the command `palpate`. In: what each command runs. Out: a parser with help and
exit codes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

from appliance import __version__
from appliance.bridges import options as bridges
from appliance.core.config import TriggerConfig

EXIT_CODES = """exit codes: 0 done, and all is well; 1 another error or a failed check; 2 wrong arguments; 65 a file of
another form; 69 hardware is not there; 78 configuration or bundle; 130 interrupted. `run` waits for
a skin or a serial port without limit; `check` names what is missing"""
WEB_PORT = 8137
MOST_SWEEPS = 10
"""Most sweeps for an enrolment; a mean of more would hardly be better."""


def settings() -> argparse.ArgumentParser:
    """The options of every command that has settings."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--board", help="board file to use: firmware_config/board-NAME.toml")
    common.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one value"
    )
    common.add_argument(
        "--config-dir", type=Path, metavar="DIR", help="where skin.toml and the board files are"
    )
    return common


def _shared() -> tuple[argparse.ArgumentParser, argparse.ArgumentParser, argparse.ArgumentParser]:
    """The options that several commands share: settings, devices, number of answers."""
    common = settings()
    devices = argparse.ArgumentParser(add_help=False)
    devices.add_argument(
        "--sim",
        metavar="skin[:MATERIAL]|rest|replay:FILE",
        help="simulated tubes, one of them, a finger at rest on one, or a sweep set, instead of the devices",
    )
    devices.add_argument(
        "--skin",
        metavar="NAME",
        help="profile of the skin, or the file of one (skin.profile); with --sim the name of an emulated one",
    )
    devices.add_argument(
        "--port", dest="skin_port", metavar="PATH", help="serial port of the skin (skin.port)"
    )
    devices.add_argument(
        "--virtual", action="store_true", help="with --sim: do not wait for the time to pass"
    )
    devices.add_argument("--seed", type=int, default=0, help="of the simulated tubes (default 0)")
    answers = argparse.ArgumentParser(add_help=False)
    answers.add_argument("--sweeps", type=_count, metavar="N", help="stop after N answers")
    return common, devices, answers


def _trigger() -> argparse.ArgumentParser:
    """The options that say what starts and stops sweeps where there are no lines."""
    trigger = argparse.ArgumentParser(add_help=False)
    trigger.add_argument(
        "--trigger",
        choices=get_args(get_type_hints(TriggerConfig)["mode"]),
        metavar="MODE",
        help="trigger.mode: two-lines or one-line; serial: commands START and STOP; key: the space bar; timed",
    )
    trigger.add_argument(
        "--every", type=_short, metavar="S", help="timed: seconds from one start to the next (5)"
    )
    trigger.add_argument(
        "--sweep", type=_short, metavar="S", help="timed: seconds from start to stop (3)"
    )
    return trigger


def _count(text: str) -> int:
    """A number of sweeps, for argparse."""
    if not text.isdecimal() or not 1 <= (number := int(text)) <= 1_000_000_000:
        raise argparse.ArgumentTypeError(
            f"{text} is no number of sweeps; use a whole number from 1 on"
        )
    return number


def _seconds(text: str, least: float = 1.0) -> float:
    """A length of time, for argparse."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not least <= seconds <= 3600:
        raise argparse.ArgumentTypeError(
            f"{text} is no number of seconds that will do; use {least:g} to 3600"
        )
    return seconds


def _short(text: str) -> float:
    """The time of a sweep, for argparse."""
    return _seconds(text, least=0.1)


def parser(runs: Mapping[str, Callable[[argparse.Namespace], int]]) -> argparse.ArgumentParser:
    """The parser of all commands. runs: command name -> function, which becomes `args.run` of that
    command."""
    parser = argparse.ArgumentParser(
        "palpate", description="Names the material a robot has just touched.", epilog=EXIT_CODES
    )
    parser.add_argument("--version", action="version", version=f"palpate {__version__}")
    common, devices, answers = _shared()
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, text: str, *parents: argparse.ArgumentParser, group: Any = commands) -> Any:
        last, options = name.rpartition(" ")[2], [common, *parents]
        command = group.add_parser(
            last, help=text, description=text, parents=options, epilog=EXIT_CODES
        )
        command.set_defaults(run=runs[name])
        return command

    _service_commands(add, devices, answers)
    _local_commands(add, devices, answers)
    _bundle_commands(add)
    about = "the skin by itself, without a bundle"
    skin = commands.add_parser("skin", help=about, description=about).add_subparsers(
        required=True, metavar="COMMAND"
    )
    _skin_commands(partial(add, group=skin), devices)
    about = "what other machines in the cell speak, beside the service"
    bridge = commands.add_parser("bridge", help=about, description=about).add_subparsers(
        required=True, metavar="BRIDGE"
    )

    def add_bridge(name: str, text: str) -> argparse.ArgumentParser:
        command = bridge.add_parser(name, help=text, description=text, epilog=EXIT_CODES)
        command.set_defaults(run=runs[f"bridge {name}"])
        return command

    bridges.add_arguments(add_bridge)
    return parser


def _service_commands(
    add: Callable[..., Any], devices: argparse.ArgumentParser, answers: argparse.ArgumentParser
) -> None:
    """The commands that answer a robot."""
    trigger = _trigger()
    run = add("run", "classify sweeps until SIGTERM", devices, answers, trigger)
    run.add_argument(
        "--shadow",
        nargs="?",
        const="",
        metavar="DIR",
        help="also classify with the bundle in DIR, by default the candidate of the store; its answers are only compared",
    )
    record = add(
        "record",
        "keep each sweep with its label, for training; needs no bundle",
        devices,
        answers,
        trigger,
    )
    for command in (run, record):
        command.add_argument(
            "--capture", type=Path, metavar="FILE", help="write all input to FILE, for replay"
        )
    _record_options(record)
    enrol = add(
        "enrol",
        "learn one more material from a few sweeps, without training; it runs on trial from the next start on",
        devices,
        trigger,
    )
    enrol.add_argument(
        "label", metavar="LABEL", help="its name; all sweeps from now on are of this material"
    )
    enrol.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="write the new bundle to DIR instead of installing it",
    )
    enrol.add_argument("--replace", action="store_true", help="replace a bundle at DIR")
    enrol.add_argument(
        "--sweeps",
        type=int,
        choices=range(1, MOST_SWEEPS + 1),
        default=5,
        dest="good",
        metavar="N",
        help=f"how many good sweeps it takes, 1 to {MOST_SWEEPS} (default 5)",
    )
    enrol.add_argument(
        "--scattered", action="store_true", help="even if the sweeps are unlike one another"
    )
    enrol.set_defaults(sweeps=None)


def _record_options(record: argparse.ArgumentParser) -> None:
    """What `record` alone takes."""
    record.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the sweeps (default: sweeps/ in the store's folder)",
    )
    for name in ("material", "position", "session"):
        record.add_argument(
            f"--{name}",
            default="",
            metavar="TEXT",
            help="until a command on the serial line or the page changes it",
        )
    record.add_argument(
        "--format",
        metavar="RxC:TYPE:HZ",
        help="what the skin sends, e.g. 5x3:float32:100 (default: what it announces)",
    )
    window = partial(_seconds, least=0.01)
    record.add_argument(
        "--window", type=window, metavar="S", help="seconds of each sweep that are kept (default 2)"
    )
    record.add_argument(
        "--target",
        type=_count,
        default=10,
        metavar="N",
        help="sweeps wanted per material and position (default 10)",
    )
    record.add_argument(
        "--web",
        nargs="?",
        const=WEB_PORT,
        type=int,
        metavar="PORT",
        help=f"also as a page, on which the labels are set (default port {WEB_PORT}); watch.address opens it to the network",
    )


def _local_commands(
    add: Callable[..., Any], devices: argparse.ArgumentParser, answers: argparse.ArgumentParser
) -> None:
    """The commands for a person who sets up or inspects the box."""
    add("demo", "watch simulated sweeps being classified", devices, answers).add_argument(
        "--raw", action="store_true", help="print the sentences alone"
    )
    align = add("align", "show where the contact lies on the skin, and where it should", devices)
    align.add_argument(
        "--web",
        nargs="?",
        const=WEB_PORT,
        type=int,
        metavar="PORT",
        help=f"also as a page on localhost (default port {WEB_PORT})",
    )
    align.set_defaults(sweeps=None)
    add("check", "self-test: bundle, golden sweeps, devices", devices, answers)
    add("status", "state of the service, and its last verdicts").add_argument(
        "--json", action="store_true"
    )
    watch = add("watch", "the running box live: skin, verdicts, latency and loss, over its feed")
    shown = watch.add_mutually_exclusive_group()
    shown.add_argument(
        "--json", action="store_true", help="the feed's lines as they are (PROTOCOL.md, part 4)"
    )
    shown.add_argument(
        "--web",
        nargs="?",
        const=WEB_PORT,
        type=int,
        metavar="PORT",
        help=f"as a page (default port {WEB_PORT}); watch.address and its token open it to the network",
    )
    add("replay", "judge a capture, a kept sweep or a folder of them again").add_argument(
        "file", type=Path
    )
    add("config", "print each value with its source")
    bench = add("bench", "measure latency, memory, start and processor share on this machine")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    bench.add_argument(
        "--seed", type=int, default=2000, help="of the simulated sweeps (default 2000)"
    )
    bench.add_argument(
        "--references",
        type=Path,
        default=Path("build/references"),
        help="fp32.onnx, paper_int8.onnx",
    )
    bench.add_argument(
        "--part",
        choices=("memory", "stream"),
        help="one part alone, as JSON, with the sweeps of --acts",
    )
    bench.add_argument("--acts", type=Path, metavar="FILE", help=argparse.SUPPRESS)


def _skin_commands(add: Callable[..., Any], devices: argparse.ArgumentParser) -> None:
    """The commands `palpate skin ...`."""
    add("skin list", "all skin profiles, with what each skin lacks and whether it was measured")
    detect = add("skin detect", "what is plugged in, and which profile fits; it only listens")
    detect.add_argument("--port", default="", metavar="PATH", help="this port alone")
    detect.add_argument(
        "--write", action="store_true", help="with --port: also ask, and send commands for starting"
    )
    check = add(
        "skin check", "whether the skin's firmware keeps to PROTOCOL.md, part by part", devices
    )
    check.add_argument(
        "--seconds",
        type=_seconds,
        default=10.0,
        metavar="S",
        help="how long frames are listened to, 1 to 3600 (default 10); the longer, the surer of the clock",
    )
    show = add("skin show", "the skin live: heat map, rate, noise, dead and stuck taxels", devices)
    show.add_argument(
        "--web",
        nargs="?",
        const=WEB_PORT,
        type=int,
        metavar="PORT",
        help=f"also as a page on localhost (default port {WEB_PORT})",
    )
    for command in (check, show):
        command.set_defaults(sweeps=None)
    new = add(
        "skin new",
        "listen to a skin that has no profile, propose one and write it; nothing is sent to it",
    )
    new.add_argument("name", metavar="NAME", help="of the profile")
    new.add_argument(
        "--port",
        required=True,
        metavar="PATH",
        help="where it is; `palpate skin detect` lists the ports",
    )
    new.add_argument(
        "--baud", type=_count, metavar="N", help="the skin's speed (default: common speeds in turn)"
    )
    new.add_argument(
        "--grid",
        metavar="RxC[xA]",
        help="rows, columns and axes; without it, proposals are printed alone",
    )
    new.add_argument(
        "--proposal",
        type=_count,
        metavar="N",
        help="which of the proposals (default: the first that has this grid)",
    )
    new.add_argument(
        "--seconds", type=_seconds, default=3.0, metavar="S", help="how long it listens (default 3)"
    )
    new.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the profile (default: /etc/palpate/skins)",
    )
    new.add_argument("--replace", action="store_true", help="replace a profile of this name")


def _bundle_commands(add: Callable[..., Any]) -> None:
    """The commands for the bundles in the store."""
    listed = add(
        "bundles", "the bundles on this box: which one runs, and which one `rollback` returns to"
    )
    listed.add_argument("--json", action="store_true")
    install = add(
        "install", "check the signed bundle in DIR, and run it on trial from the next start on"
    )
    install.add_argument(
        "--shadow", action="store_true", help="as the candidate of `run --shadow` instead"
    )
    install.add_argument(
        "--other-skin",
        action="store_true",
        help="even if it is for another skin than the one that streams",
    )
    for command in (install, add("verify", "check the signed bundle in DIR, and change nothing")):
        command.add_argument("folder", type=Path, metavar="DIR")
    add("commit", "end the trial of the bundle that runs: it stays")
    add("rollback", "go back to the previous bundle, from the next start on")
    add("promote", "run the candidate on trial from the next start on")

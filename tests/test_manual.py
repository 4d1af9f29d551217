"""The written pages and the change log beside the code: commands, settings, statuses and figures
that they name exist, and each that exists is described. The box holds the pages as one text."""

from __future__ import annotations

import re
import shlex
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from palpate import __version__
from palpate.bridges import options as bridges
from palpate.bundle import bundle
from palpate.cli import bundle_commands, parser
from palpate.cli.main import COMMANDS
from palpate.cli.parser import BUNDLE_ACTIONS, MENU, SKIN_ACTIONS
from palpate.core import config, errors, sentences
from palpate.core.types import Status, Verdict
from palpate.deployment import state
from palpate.io import robot_link
from palpate.service import status, systemd
from tests.factories.paths import ROOT

DOCS = ROOT / "docs"
FOLDERS = ("tutorials", "how-to", "reference", "explanation")
PAGES = {
    path.relative_to(DOCS).as_posix(): path.read_text("utf-8")
    for folder in FOLDERS
    for path in sorted((DOCS / folder).glob("*.md"))
}
"""The written pages, by their paths below docs/."""
MANUAL = "\n".join(PAGES.values())
CHANGES = (ROOT / "CHANGELOG.md").read_text()
BLOCKS = re.findall(r"(?m)^    (\S.*)$", MANUAL)
"""The lines of all code blocks."""
PICTURES = sorted(DOCS.glob("manual/*.svg"))
_BUNDLE = bundle.load(bundle.DEFAULT)
PACKAGED, VERSION = _BUNDLE.id, _BUNDLE.manifest.version
"""Id and version of the packaged bundle."""


@pytest.fixture(scope="module")
def manual() -> Iterator[ModuleType]:
    """systemd/manual.py, whose folder is not a package."""
    sys.path.insert(0, str(ROOT / "systemd"))
    import manual

    yield manual
    sys.path.remove(str(ROOT / "systemd"))


def rows(page: str, column: str) -> Iterator[list[str]]:
    """The cells of each row of the tables of a page whose first column is headed so."""
    inside = False
    for line in PAGES[page].splitlines():
        cells = (
            [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        )
        if cells and inside and not set(cells[0]) <= {"-"}:
            yield cells
        inside = bool(cells) and (inside or cells[0] == column)


def named(page: str, column: str) -> list[str]:
    """The text in backticks at the beginning of each row."""
    return [re.match(r"`?([^`]*)`?", cells[0])[1] for cells in rows(page, column)]


def spoken() -> list[list[str]]:
    """The arguments of each `palpate` command of the pages' code blocks; printed tables have wide
    gaps."""
    found = (re.fullmatch(r"(?:sudo -u palpate )?palpate ([a-z].*)", line) for line in BLOCKS)
    return [shlex.split(m[1]) for m in found if m and "   " not in m[1]]


def test_every_status_is_explained():
    """All statuses of sweep.Status, in their order, and the skin's states, each with advice."""
    title = "reference/statuses.md"
    assert named(title, "status") == [*Status]
    kinds = [
        k
        for k in vars(errors).values()
        if isinstance(k, type) and issubclass(k, errors.SensorError)
    ]
    assert set(named(title, "state")) == {k.state for k in kinds if k is not errors.SensorError} | {
        "streaming"
    }
    assert all(all(cells) for column in ("status", "state") for cells in rows(title, column))


def test_every_serial_command_is_named():
    """The commands of the serial line, in the order of sink.COMMANDS."""
    assert named("reference/sentences.md", "command") == [*robot_link.COMMANDS]


def test_sentences_are_as_the_box_forms_and_reads_them():
    """Each sentence of the pages has its checksum; RES, STA, ANS and REC are there; commands are
    understood."""
    found = re.findall(r"\$PPLP,([A-Z]+)([^*`\n]*)\*([0-9A-F]{2})", MANUAL)
    kinds = set()
    for kind, rest, given in found:
        assert given == sentences.checksum(f"PPLP,{kind}{rest}"), f"{kind}{rest}"
        kinds.add(kind)
        if kind in robot_link.COMMANDS:
            ((command,), _) = robot_link.parse(f"$PPLP,{kind}{rest}*{given}\r\n".encode())
            assert not command.error
    assert kinds >= {"RES", "STA", "ANS", "REC"}


def test_every_command_has_its_section(manual: ModuleType):
    """The reference holds each command of the parser with its help; a command in a text exists."""
    text = manual.references()["commands"]
    assert re.findall(r"(?m)^## palpate (.*)$", text) == [*MENU.commands]
    assert set(MENU.commands) == set(COMMANDS)
    assert len(MENU.commands) <= 15
    for actions in (BUNDLE_ACTIONS, SKIN_ACTIONS, bridges.TEXTS):
        assert all(f"| `{name}` | {effect} |" in text for name, effect in actions.items())
    assert "| `--web PORT` |" in text
    assert set(re.findall(r"`palpate ([a-z]+)", MANUAL)) <= set(MENU.commands)
    assert set(re.findall(r"`palpate bundles ([a-z]+)", MANUAL)) <= set(BUNDLE_ACTIONS)
    assert set(re.findall(r"`palpate skin ([a-z]+)", MANUAL)) <= set(SKIN_ACTIONS)


@pytest.mark.parametrize("words", spoken(), ids=" ".join)
def test_commands_can_be_copied(words: list[str]):
    """Each `palpate` command of a code block is one that the parser takes."""
    assert parser.arguments(words[0], words[1:])


def test_commands_to_be_copied_are_many():
    """The search for them finds them."""
    assert len(spoken()) >= 8


def test_training_commands_are_there():
    """Commands and options of palpate-train in the pages stand in its parsers."""
    code = "\n".join(path.read_text() for path in sorted(ROOT.glob("train/**/*.py")))
    commands = set(re.findall(r'\badd(?:_parser)?\(\s*"([a-z]+)"', code))
    lines = [*BLOCKS, *re.findall(r"`([^`]+)`", MANUAL.replace("\n", " "))]
    called = [line.split("#")[0].split()[1:] for line in lines if line.startswith("palpate-train ")]
    assert len(called) >= 6
    for first, *more in called:
        if not first[0].islower():  # --help, or COMMAND
            continue
        assert {first, *more[: first == "sets"]} <= commands, first
        assert all(f'"{word}"' in code for word in more if word.startswith("--")), more


def test_make_targets_are_there():
    """Each `make TARGET NAME=...` of the pages is a target that uses this variable; install and
    deploy are among them."""
    text = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"(?m)^([a-z-]+):", text))
    called = re.findall(r"(?m)(?:^    |`)make ([a-z-]+)([^`\n#]*)", MANUAL)
    assert {"install", "deploy"} <= {target for target, _ in called}
    for target, given in called:
        assert target in targets
        for name in re.findall(r"([A-Z]+)=", given):
            assert re.search(rf"\$\({name}\)|\$\(call quoted,{name}\)", text), given


def test_settings_have_default_limits_and_meaning(manual: ModuleType):
    """Every key of the code, in its order. The docstring of its section gives each a meaning."""
    lines = manual.settings_tables().splitlines()
    shown = {
        cells[1].strip(" `"): [cell.strip() for cell in cells[2:-1]]
        for cells in (re.split(r"(?<!\\)\|", line) for line in lines if line.startswith("| `"))
    }
    of_fingers = [f"skins.NAME.{name}" for name in ("bundle", "part")]
    assert [*shown] == ["board", *config._KEYS, *of_fingers]
    assert [name for name, (*_, meaning) in shown.items() if not meaning] == []
    assert shown["classifier.min_probability"][:2] == ["0.0", "0 to 1"]
    assert shown["classifier.fuse"][:2] == ['"product"', '"product", "vote", "none"']


def test_settings_of_the_text_exist():
    """A `section.key` in the text is a setting."""
    sections = "|".join(config._SECTIONS)
    files = {"skin.toml"}
    found = set(re.findall(rf"`((?:{sections})\.[a-z_]+)", MANUAL)) - files
    assert found <= {*config._KEYS}


def test_exit_codes_are_those_of_the_code():
    """The codes of `palpate --help`, of the errors, and the reaction of the unit to each."""
    shown = {int(cells[0]): cells for cells in rows("reference/exit-codes.md", "exit code")}
    assert [*shown] == [int(n) for n in re.findall(r"(?:^|[;:]\s)(\d+) ", parser.EXIT_CODES)]
    codes = {k.exit_code for k in vars(errors).values() if isinstance(k, type)}
    assert codes <= shown.keys()
    unit = (ROOT / "systemd" / "palpate.service").read_text()
    stays = [int(n) for n in re.findall(r"(?m)^RestartPreventExitStatus=(.*)", unit)[0].split()]
    assert [code for code, cells in shown.items() if "stopped" in cells[2]] == stays


@pytest.mark.parametrize("board", ["rpi4", "rpi5"])
def test_wiring_is_that_of_the_board_files(board: str):
    """Each line's kernel name and pin as in the board file, the header drawn as there, the kernel's
    settings too."""
    text = (ROOT / "firmware_config" / f"board-{board}.toml").read_text()
    settings = config.load(board)
    lines = {
        "START": settings.trigger.start,
        "STOP": settings.trigger.stop,
        "NEW OBJECT": settings.trigger.new_object,
        **{
            name.upper().replace("_", " "): getattr(settings.output, name)
            for name in ("ready", "busy", "result_valid", "fault", "decided")
        },
        **{f"class bit {i}": name for i, name in enumerate(settings.output.class_bits)},
    }
    shown = {cells[0]: cells[1:] for cells in rows("reference/pins.md", "signal")}
    assert shown.keys() - lines.keys() == {"serial TXD", "serial RXD"}
    for role, (_, name, pin, _) in shown.items():
        assert name == lines.get(role, name)
        assert re.search(rf"\({pin}\) +{name}\b|\b{name} +\({pin}\)", text), role
    header = [
        "    " + line[2:].rstrip()
        for line in text.splitlines()
        if re.search(r"\(\d+\) \(\d+\)", line)
    ]
    assert len(header) == 20
    assert "\n".join(header) in MANUAL
    boot = re.findall(r"(?m)^#     ((?:dt|enable)\S+)$", text)
    assert len(boot) >= 2
    assert "".join(f"\n    {line}" for line in boot) + "\n\n" in MANUAL


def test_pictures_are_shown():
    """Each picture of docs/manual is shown, with a text for those who cannot see it. Links are
    checked with the site (test_site.py)."""
    shown = dict(re.findall(r"!\[([^\]]+)\]\(\.\./([^)]+)\)", MANUAL))
    assert {Path(target) for target in shown.values()} >= {p.relative_to(DOCS) for p in PICTURES}


def test_the_box_gets_the_manual(manual: ModuleType):
    """As one text: its contents name every page, markers are filled, links and pictures are gone,
    drawings have stayed."""
    text = manual.box_manual()
    titles = re.findall(r"(?m)^## \d+\. (.*)$", text)
    assert re.findall(r"(?m)^\d+\. (.*)$", text.partition("\n## ")[0]) == titles
    assert len(titles) == len(manual.BOX_PAGES)
    assert "<!--" not in text
    assert "](" not in text
    assert "wire it (section 4)" in text
    assert "| `classifier.fuse` |" in text
    assert len(re.findall(r"[_~]{4}", text)) >= 30
    copied = (ROOT / "systemd" / "install.py").read_text()
    assert '"build/manual.md": "/usr/share/doc/palpate/manual.md"' in copied


@pytest.mark.parametrize("path", PICTURES, ids=lambda p: p.name)
def test_pictures_stand_alone(path: Path):
    """Each is SVG with a title and a description, and asks for nothing outside of it."""
    root = ET.parse(path).getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert [child.tag.rpartition("}")[2] for child in root][:2] == ["title", "desc"]
    assert all(child.text for child in root[:2])
    for element in root.iter():
        assert element.tag.rpartition("}")[2] not in ("script", "image", "foreignObject", "use")
        values = [*element.attrib.values(), element.text or ""]
        assert not any("href" in key for key in element.attrib)
        assert all("@import" not in value for value in values)
        assert all(m == "#" for value in values for m in re.findall(r"url\(['\"]?(.)", value))


def test_any_terminal_shows_it(manual: ModuleType):
    """ASCII alone; drawings fit into 80 columns."""
    text = manual.box_manual()
    assert text.isascii()
    assert CHANGES.isascii()
    drawn = re.findall(r"(?m)^.*[_~]{4}.*$|^.*={4}.*$", text)
    assert len(drawn) >= 30
    assert max(map(len, drawn)) <= 80


def test_each_drawing_is_seen_once():
    """Rendered pages show the pictures; the drawings made of text are in comments, for the box."""
    comments = re.findall(r"(?s)<!-- as text:\n\n(.*?)-->", MANUAL)
    rendered = re.sub(r"(?s)<!--.*?-->", "", MANUAL)
    assert len(comments) == len(PICTURES)
    for text in comments:
        assert all(line.startswith("    ") or not line for line in text.splitlines())
    assert not re.findall(r"(?m)^    .*[_~]{4}.*$", rendered)
    assert "-->" not in rendered.replace(PAGES["explanation/what-it-is.md"], ""), (
        "a comment ended inside its drawing"
    )


def verdict(
    sweep: int, what: Status, label: str = "", probability: float = 0.0, **more: Any
) -> Verdict:
    """An answer, 1 ms after its sweep."""
    about = {
        "time_ns": 0,
        "margin": 0.9,
        "scores": np.empty(0),
        "fused": 1,
        "lost": 0,
        "latency_ns": 1_000_000,
    } | more
    return Verdict(
        sweep=sweep, status=what, label=label, probability=probability, bundle=PACKAGED, **about
    )


def test_samples_are_what_the_box_prints():
    """Lines of the journal, of `palpate status` and of `palpate bundles`, from the code that prints
    them."""
    shown = [
        systemd.words(verdict(1, Status.OK, "wood", 0.991)),
        systemd.words(verdict(8, Status.SENSOR_LOST)),
    ]
    health = {
        "time_ns": 0,
        "skin": "streaming",
        "trouble": "",
        "streams": True,
        "sweeping": False,
        "answered": 1,
        "frames": 54006,
        "lost_frames": 0,
        "garbage_bytes": 0,
        "foreign_frames": 0,
        "enumerations": 1,
        "dropped": 0,
        "bundle": PACKAGED,
        "source": "usb",
        "stale_frames": 0,
        "overflows": 0,
        "fifo_overflows": 0,
        "glitches": 0,
        "lost_edges": 0,
        "storms": 0,
    }
    now_ns = 72_000_000_000
    file = {
        **health,
        "running": True,
        "why": "",
        "pid": 712,
        "version": __version__,
        "since_ns": 0,
        "model": f"default {VERSION}, 6 labels",
        "verdicts": [
            verdict(1, Status.OK, "wood", 0.991, time_ns=now_ns - 9_000_000_000).as_dict(
                arrays=False
            )
        ],
    }
    shown += status.lines(file, now_ns)
    detail = "start 1 of 3, 7 of 20 sweeps, 41 of 600 s, as of its last start or end"
    shown += bundle_commands.lines(
        [
            bundle_commands.ListedBundle(
                "9" * 64, "9f3c2a1b", "mine", "2", 2, "anna", "on trial", detail
            ),
            bundle_commands.ListedBundle(
                "5" * 64, "5be01d77", "mine", "1", 1, "anna", "previous", ""
            ),
            bundle_commands.ListedBundle(
                "", PACKAGED, "default", VERSION, 0, "palpate", "kept", ""
            ),
        ]
    )
    assert [line for line in shown if line not in BLOCKS] == []


def test_examples_are_of_the_packaged_bundle():
    """Each page that shows the packaged bundle shows the present one."""
    shown = re.findall(r"\bdefault (\d+)(?:, (?!\d+ labels)(\w{8}))?", MANUAL)
    shown += [(n, i) for i, n in re.findall(r"\b([0-9a-f]{8})  default (\d+)", MANUAL)]
    assert len(shown) >= 4
    assert {version for version, _ in shown} == {VERSION}
    assert {name for _, name in shown if name} == {PACKAGED}


def test_the_trial_is_described_as_it_is():
    """Starts, sweeps and seconds are those of the program and of the default settings."""
    settings = config.StoreConfig()
    text = PAGES["how-to/deliver.md"]
    assert f"`store.trial_sweeps` ({settings.trial_sweeps})" in text.replace("\n", " ")
    assert f"streamed for {settings.trial_s:.0f} s" in text.replace("\n", " ")
    assert f" {state.MOST_STARTS} starts " in text.replace("\n", " ")


def test_the_change_log_knows_this_version():
    """Versions go down, and the newest is the present version."""
    heads = re.findall(r"(?m)^## (\d+\.\d+\.\d+)", CHANGES)
    assert heads[0] == __version__
    assert heads == sorted(heads, key=lambda v: [*map(int, v.split("."))], reverse=True)

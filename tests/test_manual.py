"""The written pages can be typed, wired and read, and the box holds them as one text."""

import re
import shlex
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from palpate import __version__
from palpate.bridges import options as bridges
from palpate.cli import parser
from palpate.cli.parser import COMMANDS
from palpate.core import config, errors, sentences
from palpate.core.types import Status
from palpate.io import robot_link
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
BLOCKS = re.findall(r"(?m)^    (\S.*)$", MANUAL)
"""The lines of all code blocks."""


@pytest.fixture(scope="module")
def manual() -> Iterator[ModuleType]:
    """systemd/manual.py, whose folder is not a package."""
    sys.path.insert(0, str(ROOT / "systemd"))
    import manual

    yield manual
    sys.path.remove(str(ROOT / "systemd"))


def rows(page: str, column: str) -> list[list[str]]:
    """The cells of each row of the tables of a page whose first column is headed so."""
    found, inside = [], False
    for line in PAGES[page].splitlines():
        cells = [c.strip() for c in line.strip("|").split("|")] if line.startswith("|") else []
        if cells and inside and not set(cells[0]) <= {"-"}:
            found.append(cells)
        inside = bool(cells) and (inside or cells[0] == column)
    return found


def spoken() -> list[list[str]]:
    """Arguments of each `palpate` command in code blocks, up to a pipe; tables have wide gaps."""
    found = (re.fullmatch(r"(?:sudo -u palpate )?palpate ([a-z].*)", line) for line in BLOCKS)
    return [shlex.split(m[1].partition(" | ")[0]) for m in found if m and "   " not in m[1]]


def test_every_status_is_explained():
    """In the order of the code, each with all cells."""
    shown = rows("reference/statuses.md", "status")
    assert [cells[0].strip("`") for cells in shown] == [*Status]
    assert all(map(all, shown))


def test_sentences_are_as_the_box_forms_and_reads_them():
    """Each sentence of the pages has its checksum, and the box understands each command."""
    found = re.findall(r"\$PPLP,([A-Z]+)([^*`\n]*)\*([0-9A-F]{2})", MANUAL)
    assert {kind for kind, *_ in found} >= {"RES", "STA", "ANS", "REC"}
    for kind, rest, given in found:
        assert given == sentences.checksum(f"PPLP,{kind}{rest}"), f"{kind}{rest}"
        if kind in robot_link.COMMANDS:
            ((command,), _) = robot_link.parse(f"$PPLP,{kind}{rest}*{given}\r\n".encode())
            assert not command.error


def test_every_command_has_its_section(manual: ModuleType):
    """The reference holds each command of the parser; a command in a text exists."""
    text = manual.references()["commands"]
    kinds = {name: [*command.actions] for name, command in COMMANDS.items()}
    kinds["bridge"] = [*bridges.KINDS]
    names = [f"{name} {kind}".strip() for name, of in kinds.items() for kind in of or [""]]
    assert re.findall(r"(?m)^## palpate (.*)$", text) == names
    assert set(re.findall(r"`palpate ([a-z]+)", MANUAL)) <= set(COMMANDS)
    for name in ("bundles", "skin"):
        assert set(re.findall(rf"`palpate {name} ([a-z]+)", MANUAL)) <= set(kinds[name])


@pytest.mark.parametrize("words", spoken(), ids=" ".join)
def test_commands_can_be_copied(words: list[str]):
    """Each `palpate` command of a code block is one that the parser takes."""
    assert parser.arguments(words[0], words[1:])


def test_training_commands_and_make_targets_are_there():
    """Options of palpate-train stand in its parsers, targets and variables in the Makefile."""
    code = "\n".join(path.read_text() for path in sorted(ROOT.glob("train/**/*.py")))
    lines = [*BLOCKS, *re.findall(r"`([^`]+)`", MANUAL.replace("\n", " "))]
    called = [line.split("#")[0].split()[1:] for line in lines if line.startswith("palpate-train ")]
    options = {word for words in called for word in words if word.startswith("--")}
    assert [word for word in options if f'"{word}"' not in code] == []
    text = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"(?m)^([a-z-]+):", text))
    asked = re.findall(r"(?m)(?:^    |`)make ([a-z-]+)([^`\n#]*)", MANUAL)
    assert {"install", "deploy"} <= {target for target, _ in asked} <= targets
    names = {name for _, given in asked for name in re.findall(r"([A-Z]+)=", given)}
    assert [n for n in names if f"$({n})" not in text and f"$(call quoted,{n})" not in text] == []


def test_settings_have_default_limits_and_meaning(manual: ModuleType):
    """Every key of the code in its order; a `section.key` in a text is a setting."""
    lines = manual.settings_tables().splitlines()
    shown = {
        cells[1].strip(" `"): [cell.strip() for cell in cells[2:-1]]
        for cells in (re.split(r"(?<!\\)\|", line) for line in lines if line.startswith("| `"))
    }
    keys = [name for name in shown if not name.startswith("skins.NAME")]
    assert keys == ["board", *config._KEYS]
    assert [name for name, (*_, meaning) in shown.items() if not meaning] == []
    assert shown["classifier.min_probability"][:2] == ["0.0", "0 to 1"]
    sections = "|".join(config._SECTIONS)
    found = set(re.findall(rf"`((?:{sections})\.[a-z_]+)", MANUAL)) - {"skin.toml"}
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
    """Each line's kernel name and pin, and the kernel's settings."""
    text = (ROOT / "firmware_config" / f"board-{board}.toml").read_text()
    settings = config.load(board)
    given, output = settings.trigger, settings.output
    lines = {"START": given.start, "STOP": given.stop, "NEW OBJECT": given.new_object}
    for name in ("ready", "busy", "result_valid", "fault", "decided"):
        lines[name.upper().replace("_", " ")] = getattr(output, name)
    lines |= {f"class bit {i}": name for i, name in enumerate(output.class_bits)}
    shown = {cells[0]: cells[1:] for cells in rows("reference/pins.md", "signal")}
    assert shown.keys() - lines.keys() == {"serial TXD", "serial RXD"}
    for role, (_, name, pin, _) in shown.items():
        assert name == lines.get(role, name)
        assert re.search(rf"\({pin}\) +{name}\b|\b{name} +\({pin}\)", text), role
    boot = re.findall(r"(?m)^#     ((?:dt|enable)\S+)$", text)
    assert len(boot) >= 2
    assert [line for line in boot if line not in BLOCKS] == []


def test_the_box_gets_the_manual(manual: ModuleType):
    """One ASCII text: all pages, filled markers, no links, drawings of 80 columns."""
    text = manual.box_manual()
    titles = re.findall(r"(?m)^## \d+\. (.*)$", text)
    assert re.findall(r"(?m)^\d+\. (.*)$", text.partition("\n## ")[0]) == titles
    assert len(titles) == len(manual.BOX_PAGES)
    assert text.isascii()
    assert "<!--" not in text
    assert "](" not in text
    assert "| `classifier.fuse` |" in text
    drawn = re.findall(r"(?m)^.*[_~]{4}.*$|^.*={4}.*$", text)
    assert len(drawn) >= 30
    assert max(map(len, drawn)) <= 80


@pytest.mark.parametrize("path", sorted(DOCS.glob("manual/*.svg")), ids=lambda p: p.name)
def test_pictures_stand_alone(path: Path):
    """Each has a title and a description, is shown, and asks for nothing outside of it."""
    root = ET.parse(path).getroot()
    assert [child.tag.rpartition("}")[2] for child in root][:2] == ["title", "desc"]
    assert all(child.text for child in root[:2])
    assert f"{path.name})" in MANUAL
    for element in root.iter():
        assert element.tag.rpartition("}")[2] not in ("script", "image", "foreignObject", "use")
        values = [*element.attrib.values(), element.text or ""]
        assert not any("href" in key for key in element.attrib)
        assert all("@import" not in value for value in values)
        assert all(m == "#" for value in values for m in re.findall(r"url\(['\"]?(.)", value))


def test_the_change_log_knows_this_version():
    """Versions go down, and the newest is the present version."""
    heads = re.findall(r"(?m)^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text())
    assert heads[0] == __version__
    assert heads == sorted(heads, key=lambda v: [*map(int, v.split("."))], reverse=True)


def test_every_page_is_reached_from_the_readme():
    """A person finds each page by links, without a search."""
    reached, left = set[Path](), [ROOT / "README.md"]
    while left:
        page = left.pop().resolve()
        if page not in reached:
            reached.add(page)
            links = re.findall(r"\]\(([^)#\s:]+\.md)", page.read_text())
            left += [page.parent / link for link in links]
    pages = {*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("firmware_config/**/*.md")}
    assert pages - reached == set()


def test_every_way_into_the_box_has_tests():
    """Each way in of docs/security.md is whole, and the files of tests that it names exist."""
    text = (DOCS / "security.md").read_text("utf-8").partition("## Counts")[0]
    found = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")][1:]
    assert len(found) > 10
    for row in found:
        assert len(row) == 5, row[0]
        assert all(cell.strip() for cell in row), row[0]
        files = re.findall(r"`(tests/[\w/]+\.py)`", row[4])
        assert files, row[0]
        assert all((ROOT / file).is_file() for file in files), row[4]

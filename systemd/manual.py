"""The manual's references, made from the code, and the manual as one text for the box.

A page below docs/ holds a pair of markers, `<!-- palpate: settings -->` and `<!-- /palpate -->`,
where a reference belongs; the text between them is for readers of the source. The site and the text
for the box replace it by tables of the settings or commands of this checkout. So no reference can
be stale.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from palpate.cli.parser import parser
from palpate.core import config
from palpate.core.schema import Key
from palpate.core.storage import put

ROOT = Path(__file__).resolve().parent.parent
BOX_PAGES = (
    "explanation/what-it-is.md",
    "tutorials/first-day.md",
    "how-to/wire.md",
    "reference/pins.md",
    "how-to/trigger-without-lines.md",
    "reference/timing.md",
    "reference/sentences.md",
    "reference/statuses.md",
    "how-to/record.md",
    "how-to/train.md",
    "how-to/deliver.md",
    "how-to/teach.md",
    "how-to/look-at-sweeps-again.md",
    "how-to/align.md",
    "how-to/use-your-own-skin.md",
    "how-to/use-two-fingertips.md",
    "how-to/watch.md",
    "how-to/update.md",
    "how-to/find-a-fault.md",
    "reference/settings.md",
    "reference/commands.md",
    "reference/exit-codes.md",
    "reference/specifications.md",
    "explanation/what-a-skin-can-sense.md",
    "explanation/limits.md",
    "reference/glossary.md",
)
"""Pages below docs/ that the box holds as one text, in this order."""
MARKER = re.compile(r"(?ms)^<!-- palpate: ([a-z-]+) -->\n.*?^<!-- /palpate -->$")
Command = tuple[str, str, argparse.ArgumentParser]
"""Full name, description and parser of a command."""
TITLE = """\
# Palpate: the manual

For the engineer who integrates the box into a robot cell and keeps it running. Drawings are text.
PROTOCOL.md, in the same folder, describes every field of every sentence and of the USB packets.
Search in `less` with `/`, for example `/saturated`.
"""


def references() -> dict[str, str]:
    """The text for each marker that a page of the box may hold."""
    return {
        "settings": settings_tables(),
        "commands": command_sections([*leaves(parser())]),
    }


def filled(text: str, known: Mapping[str, str]) -> str:
    """A page's text with each marker replaced. Raises KeyError for an unknown marker."""
    return MARKER.sub(lambda found: known[found[1]], text)


def box_manual() -> str:
    """All pages for the box as one Markdown text in ASCII, its drawings as text."""
    known = references()
    pages = [filled((ROOT / "docs" / name).read_text("utf-8"), known) for name in BOX_PAGES]
    titles = [re.match(r"# (.*)", page)[1] for page in pages]  # type: ignore[index]
    contents = "\n".join(f"{number}. {title}" for number, title in enumerate(titles, 1))
    texts = (
        re.sub(r"\A# ", f"## {number}. ", _plain(page)) for number, page in enumerate(pages, 1)
    )
    return "\n".join([TITLE, contents, "", *texts])


def write(path: Path) -> None:
    """Write the manual for the box."""
    path.parent.mkdir(exist_ok=True)
    put(path, box_manual().encode("ascii"))


def _plain(page: str) -> str:
    """A page with pictures and links as text; headings below its title one level down."""
    text = re.sub(r"(?s)<!--.*?-->\n?", "", page)
    text = re.sub(r"(?m)^!\[[^\]]*\]\(([^)]*)\)\n\n?", _drawing, text)
    text = re.sub(r"\[([^\]]+)\]\(([^)#]*)[^)]*\)", _reference, text)
    return re.sub(r"(?m)^(#{2,}) ", r"#\1 ", text)


def _drawing(picture: re.Match[str]) -> str:
    """The drawing in characters that lies next to a picture of docs/manual, "" if there is none."""
    drawn = (ROOT / "docs" / "manual" / Path(picture[1]).name).with_suffix(".txt")
    return f"{drawn.read_text('ascii')}\n" if drawn.exists() else ""


def _reference(link: re.Match[str]) -> str:
    """A link as text: its words, and the section if the target is a part of the manual."""
    for number, name in enumerate(BOX_PAGES, 1):
        if Path(name).name == Path(link[2]).name:
            return f"{link[1]} (section {number})"
    return link[1]


def settings_tables() -> str:
    """A table for each section of the settings: key, default, allowed values, meaning."""
    head = "| key | default | allowed | meaning |\n|---|---|---|---|\n"
    parts = [
        head + '| `board` | "" | name | which `board-NAME.toml` is read; the same as `--board` |\n'
    ]
    for section, group in config._SECTIONS.items():
        about, meanings = described(group)
        rows = "".join(
            f"| `{name}` | {_default(key)} | {_cell(allowed(key))} "
            f"| {_cell(_meaning(name, key, meanings))} |\n"
            for name, key in config._KEYS.items()
            if name.startswith(f"{section}.")
        )
        parts.append(f"## {section}\n\n{about}\n\n{head}{rows}")
    return "\n".join(parts)


def described(group: Any) -> tuple[str, dict[str, str]]:
    """The purpose of a section of the settings and the meaning of each key, from its docstring:
    the purpose, then `key: meaning.`, or `key, key: meaning.`"""
    names = "|".join(group.__dataclass_fields__)
    parts = re.split(
        rf"(?:^|(?<=\s))((?:{names})(?:, (?:{names}))*): ", " ".join(group.__doc__.split())
    )
    meanings = {
        name: text.strip().rstrip(".")
        for listed, text in zip(parts[1::2], parts[2::2], strict=True)
        for name in listed.split(", ")
    }
    return parts[0].strip(), meanings


def _meaning(name: str, key: Key, meanings: Mapping[str, str]) -> str:
    """The meaning of a key; a single GPIO line is named by its signal first."""
    last = name.partition(".")[2]
    text = meanings.get(last, "")
    if "line" not in key.metadata or get_origin(key.hint) is tuple:
        return text
    return f"{last.upper().replace('_', ' ')}: {text}".rstrip(": ")


def _default(key: Key) -> str:
    return json.dumps(key.default)


def allowed(key: Key) -> str:
    """The values that a setting may have."""
    if "line" in key.metadata:
        return "GPIO lines" if get_origin(key.hint) is tuple else "GPIO line"
    if "allowed" in key.metadata:
        return str(key.metadata["allowed"])
    if key.hint in (str, bool):
        return {str: "text", bool: "true, false"}[key.hint]
    if get_origin(key.hint) is Literal:
        return ", ".join(map(json.dumps, get_args(key.hint)))
    bounds = key.hint.__metadata__[0]
    return f"{bounds.least:.8g} to {bounds.most:.8g}"


def command_sections(found: Sequence[Command], level: str = "##") -> str:
    """A section for each command: its description and options. Options that more than half
    of the commands share come first, once."""
    counts = Counter(
        (_option(option), option.help) for _, _, command in found for option in command._actions
    )
    shared = {name for (name, _), count in counts.items() if count > len(found) / 2 > 1}
    parts = []
    if shared - {_option(found[0][2]._actions[0])}:
        parts.append(f"{level} Options of most commands\n\n" + _options(found, shared.__contains__))
    for name, text, command in found:
        own = _options([(name, text, command)], lambda option: option not in shared)
        about = (text or command.description or "").strip()
        sentence = f"{about[:1].upper()}{about[1:].rstrip('.')}."
        parts.append("\n".join(filter(None, [f"{level} {name}\n", sentence + "\n", own])))
    return "\n".join(parts)


def leaves(top: argparse.ArgumentParser, prefix: str = "") -> Iterator[Command]:
    """Every command below a parser: full name, help, parser."""
    prefix = prefix or top.prog
    for action in top._actions:
        if not isinstance(action, argparse._SubParsersAction):
            continue
        helps = {one.dest: one.help or "" for one in action._choices_actions}
        for name, command in action.choices.items():
            below = list(leaves(command, f"{prefix} {name}"))
            yield from below or [(f"{prefix} {name}", helps.get(name, ""), command)]


def _option(option: argparse.Action) -> str:
    """An option as one writes it: its names and its value."""
    value = option.metavar if isinstance(option.metavar, str) else option.dest.upper()
    if not option.option_strings:
        return str(value)
    names = ", ".join(option.option_strings)
    return names if option.nargs == 0 else f"{names} {value}"


def _options(found: Sequence[Command], wanted: Callable[[str], bool]) -> str:
    """The table of the options that are wanted, each once; "" without any."""
    rows: dict[str, str] = {}
    for _, _, command in found:
        for option in command._actions:
            name = _option(option)
            if wanted(name) and option.dest != "help" and option.help != argparse.SUPPRESS:
                text = option.help or ""
                given = {**vars(option), "prog": command.prog}
                rows[name] = text % given if "%" in text else text
    if not rows:
        return ""
    lines = [f"| `{_cell(name)}` | {_cell(text)} |" for name, text in rows.items()]
    return "\n".join(["| option | meaning |", "|---|---|", *lines, ""])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")

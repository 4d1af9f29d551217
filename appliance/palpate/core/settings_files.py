"""The layers of the settings, from TOML files and `--set` options, before `config` checks them. A
command that needs one value does without the schema."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from palpate.core import runtime_folder
from palpate.core.errors import ConfigError, TemporaryError, passes
from palpate.core.text import shown

SITE = Path(runtime_folder.SITE)


class Layers(NamedTuple):
    """The layers, each overriding the layers before it, as (where, table). board: the board file's
    name, "" for none. named_in: "--board", the file that gives it, or "code". folder: where
    `skin.toml` and the boards' files are."""

    board: str
    named_in: str
    folder: Path
    tables: list[tuple[str, dict[str, Any]]]


def read(
    board: str | None, sets: Sequence[str] = (), *, folder: Path | None = None, site: Path = SITE
) -> Layers:
    """All layers; parameters as for `config.load`. Raises ConfigError."""
    if folder and not folder.is_dir():
        raise ConfigError(f"--config-dir {folder}: no such folder; name that of skin.toml")
    folder = folder or default_folder()
    of_site = read_toml(site, needed=site != SITE)
    in_site = of_site.pop("board", "")
    named_in = "--board" if board else str(site) if in_site != "" else "code"
    board = board or in_site
    files = [(folder / "skin.toml", read_toml(folder / "skin.toml", needed=False))]
    if board != "":
        path = _board_file(folder, board, named_in)
        files.append((path, read_toml(path)))
    files.append((site, of_site))
    tables = [(str(path), table) for path, table in files]
    return Layers(board, named_in, folder, [*tables, *(("--set", _parse_set(t)) for t in sets)])


def runtime(layers: Layers) -> Path | None:
    """store.runtime, None if it is "". Raises ConfigError."""
    value: object = runtime_folder.RUNTIME
    for where, table in layers.tables:
        section = table.get("store")
        if isinstance(section, dict) and "runtime" in section:
            value = section["runtime"]
            if not isinstance(value, str):
                given = f"{where}: store.runtime = {shown(value)}"
                raise ConfigError(f'{given} is not allowed; use a folder, or ""')
    return Path(str(value)) if value else None


def boards(folder: Path | None = None) -> dict[str, Path]:
    """The delivered boards' files by name; folder: as for `read`."""
    return {
        path.stem.removeprefix("board-"): path
        for path in sorted((folder or default_folder()).glob("board-*.toml"))
    }


def default_folder() -> Path:
    return Path(runtime_folder.settings_folder())


def read_toml(path: Path, *, needed: bool = True) -> dict[str, Any]:
    """The table in a TOML file; {} for a missing file that is not needed. Raises ConfigError, or
    TemporaryError if it may be readable later."""
    try:
        return tomllib.loads(path.read_text("utf-8-sig"))
    except FileNotFoundError as e:
        if not needed:
            return {}
        raise ConfigError(f"{path}: no such file; check the path") from e
    except OSError as e:
        why = f"{path}: cannot be read: {str(e.strerror).lower()}; check who may read it"
        raise (TemporaryError if passes(e) else ConfigError)(why) from e
    except (ValueError, RecursionError) as e:  # no TOML or no UTF-8; deeply nested brackets
        why = f"{path}: not TOML: {str(e).lower()}"
        raise ConfigError(f"{why}; write key = value, strings in quotes") from e


def _board_file(folder: Path, board: Any, where: str) -> Path:
    known = boards(folder)
    if not (isinstance(board, str) and board in known):
        there = f"boards there: {', '.join(known) or 'none'}"
        missing = f"{where}: board = {shown(board)} has no board-NAME.toml in {folder}"
        raise ConfigError(f"{missing}; {there}")
    return known[board]


def _parse_set(text: str) -> dict[str, Any]:
    """`section.key=value` as the table that a file with this line gives."""
    name, equals, value = text.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot):
        raise ConfigError(f"--set {text}: not understood; use --set section.key=value")
    try:
        (parsed,) = tomllib.loads(f"value = {value}").values()
    except (ValueError, RecursionError):
        parsed = value.strip()
    return {section: {key: parsed}}

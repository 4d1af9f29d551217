"""Settings for tests."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from palpate.core import config
from palpate.core.config import Config

NO_FILE = Path("/dev/null")


def load(sets: Iterable[str] = (), board: str | None = None) -> Config:
    """The settings of this checkout with "section.key=value", `schema.fixed` included."""
    constants, known = [], []
    fixed = fixed_names()
    for text in sets:
        (constants if text.partition("=")[0] in fixed else known).append(text)
    settings = config.load(board, known, site=NO_FILE)
    for text in constants:
        name, _, value = text.partition("=")
        section, _, key = name.partition(".")
        group = getattr(settings, section)
        changed = dataclasses.replace(group, **{key: type(getattr(group, key))(value)})
        settings = dataclasses.replace(settings, **{section: changed})
    return settings


def fixed_names() -> set[str]:
    """The constants beside the settings, as "section.key"."""
    return {
        f"{section}.{f.name}"
        for section, group in config._SECTIONS.items()
        for f in dataclasses.fields(group)
        if "fixed" in f.metadata
    }

"""The tables `[skins.NAME]` of the settings: one for each finger, over the values of `[skin]`."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

from palpate.core.errors import ConfigError
from palpate.core.schema import Key, read_table
from palpate.core.sentences import MOST_FINGERS
from palpate.core.text import closest, shown

_NAME = re.compile(r"[a-z][a-z0-9-]{0,7}", re.ASCII)
"""A name; longer ones would leave no room for the label in a sentence."""
_PART = re.compile(r"([1-4])/([2-4]) (rows|columns)", re.ASCII)


def part(value: Any) -> str | None:
    """The reader of skins.NAME.part, for `schema.custom`."""
    found = _PART.fullmatch(value) if isinstance(value, str) else None
    return value if value == "" or (found and found[1] <= found[2]) else None


def cut(text: str) -> tuple[int, int, int]:
    """A part that is not "" as (index, number of parts, axis): "2/2 columns" is (1, 2, 1)."""
    found = _PART.fullmatch(text)
    assert found
    return int(found[1]) - 1, int(found[2]), int(found[3] == "columns")


def read(table: Any, where: str, known: Mapping[str, Key]) -> dict[str, dict[str, Any]]:
    """The values of each finger in the table `skins` of one layer, as their fields' types. where:
    the layer's name. Raises ConfigError."""
    if not isinstance(table, dict) or not all(isinstance(own, dict) for own in table.values()):
        raise ConfigError(
            f"{where}: skins = {shown(table)} has no finger's table; write [skins.left], its keys "
            "below"
        )
    fingers = {}
    for finger, own in table.items():
        if not _NAME.fullmatch(finger):
            raise ConfigError(
                f"{where}: [skins.{shown(finger)}] is not a finger's name; use up to 8 small "
                "letters, digits and hyphens"
            )
        fingers[finger] = _values(own, f"skins.{finger}", where, known)
    return fingers


def _values(
    own: Mapping[str, Any], prefix: str, where: str, known: Mapping[str, Key]
) -> dict[str, Any]:
    def unknown(name: str) -> ConfigError:
        near = closest(name.rpartition(".")[2], known)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
        return ConfigError(
            f"{where}: {name if name.isprintable() else shown(name)} is unknown; {hint}"
        )

    values = read_table(
        {f"{prefix}.{name}": key for name, key in known.items()},
        {f"{prefix}.{name}": value for name, value in own.items()},
        unknown=unknown,
        refused=lambda why: ConfigError(f"{where}: {why}"),
    )
    return {name.removeprefix(f"{prefix}."): value for name, value in values.items()}


def whole(
    common: Mapping[str, Any], own: Mapping[str, Mapping[str, Any]], where: str
) -> dict[str, dict[str, Any]]:
    """All values of each finger: `common`, with those of its `own`. where: the last layer that
    names a finger. Raises ConfigError unless there are no fingers, or 2 to MOST_FINGERS that differ
    in their skins."""
    if len(own) == 1 or len(own) > MOST_FINGERS:
        raise ConfigError(
            f"{where}: [skins] has {len(own)} finger(s), {', '.join(own)}; use 2 to "
            f"{MOST_FINGERS}, or [skin] for one skin"
        )
    fingers = {finger: {**common, "part": "", **values} for finger, values in own.items()}
    seen: dict[tuple[Any, ...], str] = {}
    for finger, has in fingers.items():
        skin = has["usb"], has["link"], has["port"], has["profile"], has["part"]
        if skin in seen:
            raise ConfigError(
                f"{where}: skins.{seen[skin]} and skins.{finger} are the same skin; give each its "
                "own port, or its own serial number in usb, or its part of a hub, as in "
                'part = "1/2 rows"'
            )
        seen[skin] = finger
    return fingers


def refuse(fingers: Collection[str], what: str) -> None:
    """Raises ConfigError if there are fingers: `what` does not work with several skins."""
    if fingers:
        raise ConfigError(
            f"{what} works with one skin only, and [skins] has {', '.join(fingers)}; leave it out, "
            "or run it with settings that have one [skin]"
        )


def check_chosen(fingers: Collection[str], name: str | None) -> None:
    """Raises ConfigError unless `name`, of the option --finger, is one of the fingers, or is None
    and there are none."""
    known = ", ".join(fingers)
    if name is None and fingers:
        raise ConfigError(
            f"this command works with one skin at a time, and [skins] has {known}; give --finger "
            f"{next(iter(fingers))}"
        )
    if name is None or name in fingers:
        return
    if not fingers:
        raise ConfigError(
            f"--finger {shown(name)}: this box has one skin, [skin]; leave --finger out"
        )
    raise ConfigError(f"--finger {shown(name)} is not among the fingers; [skins] has {known}")

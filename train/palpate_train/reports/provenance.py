"""The header of pages, pictures and results with their commit, bundle, sets, seeds and date.

`of` collects it from the figures of a results.json, whose parts name their origin
(metrics.score.provenance). It is written into HTML as a script with JSON, into SVG as metadata and
into Markdown as a comment; `read` reads it from each of them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate_train.metrics import score
from palpate_train.models.methods import PACKAGED, SHIPPED

NAME = "provenance"
SETS, TEMPLATE = ("set", "sets", "test", "train"), "{"
"""Keys of the names of sets; a name with TEMPLATE stands for several sets, which their results
name."""
FOUND = {
    ".html": rf'<script type="application/json" id="{NAME}">(.*?)</script>',
    ".svg": rf'<metadata id="{NAME}">(.*?)</metadata>',
    ".md": rf"<!-- {NAME} (.*?) -->.*?<!-- /{NAME} -->",
}
"""Position of the header, by the file's suffix."""
ESCAPED = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "--": "\\u002d\\u002d"}
"""Characters that a header escapes, so that the same text is valid in HTML, in SVG and in a
comment."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of figures, which may come from several runs.

    bundle: ids of the bundles that were measured, or that were packaged when the default recipe
    ran; empty if the figures do not state them, or if the default is not among their methods. date:
    of the last run, YYYY-MM-DD or "".
    """

    commit: tuple[str, ...] = ()
    bundle: tuple[str, ...] = ()
    sets: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    date: str = ""

    @property
    def json(self) -> str:
        """The header, in one line."""
        text = json.dumps(asdict(self))
        for sign, code in ESCAPED.items():
            text = text.replace(sign, code)
        return text

    @property
    def older(self) -> str:
        """A warning for the first line of a page if these figures are not of the packaged default;
        otherwise ""."""
        now = score.shipped()
        others = [name for name in self.bundle if name != now]
        if others:
            part = "in part " if now in self.bundle else ""
            return (
                f"Made {part}with an older default, bundle {' and '.join(others)}; "
                f"the box ships bundle {now} now."
            )
        return (
            "" if self.bundle else f"Made without the default that the box ships now, bundle {now}."
        )


def of(figures: Any) -> Provenance:
    """The origin that `figures` state anywhere in them. Methods other than the default have no
    bundle."""
    parts = list(_parts(figures))

    def said(*keys: str) -> list[Any]:
        """The values of these keys, part by part."""
        return [value for part in parts for key in keys for value in _list(part.get(key))]

    # the id of a measured bundle stands alone or next to its name
    bundles = [
        _texts(bundle.get("id") if isinstance(bundle := part.get("bundle"), dict) else bundle)
        or (_texts(part.get("shipped")) if _has_default(part) else [])
        for part in parts
    ]
    return Provenance(
        tuple(dict.fromkeys(_texts(said("commit")))),
        tuple(dict.fromkeys(name for names in bundles for name in names)),
        tuple(dict.fromkeys(name for name in _texts(said(*SETS)) if TEMPLATE not in name)),
        tuple(sorted({seed for seed in said("seed", "seeds") if type(seed) is int})),
        max((text[:10] for text in _texts(said("date", "started"))), default=""),
    )


def in_svg(svg: str, about: Provenance) -> str:
    """The picture with its header, which replaces an earlier one."""
    return without(svg).replace(
        "</title>", f'</title><metadata id="{NAME}">{about.json}</metadata>', 1
    )


def in_markdown(text: str, about: Provenance) -> str:
    """The page with its header below the title, and with a first line that warns if its figures are
    older."""
    title, _, rest = without(text).partition("\n")
    first = f"\n> **{about.older}**\n" if about.older else ""
    return f"{title}\n\n<!-- {NAME} {about.json} -->{first}<!-- /{NAME} -->\n\n{rest.lstrip()}"


def without(text: str) -> str:
    """A page or picture without its header."""
    for pattern in FOUND.values():
        text = re.sub(pattern + r"\n?", "", text, flags=re.DOTALL)
    return text


def read(path: Path) -> Provenance:
    """The header of a page, of a picture or of a file of results. Raises FormatError if it has
    none."""
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".json":
            return of(json.loads(text))
        header = re.search(FOUND[path.suffix], text, flags=re.DOTALL)
        held: dict[str, Any] = json.loads(header[1] if header else "nothing")
        known: dict[str, Any] = {
            name: tuple(v) if isinstance(v, list) else v for name, v in held.items()
        }
        return Provenance(**known)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
        why = e.strerror if isinstance(e, OSError) else "no header that says where it is from"
        raise FormatError(f"{path}: {why}; make it again: python -m palpate_studies reports") from e


def _parts(figures: Any) -> Iterator[dict[str, Any]]:
    """All objects in parsed JSON, the outer ones first; without the description of how a bundle was
    made, which is another run."""
    if isinstance(figures, dict):
        yield figures
    values = (
        [v for k, v in figures.items() if k != "made"] if isinstance(figures, dict) else figures
    )
    for value in values if isinstance(values, list) else ():
        yield from _parts(value)


def _has_default(part: dict[str, Any]) -> bool:
    """Whether the default recipe, or the recipe of the packaged bundle, is among the methods of a
    part; True if the part has no method."""
    methods = [name for key in ("method", "methods") for name in _list(part.get(key))]
    return not methods or SHIPPED in methods or PACKAGED in methods


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | dict) else [] if value is None else [value]


def _texts(value: Any) -> list[str]:
    return [one for one in _list(value) if isinstance(one, str) and one]

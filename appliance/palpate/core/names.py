"""Names of materials: the label on the wire, in ASCII, and the display name, in any language."""

from __future__ import annotations

import re
from collections.abc import Container

from palpate.core.text import printable

MOST_LETTERS, MOST_SHOWN = 24, 60
"""Most characters of a label, and of a display name."""
LABEL = re.compile(rf"[A-Za-z0-9][A-Za-z0-9 _.-]{{0,{MOST_LETTERS - 1}}}")
"""Pattern of a label: short, without comma, star or dollar sign, as sentences need it."""
UNSEEN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0"
    "\ufffc\U0001107f\U00013441\U00013442\U00016fe4\U0001d159\U000e0100-\U000e01ef]"
)
"""Characters that str.isprintable lets pass and that show nothing: fillers, selectors, blanks."""
SPELT_OUT = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"}
    | {"æ": "ae", "Æ": "Ae", "œ": "oe", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L", "đ": "d", "ı": "i"}
)
"""Letters that Unicode does not take apart, and German umlauts, in ASCII."""


def sendable(name: str, taken: Container[str] = (), otherwise: str = "material") -> str:
    """The label for a material of this name: the same if it can be sent, else a similar one in
    ASCII that is not among `taken`. otherwise: the label of a name without a letter in ASCII."""
    if LABEL.fullmatch(name):
        return name
    import unicodedata  # here, as in `composed`

    letters = unicodedata.normalize("NFKD", composed(name).translate(SPELT_OUT))
    plain = " ".join(re.findall(r"[A-Za-z0-9_.-]+", letters.encode("ascii", "ignore").decode()))
    proposal = label = plain.lstrip("_.- ")[:MOST_LETTERS].rstrip() or otherwise
    k = 1
    while label in taken:
        k += 1
        label = f"{proposal[: MOST_LETTERS - len(f' {k}')].rstrip()} {k}"
    return label


def can_be_shown(text: object) -> bool:
    """Whether a text can be a display name: 1 to MOST_SHOWN characters that are printed."""
    if not isinstance(text, str) or not text.isprintable() or UNSEEN.search(text):
        return False
    return 0 < len(text.strip()) <= len(text) <= MOST_SHOWN


def shown(text: str) -> str:
    """A display name for a text of any length and content; "" if nothing of it can be shown."""
    printed = UNSEEN.sub(" ", printable(text, " ")).strip()
    return printed if len(printed) <= MOST_SHOWN else f"{printed[: MOST_SHOWN - 1]}…"


def composed(text: str) -> str:
    """The text in Unicode's form NFC, so that a word typed on two keyboards is one word."""
    if text.isascii():
        return text
    import unicodedata  # here: the box seldom needs its tables

    return unicodedata.normalize("NFC", text)


class TypedNames:
    """Names of materials as a person types them, in any language. displays: names that differ from
    their labels, by label. plain: labels of other materials, which have no such name."""

    def __init__(self) -> None:
        self.displays: dict[str, str] = {}
        self.plain: set[str] = set()

    def add(self, label: str, display: object) -> None:
        """Add a material that was recorded earlier. A display name that cannot be shown is none."""
        if isinstance(display, str) and can_be_shown(display):
            self.displays.setdefault(label, composed(display))
        elif label not in self.displays:
            self.plain.add(label)

    def label(self, typed: str) -> str:
        """The label for a name, always the same for the same name. A name in ASCII, where a bad one
        is a slip, and a name that cannot be shown come back as they are."""
        typed = composed(typed.strip())
        if LABEL.fullmatch(typed):
            self.add(typed, None)
            return typed
        if typed.isascii() or not can_be_shown(typed):
            return typed
        held = (label for label, text in self.displays.items() if text == typed)
        if known := next(held, ""):
            return known
        label = sendable(typed, {*self.displays, *self.plain})
        self.displays[label] = typed
        return label

"""Mutations that keep the structure of a format, so that inputs pass its checksums and brackets.

Each takes an input, a random generator and the fuzzer's own mutator, and returns another input.
"""

import json
import re
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

from palpate.core.sentences import checksum
from palpate.io import packets as wire
from tests.fuzz import enrolments, far_sides
from tests.fuzz.skins import GRIDS

Plain = Callable[[bytes], bytes]
Mutator = Callable[[bytes, Random, Plain], bytes]

ODD: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 4, 4.0, 1500.0, 10**400, 1e-320, float("nan"), float("inf")),
    *("", "a", "\n", "\ud800", "x" * 300, [], {}, [[]], {"a": {}}, "means.npz", "raw", "L"),
)


def rearranged(pieces: list[bytes], random: Random) -> bytes:
    """The pieces of an input, one of them repeated, moved or replaced by another."""
    piece = random.choice(pieces)
    pieces.insert(random.randrange(len(pieces) + 1), piece)
    if random.random() < 0.5:
        pieces.remove(random.choice(pieces))
    return b"".join(pieces)


def parts(split: Callable[[bytes], list[bytes]]) -> Mutator:
    """A mutator that rearranges the pieces that `split` finds after the first, or changes bytes."""

    def mutate(data: bytes, random: Random, plain: Plain) -> bytes:
        head, *pieces = split(data)
        if pieces and random.random() < 0.5:
            return head + rearranged(pieces, random)
        return plain(data)

    return mutate


def packets(data: bytes, random: Random, plain: Plain) -> bytes:
    """Packets removed, repeated or moved, bytes changed, and then most checksums corrected."""
    pieces = [p for p in re.split(rb"(?=\x50\xc1)", data) if p]
    data = rearranged(pieces, random) if pieces and random.random() < 0.3 else plain(data)
    changed = bytearray(data)
    for start in [m.start() for m in re.finditer(re.escape(wire.MAGIC), data)]:
        end = start + wire.HEADER.size + int.from_bytes(changed[start + 4 : start + 6], "little")
        if end + 4 <= len(changed) and random.random() < 0.9:
            changed[end : end + 4] = zlib.crc32(changed[start:end]).to_bytes(4, "little")
    return bytes(changed)


def sentences(data: bytes, random: Random, plain: Plain) -> bytes:
    """Bytes changed, and then most checksums corrected."""

    def seal(match: re.Match[bytes]) -> bytes:
        right = checksum(match[1].decode("latin-1").encode("ascii", "replace").decode())
        return match[0] if random.random() < 0.2 else b"$" + match[1] + b"*" + right.encode()

    return re.sub(rb"\$([^*\r\n]*)\*..", seal, plain(data))


def tables(data: bytes, random: Random, plain: Plain) -> bytes:
    """Lines removed, repeated or moved, or bytes changed."""
    lines = data.split(b"\n")
    if random.random() < 0.5:
        return plain(data)
    line = lines.pop(random.randrange(len(lines)))
    line = plain(line) if random.random() < 0.5 else line
    for _ in range(random.randrange(3)):
        lines.insert(random.randrange(len(lines) + 1), line)
    return b"\n".join(lines)


def trees(data: bytes, random: Random, plain: Plain) -> bytes:
    """An entry of the JSON gets an odd or another's value, another name, or goes."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return plain(data)
    places = list(_places(tree))
    if not places or random.random() < 0.2:
        return plain(data)
    for _ in range(1 + random.randrange(2)):
        branch, key = random.choice(places)
        other, name = random.choice(places)
        if isinstance(branch, dict) and random.random() < 0.2:
            branch[str(name)] = branch.pop(key, None)
        elif isinstance(branch, dict) and random.random() < 0.2:
            branch.pop(key, None)
        elif isinstance(branch, dict) or key < len(branch):
            known = other.get(name) if isinstance(other, dict) else name
            value = random.choice((random.choice(ODD), known))
            branch[key] = value if value is not branch else None
    try:
        return json.dumps(tree).encode()
    except ValueError:  # a branch must not contain itself
        return plain(data)


def headed(data: bytes, random: Random, plain: Plain) -> bytes:
    """The JSON at the head, or the bytes after it, changed; the length is corrected."""
    start, end = data.find(b"{"), data.find(b"}\x93") + 1 or data.find(b"}") + 1
    if not 0 <= start < end or random.random() < 0.3:
        return plain(data)
    head, rest = data[start:end], data[end:]
    if random.random() < 0.6:
        head = trees(head, random, plain)
    else:
        rest = plain(rest)
    length = len(head).to_bytes(4, "little") if start >= 4 else b""
    return data[: start - len(length)] + length + head + rest


def frames(data: bytes, random: Random, plain: Plain) -> bytes:
    """Frames removed, repeated, moved or changed; most sums of PapillArray corrected."""
    begins = rb"(?=\xaa\x55|\x55\x66\x77\x88|\x9a\x00)|(?<=\n)|(?<=\r)"
    pieces = [p for p in re.split(begins, data) if p]
    data = rearranged(pieces, random) if len(pieces) > 1 and random.random() < 0.4 else plain(data)

    def seal(match: re.Match[bytes]) -> bytes:
        right = (sum(match[1]) & 0xFFFF).to_bytes(2, "little")
        sealed = match[0][:4] + match[1] + right + match[0][-4:]
        return match[0] if random.random() < 0.2 else sealed

    return re.sub(rb"(?s)\x55\x66\x77\x88(.*?)..\xaa\xbb\xcc\xdd", seal, data)


def _places(tree: Any) -> Any:
    """(branch, key) of every value, down to the tenth level."""
    stack = [(tree, 0)]
    while stack:
        branch, depth = stack.pop()
        if isinstance(branch, (dict, list)) and depth < 10:
            for key in list(branch) if isinstance(branch, dict) else range(len(branch)):
                yield branch, key
                stack.append((branch[key], depth + 1))


MUTATORS: dict[str, Mutator] = {
    **{"unpack": packets, "command": sentences, "manifest": trees},
    **dict.fromkeys(("feed", "settings", "profile", "import-text"), tables),
    **dict.fromkeys(("recording", "capture"), headed),
    **{"enrolment": enrolments.mutated, "modbus": parts(far_sides.requests_of)},
    **{f"skin-{name}": frames for name in GRIDS},
}

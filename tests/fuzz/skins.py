"""The promises about skins: each codec accepts any bytes, and the reader of profiles any file.

A codec gives the same frames if bytes come in parts, counts garbage, bounds the bytes that it
keeps, and invents no frame. To check the last, a second and slow reader looks for each frame in the
bytes. It follows the skins' published layouts and shares no code with the codecs. A target raises
an error if a promise is broken, as in `targets`.
"""

import json
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from palpate.core.errors import ConfigError
from palpate.io import skin_profile
from palpate.io.skin_codecs import Codec, Decoded, Rest, codec
from palpate.io.skin_profile import SkinProfile
from tests.campaigns.skins.noise import FAULTS
from tests.campaigns.skins.subjects import PROFILES, subject
from tests.fuzz.files import one_line

MOST_REST = 70_000
"""Largest number of bytes that any codec may keep while it waits for more: some frames of the
largest skin."""
GRIDS = {
    "flexitac": (2, 3),
    "anyskin": (1, 2),
    "reskin": (1, 2),
    "3d-vitac": (2, 3),
    "papillarray": (3, 3),
    "xela-can": (1, 2),
    "robotiq-tsf": (7, 4),
}
"""Grids on the wire, small enough that an input holds some frames. One skin for each codec; two for
the codecs for markers and for text, because they use different parts of them."""
SUBJECTS = {name: subject(name, *grid, n=16) for name, grid in GRIDS.items()}
CODECS = {name: codec(subject.profile) for name, subject in SUBJECTS.items()}
"""Made at import, so that their modules are imported while the fuzzer instruments them."""

Enclosed = Callable[[SkinProfile, bytes], Iterator[bytes]]
"""A profile and the bytes up to the end of a frame -> every possible content of the frame, as the
bytes of its numbers."""


def target(name: str) -> Callable[[bytes, Path], None]:
    """The target of the codec that the profile `name` uses."""

    def run(data: bytes, folder: Path) -> None:
        _decode(SUBJECTS[name].profile, CODECS[name], ENCLOSED[name], data)

    run.__doc__ = f"skin_codecs, the codec of {name}: see this module."
    return run


def _decode(profile: SkinProfile, read: Codec, enclosed: Enclosed, data: bytes) -> None:
    got = read(Rest(), data)
    _sound(profile, got, data)
    for end, taxels in zip(got.ends.tolist(), got.taxels, strict=True):
        content = taxels.tobytes()
        assert any(content == other for other in enclosed(profile, data[:end])), (
            f"no such frame ends at {end}"
        )
    for cut in {len(data) // 2, data[-1] % len(data)} if data else {0}:
        first = read(Rest(), data[:cut])
        then = read(first.rest, data[cut:])
        parts = np.concatenate([first.taxels, then.taxels])
        assert parts.tobytes() == got.taxels.tobytes(), (
            f"cut at {cut}, {len(parts)} frames in place of {len(got)}"
        )
        assert first.garbage + then.garbage == got.garbage, f"cut at {cut}, other bytes are garbage"
        assert then.rest.data == got.rest.data


def _sound(profile: SkinProfile, got: Decoded, data: bytes) -> None:
    n = len(got)
    assert got.taxels.shape == (n, *profile.format.shape)
    assert got.taxels.dtype == profile.format.numpy_type
    assert got.skipped.shape == got.ends.shape == (n,)
    assert (got.skipped >= 0).all()
    assert 0 <= got.garbage <= len(data)
    # of a bus with other nodes, only the skin's own lines are kept
    assert profile.codec == "xela-can" or data.endswith(got.rest.data)
    assert len(got.rest.data) <= MOST_REST
    assert (np.diff(got.ends) > 0).all()
    assert n == 0 or (got.ends[0] > 0 and got.ends[-1] <= len(data))
    for stamps in (got.counts, got.times_us):
        assert len(stamps) in (0, n)
        assert all(0 <= stamp < 1 << 32 for stamp in stamps.tolist())
    assert not got.wrong or got.wrong.isprintable()


def _fixed(profile: SkinProfile, before: bytes) -> Iterator[bytes]:
    """Marker, numbers, trailer: the bytes right before the end."""
    kind = np.dtype(profile.number)
    size = profile.rows * profile.cols * profile.values * kind.itemsize
    frame = before[-(len(profile.marker) + size + len(profile.trailer)) :]
    if frame.startswith(profile.marker) and frame.endswith(profile.trailer):
        wire = np.frombuffer(
            frame[len(profile.marker) :][:size],
            kind.newbyteorder(">" if profile.byte_order == "big" else "<"),
        )
        yield _taken(profile, wire)


def _text(profile: SkinProfile, before: bytes) -> Iterator[bytes]:
    """The last lines: a frame, or rows and a shorter line; brackets and a time may stand there."""
    lines = before.split(b"\n")[:-1]
    count = profile.rows if profile.lines == "rows" else 1
    for tail in (lines[-count:], lines[-count - 1 : -1]):
        text = re.sub(rb"[0-9]{2}:[0-9]{2}:[0-9]{2}([.,][0-9]+)?Z?", b" ", b" ".join(tail))
        text = re.sub(rb"[0-9]{4}-[0-9]{2}-[0-9]{2}[T ] ", b" ", text)
        words = re.sub(rb"(?i:null)", b"nan", re.sub(rb"[][(){},;]", b" ", text)).split()
        try:
            wire = np.array([float(word) for word in words])
        except ValueError:
            continue
        if len(wire) == profile.rows * profile.cols * profile.values:
            yield _taken(profile, wire.astype(profile.number))


def _papillarray(profile: SkinProfile, before: bytes) -> Iterator[bytes]:
    """Any beginning whose checksum fits, with no other packet in between; the tables of offsets
    give the places of the pillars."""
    head, tail = bytes.fromhex("55667788"), bytes.fromhex("aabbccdd")
    for start in (m.start() + 4 for m in re.finditer(re.escape(head), before)):
        body = before[start:-6]
        if tail + head in body:
            continue
        if sum(body) & 0xFFFF != int.from_bytes(before[-6:-4], "little") or not body:
            continue
        try:
            yield _taken(profile, np.concatenate(_pillars(body, body[0])))
        except (struct.error, ValueError, KeyError, IndexError):
            continue


def _pillars(body: bytes, width: int) -> list[np.ndarray]:
    """Six numbers of each pillar, in order, from the block of type 3, at any place in the list."""

    def offsets(at: int) -> list[int]:
        (n,) = struct.unpack_from("<H", body, at)
        return [int.from_bytes(body[at + 2 + i * width :][:width], "little") for i in range(n)]

    table = {}
    at = 1
    while at + 2 + width <= min([*table.values(), len(body)]):
        table[int.from_bytes(body[at : at + 2], "little")] = int.from_bytes(
            body[at + 2 : at + 2 + width], "little"
        )
        at += 2 + width
    # a codec may read on in order instead of following the inner offsets, so this searches in
    # order, too
    (n,) = struct.unpack_from("<H", body, table[3])
    place, found = table[3] + 2 + n * width, []
    for _ in range(n):
        (pillars,) = struct.unpack_from("<H", body, place)
        place += 2 + pillars * width
        for _ in range(pillars):
            if body[place : place + 2] != b"\2\0":
                raise ValueError("numbers of another type")
            found.append(np.frombuffer(body, "<f4", 6, place + 2))
            place += 26
    return found


def _xela(profile: SkinProfile, before: bytes) -> Iterator[bytes]:
    """The last R x C messages, one for each taxel in order; answers to commands, and messages of
    other nodes, may stand between them."""
    taxels = range(0x710, 0x710 + profile.rows * profile.cols)
    lines = [
        line
        for line in re.split(rb"[\r\n\a]", before)[:-1]
        if re.match(rb"t[0-9A-Fa-f]{3}[78]", line) and int(line[1:4], 16) in taxels
    ]
    words = []
    for i, line in enumerate(lines[-profile.rows * profile.cols :]):
        match = re.fullmatch(
            rb"t([0-9A-Fa-f]{3})([78])[0-9A-Fa-f]{2}([0-9A-Fa-f]{12})"
            rb"(?:[0-9A-Fa-f]{2})?([0-9A-Fa-f]{4})?",
            line,
        )
        if not match or int(match[1], 16) != 0x710 + i or int(match[3][:2], 16) >= 250:
            return
        words.append(np.frombuffer(bytes.fromhex(match[3].decode()), ">u2"))
    if words:
        yield _taken(profile, np.concatenate(words))


def _robotiq(profile: SkinProfile, before: bytes) -> Iterator[bytes]:
    """Grids of all fingers in the packet that ends here, and in the packets right before it."""
    for start in (m.start() for m in re.finditer(b"\x9a\x00", before)):
        grids = dict(_grids(before[start:]))
        if sorted(grids) == list(range(profile.rows * profile.cols // 28)):
            yield _taken(
                profile, np.concatenate([np.frombuffer(grids[i], ">u2") for i in sorted(grids)])
            )


def _grids(packets: bytes) -> Iterator[tuple[int, bytes]]:
    sizes = {1: 56, 2: 2, 3: 6, 4: 6, 5: 6, 6: 2, 7: 8}
    while packets[:2] == b"\x9a\x00" and len(packets) >= 4:
        content, packets = packets[4 : 4 + packets[3]], packets[4 + packets[3] :]
        while content and content[0] >> 4 in sizes:
            field, content = (
                content[: 1 + sizes[content[0] >> 4]],
                content[1 + sizes[content[0] >> 4] :],
            )
            if field[0] >> 4 == 1 and len(field) == 57:
                yield field[0] >> 2 & 3, field[1:]


def _taken(profile: SkinProfile, wire: np.ndarray) -> bytes:
    """The numbers that the profile uses, rotated as it states, as bytes."""
    grid = wire.reshape(profile.rows, profile.cols, profile.values)[..., list(profile.take)]
    for turn in profile.orientation:
        grid = {
            "transpose": grid.swapaxes(0, 1),
            "flip-rows": grid[::-1],
            "flip-columns": grid[:, ::-1],
        }[turn]
    return np.ascontiguousarray(grid).astype(profile.format.numpy_type).tobytes()


ENCLOSED: dict[str, Enclosed] = {
    "flexitac": _fixed,
    "anyskin": _fixed,
    "reskin": _text,
    "3d-vitac": _text,
    "papillarray": _papillarray,
    "xela-can": _xela,
    "robotiq-tsf": _robotiq,
}


def profile(data: bytes, folder: Path) -> None:
    """skin_profile.load: a profile that reads any bytes and has a name, or a ConfigError."""
    path = folder / "a-skin.toml"
    path.write_bytes(data)
    try:
        got = skin_profile.load("a-skin", [folder])
    except ConfigError as e:
        message = one_line(e)
        assert "a-skin.toml" in message
        return
    assert got.about
    assert got.format.channels == got.rows * got.cols * len(got.take)
    assert skin_profile.from_json(json.loads(json.dumps(got.json())), "a file") == got, (
        "what a profile writes reads as something else"
    )
    for texts in (got.start, got.stop, got.tare):
        assert all(isinstance(command, bytes) for command in got.commands(texts, got.rate_hz))
    assert all(
        0 < vendor < 1 << 16 and 0 <= product < 1 << 16 for vendor, product in got.ids
    ) or 0 in dict(got.ids)
    if got.codec != "palpate":
        _sound(got, codec(got)(Rest(), data[:2000]), data[:2000])


TARGETS: dict[str, Callable[[bytes, Path], None]] = {
    "profile": profile,
    **{f"skin-{name}": target(name) for name in GRIDS},
}

MARKS: dict[str, tuple[bytes, ...]] = {
    "flexitac": (b"\xaa\x55",),
    "anyskin": (b"\r\n",),
    "reskin": (b"\r\n", b"\t", b"nan", b"1e3"),
    "3d-vitac": (b"\r\n\r\n", b"255 "),
    "papillarray": (bytes.fromhex("55667788"), bytes.fromhex("aabbccdd")),
    "xela-can": (b"t7108", b"t711", b"\r", b"z\r"),
    "robotiq-tsf": (b"\x9a\x00\x58", b"\x10", b"\x14"),
}
"""The markers between frames."""


def seeds(name: str) -> list[bytes]:
    """Frames of a skin, damaged ones among them, and the answers of an adapter."""
    subject, rng = SUBJECTS[name], np.random.default_rng(1)
    skin = subject.wire()
    frames = [subject.sent(skin, i) for i in range(8)]
    small = max(1, min(4, 900 // len(frames[0])))
    whole = [b"".join(frames[:small]), frames[0][len(frames[0]) // 2 :] + frames[1] + frames[2]]
    damaged = [fault(frames[0] + frames[1], rng) + frames[2] for fault in FAULTS]
    between = [b"".join([*frames[:4], fault(frames[4], rng), *frames[5:]]) for fault in FAULTS]
    broken = [frames[0][1:], frames[1][:-3], b"", MARKS[name][0]]
    return [*whole, *damaged, *between, *broken, b"\rz\r" + frames[0] + b"\a" + frames[1]]


def profile_seeds() -> list[bytes]:
    """The delivered profiles, the smallest valid one, and invalid ones."""
    files = sorted(PROFILES.glob("*.toml"))
    values = [
        "".join(re.findall(r"^[^#\n].*\n", file.read_text("utf-8"), re.MULTILINE)) for file in files
    ]
    least = 'about = "a"\nsource = "b"\ncodec = "text"\n'
    refused = [least + line for line in ("rows = 4.0", "row = 4", 'marker = "aa"', "take = [1]")]
    return [text.encode() for text in (*values, least, *refused, 'codec = "text"', "[a")]

"""The seeds of each target and the words of its format, from the simulator, PROTOCOL.md, the board
files and the default bundle."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from palpate.bundle import bundle
from palpate.core import config, schema, sentences
from palpate.core.sweep_file import save
from palpate.core.types import DATA_TYPES, Edge, EdgeKind, Frames, Status, Sweep, SweepFormat
from palpate.io import packets, robot_link
from palpate.io.skin_profile import SkinProfile
from palpate.sim import script, skin
from palpate.sweeps.capture import MAGIC, CaptureWriter
from tests.factories.paths import ROOT
from tests.fuzz import enrolments, far_sides, skins
from tests.fuzz.files import NPY

ENDLESS = packets.HEADER.pack(
    *(packets.MAGIC, packets.VERSION, packets.PacketKind.REPLY, packets.MAX_PAYLOAD, 0, 1, 0, 0),
    *(0, 0, 0, 0),
)
"""The header of the largest possible packet; a reader waits for the end of this packet."""


def unpack() -> list[bytes]:
    """Packets of a simulated sweep, of other skins, of a restarted board, and broken packets."""
    frames = next(iter(script.tubes(1, 1))).frames[:60]
    sent = [
        packets.pack(2**32 - 12 + 6 * i, 2**32 - 16_000 + 8000 * i, frames[6 * i : 6 * i + 6])
        for i in range(5)
    ]
    others = [
        packets.pack(7, 9, np.arange(12).reshape(2, 2, 3).astype(d), packets.Flag.OVERFLOW)
        for d in DATA_TYPES
    ]
    axes = packets.pack(7, 9, np.arange(54, dtype=np.float32).reshape(2, 3, 3, 3))
    who = packets.pack_identity(packets.Identity(1, (1, 2, 3), "Palpate skin", "0042"))
    format = packets.pack_format(packets.SkinFormat(4, 4, "uint8", 750, 750, 6))
    replies = packets.pack_reply(packets.Request.IDENTITY, who)
    replies += packets.pack_reply(packets.Request.FORMAT, format)
    restarted = packets.pack(900_000, 5, frames[:1]) + packets.pack(0, 6, frames[1:2])
    swapped = sent[0] + sent[2] + sent[1] + sent[1]
    broken = sent[0][:60] + sent[1] + b"\x50" + sent[2][:-1] + b"\0" + sent[3]
    newer = packets.pack_reply(packets.Request.IDENTITY, b"\x09", version=9)
    largest = packets.pack(1, 2, np.zeros((packets.MAX_FRAMES, 4, 4), np.uint8))
    whole = [b"".join(sent), largest, swapped, restarted, replies, newer + sent[0], who, format]
    return [*whole, broken, *others, axes, ENDLESS + sent[0]]


def command() -> list[bytes]:
    """Commands as people send them, the document's sentences, and other lines."""
    sealed = [
        sentences.sentence(name, *["plastic rough"] * (name in robot_link.TEXT_COMMANDS))
        for name in robot_link.COMMANDS
    ]
    protocol = (ROOT / "firmware_config" / "PROTOCOL.md").read_text("utf-8")
    written = [s.encode() + b"\r\n" for s in re.findall(r"`(\$PPLP[^`]*)`", protocol)]
    by_hand = [b"PPLP," + name.encode() + b"\n" for name in robot_link.COMMANDS]
    others = b"$PPLP,ID*00\r\n", b"x" * 130 + b"\nPPLP,NEW\n", b"PPLP START 30 1.5\n"
    return [b"".join(sealed), b"".join(by_hand), *sealed, *written, *others]


def feed() -> list[bytes]:
    """Requests of a reader, the document's examples, and other lines."""
    requests = [{"frames": 0}, {"frames": 0.5}, {"frames": 20}, {"sweeps": True}]
    asked = [json.dumps(one).encode() for one in requests]
    both = json.dumps({"frames": 5, "sweeps": False}).encode()
    protocol = (ROOT / "firmware_config" / "PROTOCOL.md").read_text("utf-8")
    examples = re.findall(r"`(\{[^`]*\})`", protocol)
    written = [text.encode() + b"\n" for text in examples if "HZ" not in text]
    wrong = [b'{"frames": %s}\n' % value for value in (b"21", b"true", b"NaN")]
    wrong += [b"{}\n", b"[[\n", b"x" * 1100, b"\n"]
    return [b"\n".join([*asked, both, b""]), both + b"\n", *written, *wrong]


def settings() -> list[bytes]:
    """The files that come with the box, and all settings as `palpate config` prints them."""
    files = sorted((ROOT / "firmware_config").glob("*.toml"))
    values = [
        "".join(re.findall(r"^[^#\n].*\n", file.read_text("utf-8"), re.MULTILINE)) for file in files
    ]
    whole = config.describe(config.load(None, site=Path("/dev/null")))
    board = 'board = "a"\n[sweep]\nmax_duration_s = 3\n'
    return [text.encode() for text in (*values, whole, board)]


def manifest() -> list[bytes]:
    """The default bundle's manifest, the smallest valid one, and one without optional rules."""
    whole = (bundle.DEFAULT / bundle.MANIFEST).read_bytes()
    least = json.loads(whole) | {"figures": {}, "made": {}}
    bare = {k: v for k, v in least.items() if k not in ("early", "known", "displacement")}
    bare["files"] = {name: entry for name, entry in least["files"].items() if name != bundle.MEANS}
    return [whole, *(json.dumps(m).encode() for m in (least, bare))]


def recording() -> list[bytes]:
    """Recordings of four frames with three skins, each a sidecar and its frames."""
    found, n = [], np.arange(4)
    skins = (
        SweepFormat(2, 2, 100.0, 4, "int16"),
        SweepFormat(1, 1, 35.61, 4, "uint8"),
        SweepFormat(2, 1, 9.0, 4, "int16", 3),
    )
    for format in skins:
        taxels = np.arange(4 * format.channels).reshape(4, *format.shape).astype(format.numpy_type)
        named = {"material": "wood", "session": "a"}
        sweep = Sweep(1, 0, 40_000_000, Status.OK, Frames(n, n, taxels), **named)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "sweep.npy"
            save(path, sweep, format)
            found.append(path.with_suffix(".json").read_bytes() + path.read_bytes())
    return found


def capture() -> list[bytes]:
    """A capture with a record of each kind, and a capture's header alone."""
    frames, begin = next(iter(script.tubes(1, 1))).frames, 1_000_000_000
    with TemporaryDirectory() as folder:
        path = Path(folder) / "capture"
        writer = CaptureWriter(path, skin.FORMAT)
        writer.state(begin, "streaming")
        for i in range(6):
            now = begin + i * 8_000_000
            writer.transfer(now, packets.pack(6 * i, 8000 * i, frames[6 * i : 6 * i + 6]))
            if i in (2, 4):
                writer.triggered(now + 2, [Edge((EdgeKind.START, EdgeKind.STOP)[i // 4], now + 1)])
        writer.triggered(begin + 45_000_000, [Edge(EdgeKind.START, begin + 44_000_000, 30.0, 1.5)])
        writer.command(begin + 50_000_000, "NEW")
        writer.state(begin + 60_000_000, "lost")
        writer.close()
        data = path.read_bytes()
    return [data, data[: data.index(b"}") + 1]]


SEEDS: dict[str, Callable[[], list[bytes]]] = {
    **{f.__name__: f for f in (unpack, command, feed, settings, manifest, recording, capture)},
    "profile": skins.profile_seeds,
    "enrolment": enrolments.seeds,
    **far_sides.SEEDS,
    **{f"skin-{name}": partial(skins.seeds, name) for name in skins.GRIDS},
}


SETTINGS = (
    *("board = ", " = ", '"', "[", "]", "true", "nan", "-0.0", "1e-9", "0x"),
    *('"\\u0000"', "1979-05-27", "'''"),
)
"""Syntax of settings, and values at its limits."""
JSON_VALUES = (
    *("NaN", "Infinity", "1e999", "4.0", "-1", "true", "null"),
    *('"\\ud800"', '"\\n"', "{}", "[]", "[[[["),
)
"""Values at the limits of JSON, and beyond them."""
FEED = (b'{"frames": ', b'"sweeps": true', b"NaN", b"1e999", b"-0.0", b"null", b"}\n", b", ")
FILES: Mapping[str, tuple[type, ...]] = {
    "manifest": (bundle.Manifest, bundle.Thresholds),
    "recording": (SweepFormat, Sweep),
    "capture": (SweepFormat,),
}
"""Classes whose fields are the keys of a file."""
MAGICS = {"recording": [NPY, b"'descr': ", b"'shape': ", b"(4,)", b"'|O'"], "capture": [MAGIC]}


def _settings() -> list[bytes]:
    """Sections and keys of the settings, and their syntax."""
    groups = {
        f.name: type(getattr(config.load(None, site=Path("/dev/null")), f.name))
        for f in fields(config.Config)
    }
    sections = {name: group for name, group in groups.items() if is_dataclass(group)}
    keys = [key for group in sections.values() for key in schema.keys(group)]
    return [text.encode() for text in (*(f"[{name}]" for name in sections), *keys, *SETTINGS)]


def _file(target: str) -> list[bytes]:
    """Keys of a JSON file, values, and punctuation."""
    names = [f.name for kind in FILES[target] for f in fields(kind)]
    texts = (*(f'"{name}"' for name in names), *JSON_VALUES)
    return [*MAGICS.get(target, []), *(text.encode() for text in texts)]


def words(target: str) -> Sequence[bytes]:
    """The words of the target's format."""
    if target == "unpack":
        kinds = (b"%c%c" % (packets.VERSION, kind) for kind in packets.PacketKind)
        return [packets.MAGIC, ENDLESS, *kinds]
    if target == "command":
        return [b"$PPLP,", b"*", b"\r\n", b"\xff", *(name.encode() for name in robot_link.COMMANDS)]
    if target in far_sides.WORDS:
        return far_sides.WORDS[target]
    if target == "feed":
        return FEED
    if target == "settings":
        return _settings()
    if target == "enrolment":
        return enrolments.words()
    if target == "profile":
        return [f"{field.name} = ".encode() for field in fields(SkinProfile)]
    if target.startswith("skin-"):
        return list(skins.MARKS[target.removeprefix("skin-")])
    return _file(target)

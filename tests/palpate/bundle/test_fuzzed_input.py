"""Results of fuzzing, tested in each run: the corpus, all former crashes, and the detection of each
broken promise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bridges import modbus_pdu
from palpate.bundle import bundle, enrolled, manifest
from palpate.core import config, schema, sentences, sweep_file, types
from palpate.core.errors import ApplianceError
from palpate.io import packets, robot_link, skin_codecs, skin_profile, usb_sensor
from palpate.io.skin_codecs import fixed, frames, papillarray, robotiq, text, xela
from palpate.service import feed_reader
from palpate.sweeps import capture
from palpate_train.data import raw_files
from tests.fuzz import corpus, enrolments, files, seeds, skins, targets

TARGETS = sorted(targets.TARGETS)
INPUTS = {
    name: [
        *seeds.SEEDS[name](),
        *corpus.load(name),
        *(f.read_bytes() for f in corpus.crashes(name)),
    ]
    for name in TARGETS
}


def check_inputs(target: str, folder: Path) -> None:
    """All known inputs of a target."""
    for data in INPUTS[target]:
        targets.TARGETS[target](data, folder)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_what_was_found_still_holds(target, tmp_path):
    """Seeds, saved corpus and former crashes keep every promise."""
    check_inputs(target, tmp_path)


def written(folder: Path, name: str, data: bytes) -> Path:
    """A file in `folder`."""
    (folder / name).write_bytes(data)
    return folder / name


def read_manifest(data: bytes, folder: Path) -> bundle.Bundle:
    """The bundle in `folder` with this manifest."""
    return bundle.load(written(folder, bundle.MANIFEST, data).parent)


def read_recording(data: bytes, folder: Path) -> Any:
    """A recording from sidecar and table."""
    about, magic, table = data.partition(files.NPY)
    written(folder, "s.json", about)
    return sweep_file.load(written(folder, "s.npy", magic + table))


def frames_of(name: str, data: bytes, folder: Path) -> int:
    """Number of frames of a skin."""
    return len(skin_codecs.codec(skins.SUBJECTS[name].profile)(skin_codecs.Rest(), data))


READ: dict[str, Callable[[bytes, Path], Any]] = {
    "unpack": lambda data, folder: packets.unpack(data).packets,
    "command": lambda data, folder: any(not c.error for c in robot_link.parse(data)[0]),
    "feed": lambda data, folder: feed_reader.requests(data)[0],
    "settings": lambda data, folder: config.load(
        None, folder=folder, site=written(folder, "palpate.toml", data)
    ),
    "manifest": read_manifest,
    "enrolment": enrolments.read,
    "recording": read_recording,
    "capture": lambda data, folder: capture.Playback(written(folder, "c", data)).format,
    "modbus": lambda data, folder: modbus_pdu.requests(data)[0],
    "import-text": lambda data, folder: raw_files.read(written(folder, "t.csv", data)).values.size,
    "profile": lambda data, folder: skin_profile.load(
        written(folder, "s.toml", data).stem, [folder]
    ),
    **{f"skin-{name}": partial(frames_of, name) for name in skins.GRIDS},
}
"""Function of each target that reads an input. It returns a value or nothing, or raises an error of
the project."""


def taken(target: str, data: bytes, folder: Path) -> bool:
    """Whether the target accepts an input."""
    try:
        return bool(READ[target](data, folder))
    except ApplianceError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_reaches_what_lies_behind_the_checks(target, tmp_path):
    """Several inputs are accepted and several refused, since a corpus of broken files alone would
    prove little."""
    check_inputs(target, tmp_path)  # writes the other files of a manifest's bundle
    count = sum(taken(target, data, tmp_path) for data in INPUTS[target])
    assert 2 <= count < len(INPUTS[target]) - 2


UNPACK, PARSE, FIT = packets.unpack, robot_link.parse, schema.Key.fit


def fewer(got: packets.Unpacked) -> packets.Unpacked:
    """Without the last packet, whose bytes count as garbage."""
    if not got.packets:
        return got
    size = len(got.packets[-1].taxels.tobytes()) + 24
    return replace(got, packets=got.packets[:-1], garbage=got.garbage + size)


def forgetful(data: bytes) -> packets.Unpacked:
    """Drops the rest of the bytes if a packet is incomplete."""
    got = packets.Unpacked([], [], len(data), b"")
    return got if len(data) < packets.HEADER.size else UNPACK(data)


def searching(data: bytes) -> packets.Unpacked:
    """Searches the next magic from every byte: correct, but in quadratic time."""
    for at in range(len(data)):
        data.find(packets.MAGIC, at)
    return UNPACK(data)


def trusting(data: bytes, at: int, one: Callable[..., Any] = packets._one) -> Any:
    """Does not compare checksums."""
    if len(data) - at >= packets.HEADER.size:
        length = int.from_bytes(data[at + 4 : at + 6], "little")
        end = at + packets.HEADER.size + length
        crc = packets.CRC.pack(packets.zlib.crc32(data[at:end]))
        data = data[:end] + crc + data[end + 4 :] if end + 4 <= len(data) else data
    return one(data, at)


def unguarded(kind: Any, table: Any) -> Any:
    """A dataclass from unchecked values, as the manifest was once read."""
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


def hasty(data: bytes, rest: bytes = b"") -> tuple[list[robot_link.Command], bytes]:
    """Drops a line as soon as it is too long, as was done once."""
    found, rest = PARSE(rest + data)
    return found, b"" if len(rest) > sentences.MAX_LINE else rest


def numb(load: Callable[..., Any]) -> Callable[..., Any]:
    """A function that reads a file and raises an error without its name."""

    def call(*args: Any, **more: Any) -> Any:
        try:
            return load(*args, **more)
        except ApplianceError as e:
            raise type(e)("something is wrong") from e

    return call


def broken_json(text: bytes) -> Any:
    """Raises an error of two lines."""
    raise ValueError("line 1\nline 2")


def unsummed(data: bytes, begin: int) -> int:
    """The next tail ends a packet, whatever its checksum."""
    tail = data.find(b"\xaa\xbb\xcc\xdd", begin)
    return tail + 4 if tail > begin + 2 else 0


def turned(profile: Any, numbers: Any, *more: Any, **named: Any) -> Any:
    """Frames whose numbers come in the opposite order."""
    return frames.collected(profile, [frame[::-1] for frame in numbers], *more, **named)


def after(module: Any, name: str, change: Callable[[Any], Any]) -> tuple[Any, str, Any]:
    """A function of a module with a changed result."""
    right = getattr(module, name)
    return module, name, lambda *args, **more: change(right(*args, **more))


BREAKS: dict[str, tuple[Any, str, Any]] = {
    "unpack: a packet is missed": after(packets, "unpack", fewer),
    "unpack: garbage is not counted": after(packets, "unpack", lambda g: replace(g, garbage=0)),
    "unpack: the rest is dropped": (packets, "unpack", forgetful),
    "unpack: time grows with the square": (packets, "unpack", searching),
    "unpack: a wrong checksum is taken": (packets, "_one", trusting),
    "unpack: frames come twice": after(packets, "follow", lambda g: (g[0] * 2, *g[1:])),
    "unpack: a format from the wrong place": (
        *(packets, "unpack_format"),
        lambda payload: packets.SkinFormat(4, 4, "uint8", 750, 750, 6),
    ),
    "unpack: numbers stand still": after(
        usb_sensor.Stream, "_stamp", lambda f: replace(f, seq=f.seq * 0)
    ),
    "command: one a line is lost": after(robot_link, "parse", lambda g: (g[0][1:], g[1])),
    "command: the end of a long line": (robot_link, "parse", hasty),
    "command: the rest grows": after(robot_link, "parse", lambda g: (g[0], g[1] * 200)),
    "command: any checksum is right": (sentences, "checksum", lambda body: "00"),
    "command: an answer has no limit": (sentences, "MAX_LINE", 200),
    "command: obeyed twice": after(robot_link, "parse", lambda g: (g[0] * 2, g[1])),
    "feed: a request is lost": after(feed_reader, "requests", lambda g: (g[0][1:], g[1])),
    "feed: the rest is dropped": after(feed_reader, "requests", lambda g: (g[0], b"")),
    "feed: frames without a limit": (feed_reader, "MOST_HZ", 1e9),
    "feed: a line has no limit": (feed_reader, "MOST_REQUEST", 10**9),
    "feed: two lines": (feed_reader, "_shown", lambda line: "line 1\nline 2"),
    "settings: no limits": (
        *(schema.Key, "fit"),
        lambda key, value: value if key.hint in (int, float) else FIT(key, value),
    ),
    "settings: any text is a choice": (
        *(schema.Key, "fit"),
        lambda key, value: value if isinstance(value, str) else FIT(key, value),
    ),
    "settings: the file is not named": (config, "load", numb(config.load)),
    "settings: what is described does not load": after(
        config, "describe", lambda text: text.replace("= true", "= 1").replace(":7ac7", "")
    ),
    "manifest: any type": (schema, "_fits", lambda value, hint: True),
    "manifest: two lines": (manifest.json, "loads", broken_json),
    "manifest: golden sweeps of any shape": (
        *(bundle, "_golden"),
        lambda data, manifest: (np.ones((1, 2, 3, 4)), None, ()),
    ),
    "manifest: something else is written": (bundle.Manifest, "json", lambda manifest: b"{}"),
    "recording: a time is lost": (
        *(types, "Frames"),
        lambda t_ns, seq, taxels, made=types.Frames: made(t_ns[1:], seq, taxels),
    ),
    "recording: any type": (sweep_file, "typed", unguarded),
    "recording: the file is not named": (sweep_file, "load", numb(sweep_file.load)),
    "capture: any record": (capture, "_written", lambda kind, t_ns, body: True),
    "capture: the last record is never played": (capture.Playback, "finished", False),
    "skin-flexitac: certain after one period": (
        *(fixed, "_begins"),
        lambda layout, data, at: data.startswith(layout.mark, at + layout.period),
    ),
    "skin-anyskin: the end of a frame is not looked at": (
        *(fixed, "_run"),
        lambda layout, data, at: ((len(data) - len(layout.mark) - at) // layout.period, False),
    ),
    "skin-papillarray: a wrong sum is taken": (papillarray, "_end", unsummed),
    "skin-xela-can: the last taxel first": (xela, "collected", turned),
    "skin-robotiq-tsf: the last taxel first": (robotiq, "collected", turned),
    "skin-3d-vitac: the last taxel first": (text, "collected", turned),
    "enrolment: any number of sweeps": (enrolled, "MOST_SWEEPS", 1 << 62),
    "enrolment: a golden sweep is lost": after(
        enrolled, "with_label", lambda g: replace(g, golden=g.golden[:-1])
    ),
    "enrolment: trained labels move": after(
        enrolled, "extended", lambda g: replace(g, means=g.means + 1)
    ),
    "enrolment: two lines": (enrolled, "AGAIN", "line 1\nline 2"),
    "profile: the file is not named": (skin_profile, "load", numb(skin_profile.load)),
}


@pytest.mark.parametrize("what", BREAKS)
def test_each_promise_can_be_seen_broken(what, tmp_path, monkeypatch):
    """A module that is broken on purpose is detected by the known inputs."""
    monkeypatch.setattr(*BREAKS[what])
    with pytest.raises((AssertionError, AttributeError, ApplianceError)):
        check_inputs(what.partition(":")[0], tmp_path)

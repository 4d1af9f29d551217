"""Results of fuzzing, tested in each run: the corpus, all former crashes, and the detection of each
broken promise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from palpate.bridges import modbus_pdu
from palpate.bundle import arrays, bundle, enrolled, manifest
from palpate.core import config, schema, sentences, sweep_file, types
from palpate.core.errors import ApplianceError
from palpate.io import packets, robot_link, skin_codecs, skin_profile, usb_sensor
from palpate.io.skin_codecs import fixed, papillarray, robotiq, text, xela
from palpate.service import feed_reader
from palpate.sweeps import capture
from palpate_train.data import raw_files
from palpate_train.data.files import text as text_files
from tests.fuzz import corpus, enrolments, files, seeds, skins, targets
from tests.fuzz.mutators import MUTATORS

TARGETS = sorted(targets.TARGETS)
INPUTS = {
    name: [
        *seeds.SEEDS[name](),
        *corpus.load(name),
        *(f.read_bytes() for f in corpus.crashes(name)),
    ]
    for name in TARGETS
}

BROKE = {
    "capture/brackets-in-brackets": "5000 brackets in its head: RecursionError",
    "capture/command-that-is-none": "the command JUMP was played: KeyError when the box obeyed",
    "capture/edge-of-unknown-kind": "kind 200: IndexError while it played",
    "capture/rate-without-end": "1e-320 frames a second: an endless period, OverflowError",
    "capture/rows-with-a-point": "rows = 4.0 in its head: TypeError at the first frame",
    "capture/state-that-is-no-text": "UnicodeDecodeError while it played",
    "capture/time-of-64-bits": "a time that is no int64: OverflowError",
    "command/checksum-beside-noise": "a byte above 127 and a checksum: UnicodeEncodeError, and one "
    "noisy "
    "line "
    "ended "
    "the "
    "box",
    "command/end-of-a-long-line": "a line of over 128 bytes, read in two parts: its end was "
    "carried "
    "out "
    "as "
    "a "
    "command",
    "command/name-without-end": "a command's name of 120 letters took `error` and its reason out "
    "of "
    "the "
    "answer",
    "enrolment/member-that-is-no-array": "numpy gives the bytes of what does not begin as an "
    "array: "
    "AttributeError",
    "manifest/brackets-in-brackets": "5000 brackets: RecursionError",
    "manifest/dead-taxels-of-many-digits": "a number of 401 digits was taken",
    "manifest/figures-in-figures": "figures 800 levels deep were read, but enrolment could not "
    "write "
    "them: "
    "RecursionError",
    "manifest/files-as-text": "`files` was a text that held all names: TypeError",
    "manifest/key-with-a-line-end": "a message of two lines",
    "manifest/name-of-half-a-character": "a name that no terminal shows: UnicodeEncodeError in "
    "`palpate "
    "check`",
    "manifest/number-of-many-digits": "early.least of 401 digits: OverflowError",
    "manifest/rows-with-a-point": "rows = 4.0 came past the golden sweeps: TypeError when the "
    "first "
    "array "
    "was "
    "made",
    "manifest/threshold-as-text": 'contact = "10" was taken: TypeError at the first sweep',
    "manifest/threshold-nan": "contact = NaN was taken: every sweep `no-contact`",
    "recording/brackets-in-brackets": "5000 brackets in its sidecar: RecursionError",
    "recording/format-out-of-range": "the message did not say which file",
    "recording/number-as-text": 'id = "1" was taken',
    "recording/table-head-without-end": "a table whose head is cut: tokenize.TokenError out of "
    "numpy",
    "recording/table-of-a-petabyte": "a table that says it is 21 PiB: MemoryError",
    "settings/brackets-in-brackets": "2000 brackets: RecursionError",
    "settings/delete-character": "a text with a control character was taken, and what `palpate "
    "config` "
    "printed "
    "did "
    "not load",
    "settings/key-with-a-line-end": "a message of two lines",
    "settings/number-of-many-digits": "silence_ms of 4817 digits: ValueError while the message was "
    "made",
    "settings/tables-in-tables": "1500 tables in a value: RecursionError while the message was "
    "made",
    "settings/zero-character": "a path with a zero was taken: ValueError when the bundle was "
    "opened",
    "skin-papillarray/tail-of-a-later-packet": "a changed byte; with the next thirteen packets the "
    "sum "
    "fitted: "
    "a "
    "frame "
    "of "
    "no "
    "skin",
    "unpack/restart-in-one-transfer": "frames before the restart were neither given out nor "
    "counted",
}


def check_inputs(target: str, folder: Path) -> None:
    """All known inputs of a target."""
    for data in INPUTS[target]:
        targets.TARGETS[target](data, folder)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_what_was_found_still_holds(target: str, tmp_path: Path) -> None:
    """Seeds, saved corpus and former crashes keep every promise."""
    check_inputs(target, tmp_path)


def test_each_crash_is_explained() -> None:
    """Each input in crashes/ is explained in BROKE, and each entry of BROKE has an input."""
    there = {f"{target}/{file.stem}" for target in TARGETS for file in corpus.crashes(target)}
    assert there == set(BROKE)


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_is_small_and_read_as_it_was_written(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file has one line for each input, the shortest first, and is small enough for a
    review."""
    file = corpus.SAVED / f"{target}.txt"
    assert file.stat().st_size < 200_000
    saved = corpus.load(target)
    monkeypatch.setattr(corpus, "SAVED", tmp_path)
    corpus.save(target, reversed(saved))
    assert (tmp_path / file.name).read_bytes() == file.read_bytes()
    assert max(map(len, saved)) <= 2048


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
def test_the_corpus_reaches_what_lies_behind_the_checks(target: str, tmp_path: Path) -> None:
    """Several inputs are accepted and several refused, since a corpus of broken files alone would
    prove little."""
    check_inputs(target, tmp_path)  # writes the other files of a manifest's bundle
    count = sum(taken(target, data, tmp_path) for data in INPUTS[target])
    assert 2 <= count < len(INPUTS[target]) - 2


def changed(module: Any, name: str, change: Callable[[Any], Any]) -> Callable[..., Any]:
    """A function of a module with a changed result."""
    right = getattr(module, name)
    return lambda *args, **more: change(right(*args, **more))


def fewer(got: packets.Unpacked) -> packets.Unpacked:
    """Without the last packet, whose bytes count as garbage."""
    if not got.packets:
        return got
    size = len(got.packets[-1].taxels.tobytes()) + 24
    return dataclasses.replace(got, packets=got.packets[:-1], garbage=got.garbage + size)


def forgetful(data: bytes) -> packets.Unpacked:
    """Drops the rest of the bytes if a packet is incomplete."""
    got = packets.Unpacked([], [], len(data), b"")
    return got if len(data) < packets.HEADER.size else UNPACK(data)


def searching(data: bytes) -> packets.Unpacked:
    """Searches the next magic from every byte: correct, but in quadratic time."""
    for at in range(len(data)):
        data.find(packets.MAGIC, at)
    return UNPACK(data)


def trusting(data: bytes, at: int) -> Any:
    """Does not compare checksums."""
    if len(data) - at >= packets.HEADER.size:
        length = int.from_bytes(data[at + 4 : at + 6], "little")
        end = at + packets.HEADER.size + length
        crc = packets.CRC.pack(packets.zlib.crc32(data[at:end]))
        data = data[:end] + crc + data[end + 4 :] if end + 4 <= len(data) else data
    return ONE(data, at)


def unguarded(kind: Any, table: Any) -> Any:
    """A dataclass from unchecked values, as the manifest was once read."""
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


def hasty(data: bytes, rest: bytes = b"") -> tuple[list[robot_link.Command], bytes]:
    """Drops a line as soon as it is too long, as was done once."""
    found, rest = PARSE(rest + data)
    return found, b"" if len(rest) > sentences.MAX_LINE else rest


COLLECTED = text.collected
UNPACK, ONE, PARSE, FIT, FRAMES = (
    packets.unpack,
    packets._one,
    robot_link.parse,
    schema.Key.fit,
    types.Frames,
)


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


def eager(layout: Any, data: bytes, at: int) -> bool:
    """Takes a beginning as certain after one period, whatever the number of bytes."""
    return data.startswith(layout.mark, at + layout.period)


def unsummed(data: bytes, begin: int) -> int:
    """The next tail ends a packet, whatever its checksum."""
    tail = data.find(b"\xaa\xbb\xcc\xdd", begin)
    return tail + 4 if tail > begin + 2 else 0


def turned(profile: Any, numbers: Any, *more: Any, **named: Any) -> Any:
    """Frames whose numbers come in the opposite order."""
    return COLLECTED(profile, [frame[::-1] for frame in numbers], *more, **named)


BREAKS: list[tuple[str, str, Any, str, Any]] = [
    ("unpack", "a packet is missed", packets, "unpack", changed(packets, "unpack", fewer)),
    (
        "unpack",
        "garbage is not counted",
        packets,
        "unpack",
        changed(packets, "unpack", lambda got: dataclasses.replace(got, garbage=0)),
    ),
    ("unpack", "the rest is dropped", packets, "unpack", forgetful),
    ("unpack", "time grows with the square", packets, "unpack", searching),
    ("unpack", "a wrong checksum is taken", packets, "_one", trusting),
    (
        "unpack",
        "frames come twice",
        packets,
        "follow",
        changed(packets, "follow", lambda got: (got[0] * 2, *got[1:])),
    ),
    (
        "unpack",
        "a format is read from the wrong place",
        packets,
        "unpack_format",
        lambda payload: packets.SkinFormat(4, 4, "uint8", 750, 750, 6),
    ),
    (
        "unpack",
        "numbers stand still",
        usb_sensor.Stream,
        "_stamp",
        changed(
            usb_sensor.Stream,
            "_stamp",
            lambda frames: dataclasses.replace(frames, seq=frames.seq * 0),
        ),
    ),
    (
        "command",
        "one command a line is lost",
        robot_link,
        "parse",
        changed(robot_link, "parse", lambda got: (got[0][1:], got[1])),
    ),
    ("command", "the end of a long line is a command", robot_link, "parse", hasty),
    (
        "command",
        "the rest grows",
        robot_link,
        "parse",
        changed(robot_link, "parse", lambda got: (got[0], got[1] * 200)),
    ),
    ("command", "any checksum is right", sentences, "checksum", lambda body: "00"),
    ("command", "an answer has no limit", sentences, "MAX_LINE", 200),
    (
        "command",
        "a command is obeyed twice",
        robot_link,
        "parse",
        changed(robot_link, "parse", lambda got: (got[0] * 2, got[1])),
    ),
    (
        "feed",
        "a request is lost",
        feed_reader,
        "requests",
        changed(feed_reader, "requests", lambda got: (got[0][1:], got[1])),
    ),
    (
        "feed",
        "the rest is dropped",
        feed_reader,
        "requests",
        changed(feed_reader, "requests", lambda got: (got[0], b"")),
    ),
    ("feed", "frames without a limit", feed_reader, "MOST_HZ", 1e9),
    ("feed", "a line has no limit", feed_reader, "MOST_REQUEST", 10**9),
    ("feed", "a message of two lines", feed_reader, "_shown", lambda line: "line 1\nline 2"),
    (
        "settings",
        "limits are not looked at",
        schema.Key,
        "fit",
        lambda key, value: value if key.hint in (int, float) else FIT(key, value),
    ),
    (
        "settings",
        "any text is a choice",
        schema.Key,
        "fit",
        lambda key, value: value if isinstance(value, str) else FIT(key, value),
    ),
    ("settings", "the file is not named", config, "load", numb(config.load)),
    (
        "settings",
        "what is described does not load",
        config,
        "describe",
        changed(
            config, "describe", lambda text: text.replace("= true", "= 1").replace(":7ac7", "")
        ),
    ),
    ("manifest", "types are not looked at", schema, "_fits", lambda value, hint: True),
    ("manifest", "a message of two lines", manifest.json, "loads", broken_json),
    (
        "manifest",
        "golden sweeps of any shape",
        bundle,
        "_golden",
        lambda data, manifest: (np.ones((1, 2, 3, 4)), None),
    ),
    (
        "recording",
        "a time is lost",
        types,
        "Frames",
        lambda t_ns, seq, taxels: FRAMES(t_ns[1:], seq, taxels),
    ),
    ("recording", "types are not looked at", sweep_file, "typed", unguarded),
    ("recording", "the file is not named", sweep_file, "load", numb(sweep_file.load)),
    ("capture", "records are not looked at", capture, "_written", lambda kind, t_ns, body: True),
    ("capture", "the last record is never played", capture.Playback, "finished", False),
    (
        "manifest",
        "what is written is something else",
        bundle.Manifest,
        "json",
        lambda manifest: b"{}",
    ),
    ("skin-flexitac", "frames are told apart by what has come", fixed, "_begins", eager),
    (
        "skin-anyskin",
        "the end of a frame is not looked at",
        fixed,
        "_run",
        lambda layout, data, at: ((len(data) - len(layout.mark) - at) // layout.period, False),
    ),
    ("skin-papillarray", "a wrong sum is taken", papillarray, "_end", unsummed),
    ("skin-xela-can", "the last taxel comes first", xela, "collected", turned),
    ("skin-robotiq-tsf", "the last taxel comes first", robotiq, "collected", turned),
    ("skin-3d-vitac", "the last taxel comes first", text, "collected", turned),
    ("enrolment", "any number of sweeps is taken", enrolled, "MOST_SWEEPS", 1 << 62),
    (
        "enrolment",
        "a golden sweep is lost",
        enrolled,
        "with_label",
        changed(
            enrolled, "with_label", lambda got: dataclasses.replace(got, golden=got.golden[:-1])
        ),
    ),
    (
        "enrolment",
        "classes of trained labels move",
        enrolled,
        "extended",
        changed(enrolled, "extended", lambda got: dataclasses.replace(got, means=got.means + 1)),
    ),
    ("enrolment", "a message of two lines", enrolled, "AGAIN", "line 1\nline 2"),
    ("profile", "the file is not named", skin_profile, "load", numb(skin_profile.load)),
]


@pytest.mark.parametrize(
    ("target", "what", "module", "name", "broken"),
    BREAKS,
    ids=[f"{b[0]}-{b[1].replace(' ', '-')}" for b in BREAKS],
)
def test_each_promise_can_be_seen_broken(
    target: str,
    what: str,
    module: Any,
    name: str,
    broken: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A module that is broken on purpose is detected by the known inputs."""
    monkeypatch.setattr(module, name, broken)
    with pytest.raises((AssertionError, AttributeError, ApplianceError)):
        check_inputs(target, tmp_path)


@pytest.mark.parametrize(
    ("target", "module", "name"),
    [
        ("unpack", packets, "unpack_identity"),
        ("command", sentences, "read"),
        ("feed", feed_reader, "_request"),
        ("settings", config, "_checked"),
        ("manifest", manifest, "typed"),
        ("recording", sweep_file, "typed"),
        ("capture", capture, "typed"),
        ("enrolment", arrays, "summed"),
        ("modbus", modbus_pdu, "parse"),
        ("import-text", text_files, "is_number"),
    ],
)
def test_another_error_is_not_kept_back(
    target: str, module: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unexpected exception leaves the target, so the fuzzer stops at it."""

    def broken(*args: object) -> None:
        raise ZeroDivisionError("broken")

    monkeypatch.setattr(module, name, broken)
    with pytest.raises(ZeroDivisionError, match="broken"):
        check_inputs(target, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_mutated_inputs_stay_well_formed(target: str, tmp_path: Path) -> None:
    """A mutator gives the same outputs for the same seed, and a large part of them is accepted."""

    def plain(data: bytes) -> bytes:
        return data.replace(b"A", b"E")

    data = seeds.SEEDS[target]()[0]
    made = [MUTATORS[target](data, Random(seed), plain) for seed in range(100)]
    assert made == [MUTATORS[target](data, Random(seed), plain) for seed in range(100)]
    assert len(set(made)) > 2
    check_inputs(target, tmp_path)
    assert sum(taken(target, data, tmp_path) for data in made) > 25

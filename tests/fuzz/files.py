"""The promises about files: a site file, a bundle's manifest, a recorded sweep (.npy with its
.json), a capture.

Each target writes the bytes to a folder and reads them. It raises an error if a promise is broken,
as in `targets`.
"""

import dataclasses
import json
import re
import tomllib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.core import config, sentences, sweep_file
from palpate.core.errors import BundleError, ConfigError, FormatError
from palpate.io import robot_link
from palpate.sweeps import capture

BOARD = '[trigger]\nstart = "GPIO5"\nstop = "GPIO6"\n'
NPY = b"\x93NUMPY"


def one_line(error: Exception) -> str:
    """The message of an error, which must be readable as one line of a terminal or a log."""
    text = str(error)
    assert text.isprintable(), f"message is not one printable line: {text!r}"
    return text


def settings(data: bytes, folder: Path) -> None:
    """config.load: a valid Config that is described and loads again, or a ConfigError."""
    site = folder / "palpate.toml"
    (folder / "board-a.toml").write_text(BOARD)
    site.write_bytes(data)
    try:
        got = config.load(None, folder=folder, site=site)
    except ConfigError as e:
        _names_the_place(one_line(e), data)
        return
    for name, value, field, hint in _values(got):
        assert got.sources[name] in ("code", site.name, "board-a.toml")
        least, most = field.metadata.get("least"), field.metadata.get("most")
        if least is not None:
            assert type(value) is type(field.default), f"{name} = {value!r}"
            assert least <= value <= most, f"{name} = {value!r}"
            assert not value % field.metadata.get("step", 1) or "step" not in field.metadata
        for text in value if isinstance(value, tuple) else (value,):
            assert not isinstance(text, str) or text.isprintable(), (
                f"{name} = {value!r} cannot be shown"
            )
        assert "Literal" not in hint or repr(value) in hint.replace('"', "'"), f"{name} = {value!r}"
    lines = config.describe(got)
    assert len(lines.splitlines()) == len(got.sources)
    site.write_text(lines, "utf-8")
    assert config.load(None, folder=folder, site=site) == got, (
        "what describe says loads as something else"
    )


def _values(got: config.Config) -> Iterator[tuple[str, Any, Any, str]]:
    """(name, value, field, its type as written) of all settings."""
    for section in fields(got):
        group = getattr(got, section.name)
        if is_dataclass(group):
            for field in fields(group):
                if "fixed" not in field.metadata:
                    name, value = f"{section.name}.{field.name}", getattr(group, field.name)
                    yield name, value, field, str(field.type)


def _names_the_place(message: str, data: bytes) -> None:
    """Check that a message names the file, and a key in it if the file is TOML."""
    assert "palpate.toml" in message, message
    try:
        table = tomllib.loads(data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n"))
    except (ValueError, RecursionError):
        assert "not TOML" in message, message
        return
    shown = (
        form for key in table for form in (key, repr(key)[1:-1], f"{repr(key)[:77]}...")
    )  # a long key is cut
    assert any(form in message for form in shown), message


def manifest(data: bytes, folder: Path) -> None:
    """bundle.load: a manifest beside the default's files is a usable Bundle or BundleError."""
    for name in (bundle.MODEL, bundle.GOLDEN, bundle.MEANS):
        if not (folder / name).exists():
            (folder / name).write_bytes((bundle.DEFAULT / name).read_bytes())
    (folder / bundle.MANIFEST).write_bytes(data)
    try:
        read = bundle.Manifest.parse(data)
        _usable(read)
        got = bundle.load(folder)
    except BundleError as e:
        one_line(e)
        return
    assert got.manifest == read or read != read, (
        "two readings of one manifest differ"
    )  # NaN among the figures
    assert re.fullmatch("[0-9a-f]{8}", got.id)
    assert set(got.enrolled) <= set(read.labels)
    assert got.golden.shape[1:] == (read.format.window, *read.format.shape)


def _usable(read: bundle.Manifest) -> None:
    """Check that a manifest works in all other modules."""
    f = read.format
    for value in (f.rows, f.cols, f.axes, f.window, read.schema, read.thresholds.dead_taxels):
        assert type(value) is int, f"{value!r} is no whole number"
        assert abs(value) < 1 << 63
    limits = [getattr(read.thresholds, field.name) for field in fields(read.thresholds)]
    limits = [value for value in limits if value is not None]
    assert read.tare.shape == f.shape
    for value in (f.rate_hz, *limits):
        assert type(value) in (int, float), f"{value!r} is no number"
        assert isfinite(value)
    for text in (read.name, read.version, read.input, *read.labels):
        assert isinstance(text, str)
        assert text.isprintable(), f"{text!r} cannot be shown"
    for label, text in read.displays.items():
        assert label in read.labels
        assert text.isprintable(), f"{text!r} cannot be shown"
    for label in read.labels:
        assert f",{label},".encode("ascii") in sentences.sentence("RES", 1, label, "")
    for entry in read.files.values():
        assert isinstance(entry, dict)
    assert isinstance(read.figures, dict)
    again = read.json()
    there = {field.name for field in fields(read) if getattr(read, field.name) is not None}
    assert json.loads(again).keys() == there
    assert bundle.Manifest.parse(again).json() == again, (
        "what a manifest writes reads as something else"
    )


def recording(data: bytes, folder: Path) -> None:
    """sweep.load: a Sweep that saves and loads again, or a FormatError."""
    about, magic, table = data.partition(NPY)
    (folder / "sweep.json").write_bytes(about)
    (folder / "sweep.npy").write_bytes(magic + table)
    try:
        got, format = sweep_file.load(folder / "sweep.npy")
    except FormatError as e:
        message = one_line(e)
        assert "sweep.npy" in message
        return
    n = len(got.frames.t_ns)
    assert got.frames.seq.shape == got.frames.t_ns.shape == (n,)
    assert got.frames.taxels.shape == (n, *format.shape)
    assert np.zeros(format.shape).size * format.period_ns > 0
    for number in (got.id, got.start_ns, got.stop_ns, got.lost, got.complete_ns, got.object):
        assert type(number) is int, f"{number!r} is no whole number"
    for text in (got.material, got.position, got.session):
        assert type(text) is str
        assert text.isprintable(), f"{text!r} cannot be shown"
    assert isinstance(got.share, (int, float))
    sweep_file.save(folder / "again.npy", got, format)
    again, form = sweep_file.load(folder / "again.npy")
    assert form == format
    assert again.frames.taxels.tobytes() == got.frames.taxels.tobytes()
    assert dataclasses.replace(again, frames=got.frames) == got


def played(data: bytes, folder: Path) -> None:
    """capture.Playback: a file plays in as many turns as records, or raises FormatError."""
    file = folder / "capture"
    file.write_bytes(data)
    try:
        play = capture.Playback(file)
    except FormatError as e:
        one_line(e)
        return
    numbers: list[int] = []
    for _ in range(len(data)):  # a record takes more than one byte
        if play.finished:
            break
        frames = play.read()
        numbers += frames.seq.tolist()
        assert frames.t_ns.dtype == np.int64
        assert frames.taxels.shape[1:] == play.format.shape
        for edge in play.edges(play.now_ns()):
            assert 0 <= edge.t_ns < 1 << 63, f"an edge at {edge.t_ns} ns"
        for command in play.commands():
            assert command.name in robot_link.COMMANDS, f"{command.name!r} is no command"
        assert play.state.isprintable(), f"{play.state!r} cannot be shown"
        assert 0 <= play.now_ns() < 1 << 63
    assert play.finished, "it does not come to an end"
    assert all(a < b for a, b in pairwise(numbers)), "numbers of frames do not rise"

"""One contract for all files of the box: whatever lies in place of a file, its reader raises an
error of one line that says which file it is, or takes it for none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.config import StoreConfig
from palpate.core.errors import ApplianceError, BundleError, FormatError
from palpate.core.sweep_file import load, save
from palpate.deployment import shadow
from palpate.deployment.store import Store
from palpate.service import last_failure, status
from palpate.sweeps.capture import CaptureWriter, Playback
from palpate.sweeps.sweep_folder import FORGOTTEN, SweepFolder
from tests.cuts.recording import SHORT, taken
from tests.factories import toy_bundle


class FileFormat(NamedTuple):
    """A reader of `name` in a folder. make: writes whole files there. more: contents that are
    almost right, from the right content. kind: its error; None where it takes a damage for none."""

    name: str
    read: Callable[[Path], Any]
    kind: type[ApplianceError] | None
    make: Callable[[Path], object] = lambda folder: None
    more: Callable[[bytes], Sequence[bytes]] = lambda whole: ()


def sweep(folder: Path) -> None:
    """A recorded sweep."""
    save(folder / "s.npy", taken(1, SHORT)[0], SHORT, {})


def toy(folder: Path) -> None:
    """A bundle."""
    for name, data in toy_bundle.files().items():
        (folder / name).write_bytes(data)


def store(folder: Path) -> Store:
    return Store(StoreConfig(str(folder), str(folder)), lambda bundle: None)


STATES = [b"{}", b'{"floor": 1}', b'{"standings": []}', b'{"standings": {"": []}}']
STATES += [b'{"standings": {"": {"starts": "many"}}}']
PAIRS = [b"{}", b'{"candidate": "x"}', b'{"candidate": "x", "current": "y", "schema": 2}']
HEAD = b"PPLPCAP1"
FORMATS = [
    FileFormat("bundles.json", lambda f: store(f).state, BundleError, more=lambda _: STATES),
    FileFormat(shadow.FILE, shadow.read, FormatError, more=lambda _: PAIRS),
    FileFormat(
        "status.json",
        lambda f: status.read(f / "status.json", 0),
        ApplianceError,
        more=lambda _: [b"{}", b'{"schema": 1, "pid": "x"}'],
    ),
    FileFormat(last_failure.FILE, last_failure.read, None, more=lambda _: [b'{"why": 3}']),
    FileFormat(
        *(FORGOTTEN, lambda f: SweepFolder(f, SHORT), FormatError),
        more=lambda _: [b'{"cork": 3}', b'{"cork": ["x"]}'],
    ),
    FileFormat(
        *("capture", lambda f: Playback(f / "capture"), FormatError),
        lambda folder: CaptureWriter(folder / "capture", SHORT).close(),
        lambda _: [HEAD + b"\x02\0\0\0{}", HEAD + b"\x05\0\0\0{nope"],
    ),
    FileFormat(
        *("s.json", lambda f: load(f / "s.npy"), FormatError, sweep),
        lambda whole: [
            whole.replace(b'"schema": 1', b'"schema": 7'),
            whole.replace(b'"rows": %d' % SHORT.rows, b'"rows": 77'),
        ],
    ),
    FileFormat(
        *("s.npy", lambda f: load(f / "s.npy"), FormatError, sweep),
        lambda whole: [whole[:-1], toy_bundle.npy(np.array([{}]))],
    ),
    FileFormat(bundle.MANIFEST, bundle.load, BundleError, toy),
]
DAMAGES = [b"", b"{", b"[]", b"3", b"null", b'"x"', b"\xff\xfe", b"[" * 100_000]
DAMAGES += [b'{"schema": 99}', b'{"schema": 2}', bytes(100), b'{"a": NaN}', b"nonsense"]


@pytest.mark.parametrize("one", FORMATS, ids=lambda one: one.name)
def test_whatever_lies_in_place_of_a_file(tmp_path, one):
    """Nothing is guessed, and a second look finds the same: no lock is left behind."""
    one.make(tmp_path)
    path = tmp_path / one.name
    whole = path.read_bytes() if path.exists() else b""
    for damage in (*DAMAGES, *one.more(whole)):
        assert damage != whole or not whole
        path.write_bytes(damage)
        for _ in range(2):
            if one.kind is None:
                assert one.read(tmp_path) is None
                continue
            with pytest.raises(one.kind) as e:
                one.read(tmp_path)
            assert path.stem in str(e.value), damage
            assert str(e.value).isprintable(), damage
    path.unlink()
    if whole:
        with pytest.raises(one.kind):
            one.read(tmp_path)
    path.mkdir()
    if one.kind is not None:
        with pytest.raises((ApplianceError, OSError)):
            one.read(tmp_path)

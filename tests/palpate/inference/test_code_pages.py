"""What only the start needed of libraries is released, and needed pages are read again."""

from __future__ import annotations

import ctypes
import mmap
import os
import re
from pathlib import Path

import numpy as np
import pytest
from onnxruntime.capi import onnxruntime_pybind11_state

from palpate.bundle.bundle import Bundle
from palpate.inference.classifier import Classifier
from palpate.inference.session import give_back, session
from palpate.sim.rig import VirtualClock

LIBRARY = os.path.realpath(onnxruntime_pybind11_state.__file__)


def resident_code() -> int:
    """KiB of onnxruntime's code in memory."""
    found = re.findall(
        rf"^\S+ r-xp .*{re.escape(LIBRARY)}\n(?:\S+:.*\n)*?Rss: *(\d+)",
        Path("/proc/self/smaps").read_text(),
        re.M,
    )
    return sum(map(int, found))


@pytest.fixture
def it(default_bundle: Bundle) -> Classifier:
    """A classifier that has run."""
    it = Classifier(default_bundle, VirtualClock())
    it.self_test()
    return it


def test_what_is_given_back_is_read_again(it):
    """The next answer is the same, bit for bit, and reads a part again."""
    golden = it.bundle.golden[0]
    want, before = it.logits(golden), resident_code()
    assert give_back(LIBRARY) > 1024 * before > 0
    assert resident_code() == 0
    np.testing.assert_array_equal(it.logits(golden), want)
    assert 0 < resident_code() < before + 1


def test_opening_a_model_gives_its_code_back(default_bundle):
    """Before its first answer a classifier has less resident code than a bare session."""
    session(default_bundle.model)
    opened = resident_code()
    Classifier(default_bundle, VirtualClock())
    assert resident_code() < opened


def test_nothing_else_is_touched(tmp_path):
    """Without the file or the list nothing; data and writable code stay."""
    assert give_back("/no/such/library.so") == 0
    assert give_back(LIBRARY, tmp_path / "maps") == 0
    lines = [
        line for line in Path("/proc/self/maps").read_text().splitlines() if line.endswith(LIBRARY)
    ]
    written = [f"{line}\nAnonymous: 4 kB\n" for line in lines]
    may_be_written = [f"{re.sub(' r-[x-]p ', ' rw-p ', line)}\nAnonymous: 0 kB\n" for line in lines]
    (tmp_path / "maps").write_text("".join([*written, *may_be_written]))
    assert len(lines) > 2
    assert give_back(LIBRARY, tmp_path / "maps") == 0


def test_a_name_with_blanks_is_a_name_and_a_refusal_counts_nothing(tmp_path):
    """All code of the file and none of another; a range that is not mapped is refused."""
    (tmp_path / "maps").write_text("1000-2000 r-xp 00000000 00:00 1 /lib.so\nAnonymous: 0\n")
    assert give_back("/lib.so", tmp_path / "maps") == 0
    lines = [line for line in Path("/proc/self/maps").read_text().splitlines() if " r-xp " in line]
    own = [line.replace(LIBRARY, "/a  library.so") for line in lines if line.endswith(LIBRARY)]
    (tmp_path / "maps").write_text("".join(f"{one}\nAnonymous: 0 kB\n" for one in own + lines))
    bounds = [line.split()[0].split("-") for line in own]
    size = sum(int(end, 16) - int(begin, 16) for begin, end in bounds)
    assert give_back("/a  library.so", tmp_path / "maps") == size > 0
    assert give_back("/a", tmp_path / "maps") == 0


@pytest.mark.parametrize("written", [False, True])
def test_pages_that_were_written_stay(tmp_path, written):
    """The loader writes addresses into parts of a library, and makes them read-only then."""
    path = tmp_path / "library.so"
    path.write_bytes(b"file" * 2048)
    with path.open("r+b") as file:
        held = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    if written:
        held[:4] = b"mine"
    first = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.from_buffer(held)))
    assert ctypes.CDLL(None).mprotect(first, ctypes.c_size_t(len(held)), mmap.PROT_READ) == 0
    assert give_back(str(path)) == (0 if written else len(held))
    assert held[:4] == (b"mine" if written else b"file")

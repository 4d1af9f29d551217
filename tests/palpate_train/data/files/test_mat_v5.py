"""MAT files: arrays are read as scipy reads them; damage raises an error and never reaches
memory."""

from __future__ import annotations

import io

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core.errors import FormatError
from palpate_train.data.files import mat_v5

TYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?")


def saved(compressed: bool, **values: object) -> bytes:
    """A MAT file written by scipy."""
    file = io.BytesIO()
    scipy.io.savemat(file, values, do_compression=compressed)
    return file.getvalue()


CONTENT = {
    **{
        f"a{kind.replace('?', 'logical')}": (np.arange(12).reshape(4, 3) % 2).astype(kind)
        for kind in TYPES
    },
    "cube": np.arange(24.0).reshape(2, 3, 4),
    "one": 7.0,
    "empty": np.empty((0, 3)),
}


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_are_read_as_scipy_reads_them(compressed: bool):
    """Every class of numbers, cubes, scalars, empty arrays; cells and structures are walked into;
    text and complex numbers are ignored."""
    others = {
        "text": "abc",
        "cell": np.array([1, "a"], object),
        "record": {"x": 1.0},
        "complex": np.array([1j]),
    }
    data = saved(compressed, **CONTENT, **others)
    found, second = mat_v5.arrays(data), scipy.io.loadmat(io.BytesIO(data))
    assert (found.pop("cell{1}"), found.pop("record.x")) == (1, 1)
    assert found.keys() == CONTENT.keys()
    for name, values in found.items():
        assert values.dtype == second[name].dtype, name
        np.testing.assert_array_equal(values, second[name])


def test_the_other_byte_order_is_read():
    """A file from a big-endian machine, built by hand: flags, shape, name in its tag, two
    doubles."""
    flags = b"\0\0\0\6" + b"\0\0\0\x08" + b"\0\0\0\6" + bytes(4)
    shape = b"\0\0\0\5" + b"\0\0\0\x08" + b"\0\0\0\1" + b"\0\0\0\2"
    values = b"\0\0\0\x09" + b"\0\0\0\x10" + np.array([1.5, -2.0], ">f8").tobytes()
    body = flags + shape + b"\0\1\0\1" + b"x\0\0\0" + values
    data = bytes(124) + b"\1\0MI" + b"\0\0\0\x0e" + len(body).to_bytes(4, "big") + body
    np.testing.assert_array_equal(mat_v5.arrays(data)["x"], [[1.5, -2.0]])


WHOLE = {
    compressed: saved(compressed, frames=np.arange(40).reshape(10, 4), t=np.arange(10.0))
    for compressed in (False, True)
}


@settings(max_examples=300, deadline=None)
@given(
    st.booleans(),
    st.integers(0, 2000),
    st.lists(st.tuples(st.integers(100, 2000), st.integers(0, 255)), max_size=6),
)
def test_damage_is_told(compressed: bool, cut: int, changes: list[tuple[int, int]]):
    """Cut anywhere or with altered bytes: the file gives arrays that fit their shapes, or a
    FormatError."""
    data = bytearray(WHOLE[compressed][: len(WHOLE[compressed]) - cut])
    for at, value in changes:
        if at < len(data):
            data[at] = value
    try:
        found = mat_v5.arrays(bytes(data))
    except FormatError:
        return
    assert sum(values.size for values in found.values()) <= 8 * len(data) + 50


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is not a MAT file of version 4 to 7.3; save it with -v7"),
        (WHOLE[False][:-40], "is damaged or cut off: .* bytes at .* exceed its end"),
        (WHOLE[True][:-9], "is damaged"),
        (
            WHOLE[False][:160] + b"\x09" + WHOLE[False][161:],
            r"is damaged: array 'frames' \[9, 4\] holds 320 bytes of int64",
        ),
    ],
)
def test_each_damage_has_its_message(data: bytes, message: str):
    """The message says which part is damaged, and where."""
    with pytest.raises(FormatError, match=message):
        mat_v5.arrays(data)

"""MAT files of version 4, as SciPy writes them, in both byte orders, and damaged."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files import mat_v4

SKIN = (np.arange(60 * 4) % 251).reshape(60, 4)


def saved(**values: object) -> bytes:
    file = io.BytesIO()
    savemat(file, values, format="4")
    return file.getvalue()


@pytest.mark.parametrize("kind", ["f8", "f4", "i4", "i2", "u2", "u1"])
def test_numbers_are_read_in_their_type(tmp_path: Path, kind: str):
    """Beside a vector of times, a text, and complex numbers, which are passed over."""
    skin = SKIN.astype(kind)
    (tmp_path / "a.mat").write_bytes(saved(skin=skin, who="Ada", z=SKIN * 1j, t=np.arange(60.0)))
    found = raw_files.read(tmp_path / "a.mat")
    np.testing.assert_array_equal(found.values, skin)
    assert found.values.dtype == kind
    assert found.beside == ("t",)


def test_the_other_byte_order_is_read():
    """Of a machine with the highest byte first, put together by hand."""
    name, values = b"skin\0", np.array([[1, 2, 3], [4, 5, 6]], ">i2")
    head = struct.pack(">5i", 1030, 2, 3, 0, len(name))
    found = mat_v4.variables(head + name + values.tobytes(order="F"))
    np.testing.assert_array_equal(found["skin"], values)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (saved(skin=SKIN)[:-3], "is damaged or cut off: a matrix exceeds its end by 3"),
        (saved(skin=SKIN) + b"\xff" * 30, r"no matrix of version 4 begins at byte \d+"),
        (saved(skin=SKIN) + b"\0", r"no matrix of version 4 begins at byte \d+"),
    ],
)
def test_damage_is_named(tmp_path: Path, data: bytes, why: str):
    """A cut file, and bytes behind the last matrix."""
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(FormatError, match=why):
        raw_files.read(tmp_path / "a.mat")


@pytest.mark.parametrize("head", [(2000, 1, 1, 0, 2), (0, -1, 1, 0, 2), (0, 1, 1, 0, 0), (70, 1)])
def test_other_files_are_not_of_version_4(tmp_path: Path, head: tuple[int, ...]):
    """Numbers of a VAX, impossible sizes, another type, too few bytes."""
    (tmp_path / "a.mat").write_bytes(struct.pack(f"<{len(head)}i", *head) + bytes(8))
    with pytest.raises(FormatError, match=r"is not a MAT file of version 4 to 7\.3"):
        raw_files.read(tmp_path / "a.mat")

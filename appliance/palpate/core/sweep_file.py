"""Recorded sweeps as files: an .npy with one record per frame, and a JSON sidecar next to it."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from types import MappingProxyType
from typing import Any
from zlib import crc32

import numpy as np

from palpate.core import storage
from palpate.core.errors import FormatError
from palpate.core.schema import typed
from palpate.core.types import Frames, Status, Sweep, SweepFormat

SCHEMA = 1
"""Version of a recorded sweep's sidecar."""
UNREADABLE = (ValueError, TypeError, EOFError, SyntaxError, TokenError, MemoryError)
"""Errors of numpy for a broken .npy, next to OSError."""


def _record_dtype(format: SweepFormat) -> np.dtype[Any]:
    return np.dtype([("t_ns", "<i8"), ("seq", "<i8"), ("taxels", format.numpy_type, format.shape)])


def save(
    path: Path, sweep: Sweep, format: SweepFormat, about: Mapping[str, Any] = MappingProxyType({})
) -> None:
    """Write `sweep` as `path` (.npy, one record per frame) with a JSON sidecar next to it,
    completely or not at all.

    The sidecar gets its name first, so that an .npy always has one. A field that is None is left
    out. about: further content of the sidecar, under names that Sweep does not use. Raises OSError
    if writing fails, and then leaves nothing behind.
    """
    table, frames = np.zeros(len(sweep.frames), _record_dtype(format)), sweep.frames
    table["t_ns"], table["seq"], table["taxels"] = frames.t_ns, frames.seq, frames.taxels
    own = {
        name: value
        for name in Sweep.__slots__
        if name != "frames" and (value := getattr(sweep, name)) is not None
    }
    # np.save writes to a file without Python's I/O, and a full disk then gives no errno
    packed = io.BytesIO()
    np.save(packed, table, allow_pickle=False)
    more = {"format": format.json(), "crc32": crc32(packed.getvalue()), "schema": SCHEMA}
    content = json.dumps({**about, **own, **more}, indent=1).encode()
    storage.put_all({path.with_suffix(".json"): content, path: packed.getvalue()})


def sidecar(path: Path) -> dict[str, Any]:
    """The content of the sidecar of the .npy at `path`. Raises FormatError."""
    try:
        content = json.loads(path.with_suffix(".json").read_text("utf-8"))
        if not isinstance(content, dict):
            raise TypeError(f"{type(content).__name__} instead of an object")
        return content
    except (ValueError, OSError, TypeError, RecursionError) as e:
        raise _broken(path, e) from e


def _broken(path: Path, why: object) -> FormatError:
    form = "a recording is an .npy with its .json next to it"
    return FormatError(f"{path}: not a recorded sweep ({why}); {form}")


def load(path: Path) -> tuple[Sweep, SweepFormat]:
    """Read a sweep that `save` wrote. Raises FormatError."""
    content = sidecar(path)
    try:
        data = path.read_bytes()
        if content["crc32"] != crc32(data):
            raise FormatError(
                "its bytes are not those that were recorded: the file was altered; copy it again"
            )
        table = np.load(io.BytesIO(data), allow_pickle=False)
        format = typed(SweepFormat, content.pop("format"))
        schema = content.pop("schema")
        status = Status(content.pop("status"))
        if schema != SCHEMA:
            raise FormatError(f"schema {schema!r} is unknown to this version; update one of them")
        if table.dtype != _record_dtype(format) or table.ndim != 1:
            raise FormatError(
                f"records of {table.dtype} do not fit the format {format} of its sidecar; "
                "copy both again"
            )
        frames = Frames(table["t_ns"].copy(), table["seq"].copy(), table["taxels"].copy())
        own = {name: content[name] for name in Sweep.__slots__ if name in content}
        return typed(Sweep, own | {"status": status, "frames": frames}), format
    except (*UNREADABLE, OSError, KeyError, AttributeError, RecursionError, FormatError) as e:
        raise _broken(path, e) from e

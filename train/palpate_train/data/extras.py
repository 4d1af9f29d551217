"""Libraries that only some commands need. They come with the extras of palpate-train."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from palpate.core.errors import FormatError

EXTRAS = {
    "torch": "stages",
    "matplotlib": "reports",
    "jinja2": "reports",
    "markupsafe": "reports",
    "aeon": "peers",
    "numba": "peers",
    "pyarrow": "files",
    "python_calamine": "files",
    "nptdms": "files",
    "rosbags": "files",
    "zarr": "files",
    "mcap": "files",
    "distributed": "dask",
}
"""The extra of each library, as in train/pyproject.toml."""


def advice(library: str) -> str:
    """How to install a library of EXTRAS, in words."""
    return f"pip install 'palpate-train[{EXTRAS[library]}]'"


def installed(library: str) -> bool:
    """Whether a library of EXTRAS can be imported; it is not imported."""
    try:
        return find_spec(library) is not None
    except ModuleNotFoundError:
        return False


def library(name: str, what: str, use: str = "read") -> Any:
    """The module `name`, which can `use` `what`. Raises FormatError with the extra that has it."""
    try:
        return import_module(name)
    except ImportError as e:
        why = advice(name.partition(".")[0])
        raise FormatError(f"is {what}; to {use} it: {why} ({e})") from e


@contextmanager
def needed_for(what: str) -> Iterator[None]:
    """Around imports that may lack a library of EXTRAS. Raises FormatError with what needs it and
    the extra that has it."""
    try:
        yield
    except ImportError as e:
        library = (e.name or "").partition(".")[0]
        if library not in EXTRAS:
            raise
        raise FormatError(f"{what} needs {library} ({e}): {advice(library)}") from e

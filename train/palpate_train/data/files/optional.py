"""Libraries that only some formats need. They come with the extra `files`."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from palpate.core.errors import FormatError

EXTRA = "pip install 'palpate-train[files]'"


def library(name: str, what: str, use: str = "read") -> Any:
    """The module `name`, which can `use` `what`. Raises FormatError that names the extra."""
    try:
        return import_module(name)
    except ImportError as e:
        raise FormatError(f"is {what}; to {use} it: {EXTRA} ({e})") from e

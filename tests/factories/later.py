"""Modules that take long to import: a process of tests that runs none of theirs does without."""

from importlib import import_module
from typing import Any


class Later:
    """A module that is imported at its first use; patch it by its full name."""

    def __init__(self, name: str) -> None:
        vars(self)["module"] = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith(("__", "_pytest", "_mock")):  # pytest asks every object
            raise AttributeError(name)
        return getattr(import_module(vars(self)["module"]), name)

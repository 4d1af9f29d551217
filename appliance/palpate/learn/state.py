"""Decisions of a person about recorded sweeps: materials that are no longer taught.

The sweeps themselves stay, for `palpate-train pull` and for a change of mind.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from palpate.core import storage
from palpate.core.config import Config
from palpate.core.errors import FormatError


def file(settings: Config) -> Path:
    """The file of the state in the store's folder; a finger has its own."""
    name = f"teaching-{settings.alone}.json" if settings.alone else "teaching.json"
    return Path(settings.store.folder) / name


@dataclass(frozen=True, slots=True)
class TeachingState:
    """forgotten: for each forgotten material the number of the last sweep in the folder then; later
    sweeps of the same name are taught again."""

    forgotten: dict[str, int] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> TeachingState:
        """The state in a file; empty if there is none. Raises FormatError for other content."""
        try:
            held = json.loads(path.read_bytes())["forgotten"]
            return cls({str(name): int(number) for name, number in held.items()})
        except FileNotFoundError:
            return cls()
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as e:
            raise FormatError(
                f"{path} cannot be read: {e}; remove it, then forgotten materials are taught again"
            ) from e

    def forget(self, path: Path, material: str, last: int) -> TeachingState:
        """The state without the sweeps of a material up to the number `last`; it is in the file
        then. Raises OSError."""
        new = TeachingState(self.forgotten | {material: last})
        content = {"forgotten": new.forgotten}
        storage.put(path, (json.dumps(content, indent=1) + "\n").encode())
        return new

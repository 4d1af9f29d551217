"""Fixtures for the tests of all bridges."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.factories.speaking_box import SpeakingBox


@pytest.fixture
def box(tmp_path: Path) -> Iterator[SpeakingBox]:
    """A box that obeys."""
    with SpeakingBox(tmp_path / "line") as one:
        yield one

"""Slow tests of studies, and of the methods that ours are compared with, are thorough.

Neither reaches a box: a study publishes, and a peer is trained by studies alone. `make test` runs
their other tests.
"""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent
EXTRA_FILES = (HERE / "studies", HERE / "models" / "peers")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the slow tests below these folders."""
    for item in items:
        if item.path.parent in EXTRA_FILES and item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.thorough)

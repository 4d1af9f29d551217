"""Slow tests of studies, and of the methods that ours are compared with, are thorough.

Neither reaches a box: a study publishes, and a peer is trained by studies alone. `make test` runs
their other tests.
"""

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the slow tests of this folder."""
    for item in items:
        here = item.path.is_relative_to(Path(__file__).parent)
        if here and item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.thorough)

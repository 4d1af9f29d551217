"""Tests that install on hosts in containers are thorough: the first install takes minutes."""

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test that uses the hosts."""
    for item in items:
        here = item.path.parent == Path(__file__).parent
        if here and "site" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.thorough)

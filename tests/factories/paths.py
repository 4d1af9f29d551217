"""Paths for tests."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = f"{ROOT / 'appliance'}:{ROOT}"
"""PYTHONPATH of a Python in which palpate is not installed."""
NO_SITE = Path(__file__).with_name("no-site.toml")
"""A site file that does not exist, so that this machine's settings do not matter."""
ONE_AXIS = Path(__file__).with_name("one_axis")
"""A recorded sweep of the toy bundle's format, as it is stored."""

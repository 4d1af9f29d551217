"""Where things are, for tests."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NO_SITE = Path(__file__).with_name("no-site.toml")
"""A site file that is not there: the settings of this machine do not matter."""
ONE_AXIS = Path(__file__).with_name("one_axis")
"""Files that a version without axes wrote: a recorded sweep, a capture of the toy bundle's three
sweeps, its verdicts."""

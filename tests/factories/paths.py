"""Where things are, for tests."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NO_SITE = Path(__file__).with_name("no-site.toml")
"""A site file that is not there: the settings of this machine do not matter."""
ONE_AXIS = Path(__file__).with_name("one_axis")
"""Files that a version without axes wrote: a recorded sweep, a capture of the toy bundle's three
sweeps, its verdicts."""
SIDECARS_2 = Path(__file__).with_name("sidecars_2")
"""Three sweeps of the toy bundle, kept by a version that wrote sidecars of schema 2. Sweeps 1 and 2
are of one object and fused by vote; the contact of sweep 2 is displaced."""

"""Paths for tests."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = f"{ROOT / 'appliance'}:{ROOT}"
"""PYTHONPATH of a Python in which palpate is not installed."""
NO_SITE = Path(__file__).with_name("no-site.toml")
"""A site file that does not exist, so that this machine's settings do not matter."""
ONE_AXIS = Path(__file__).with_name("one_axis")
"""Files of a version without axes: a recorded sweep, a capture of three sweeps with the toy bundle,
and its verdicts.
"""
SIDECARS_2 = Path(__file__).with_name("sidecars_2")
"""Three sweeps with the toy bundle from a version that wrote sidecars of schema 2.

Sweeps 1 and 2 are of one object and fused by vote. The contact of sweep 2 is displaced.
"""

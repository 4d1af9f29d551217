"""Types of the functions with which the module of a command registers it."""

from __future__ import annotations

import argparse
from collections.abc import Callable

Run = Callable[[argparse.Namespace], None]
"""Carries a command out."""
Add = Callable[[str, Run], argparse.ArgumentParser]
"""Adds a command: its name and its function -> its parser."""

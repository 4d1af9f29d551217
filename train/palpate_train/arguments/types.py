"""Types for the registration of commands."""

from __future__ import annotations

import argparse
from collections.abc import Callable

Run = Callable[[argparse.Namespace], None]
"""Runs a command."""
Add = Callable[[str, Run], argparse.ArgumentParser]
"""Adds a command, given its name and its function, and returns its parser."""

"""The limits that the project has set for accuracy under corruptions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

TARGETS = {
    "none": (("noise", 0.0),),
    "noise": (("noise", 0.3),),
    "dead": (("dead", 1.0),),
    "noisy": (("noisy", 1.0),),
    "gain": (("gain-down", 0.2), ("gain-up", 0.2)),
    "lost": (("lost", 0.05),),
    "drift": (("drift", 0.1),),
    "hum": (("hum", 1.0),),
    "shift": (("shift-rows", 1.0), ("shift-grid", 1.0)),
}
"""Corruptions and severities with a limit that the project has set; of several the worst counts."""


def at_targets(curves: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    """Accuracy, lower and upper end of its interval at each of TARGETS that `curves` has, between
    two severities on a line."""
    found = {}
    for key, those in TARGETS.items():
        there = [_at(curves[name], severity) for name, severity in those if name in curves]
        if there:
            found[key] = min(there)
    return found


def _at(curve: Mapping[str, Any], severity: float) -> tuple[float, ...]:
    return tuple(
        float(np.interp(severity, curve["severities"], curve[k]))
        for k in ("accuracy", "low", "high")
    )

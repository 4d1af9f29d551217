"""A small chart for tests: dots as in chart.json, with a known front."""

from __future__ import annotations

from typing import Any


def dot(
    method: str, precision: str, ms: float, speed: float, lopo: float | None = None, **more: Any
) -> dict[str, Any]:
    """A dot whose intervals are two points wide each way. The slower it is, the larger is its
    model.
    """
    accuracy = {
        key: {
            "mean": mean,
            "low": round(mean - 0.02, 4),
            "high": round(mean + 0.02, 4),
            "n": 100,
            "seeds": [1],
        }
        for key, mean in (("speed", speed), ("lopo", lopo))
        if mean is not None
    }
    return {
        "method": method,
        "precision": precision,
        "runtime": "onnx",
        "weights": round(1e5 * ms),
        "macs": round(5e7 * ms),
        "file_kb": 1000 * ms,
        "bundle_kb": 1000 * ms + 25,
        "rss_mb": 60 - ms,
        "ms_p50": ms,
        "ms_p99": 2 * ms,
        "touch_s": 2.0,
        "runs_on_box": True,
        "family": "Palpate",
        "accuracy": accuracy,
        "seeds": [1],
        "set": "sim:T-REAL:1",
        "commit": "abc",
        "machine": "x86_64, 2 cores",
    } | more


DOTS = [
    dot("compact-1k", "int8", 0.02, 0.90, 0.91),
    dot("compact-1k", "float", 0.05, 0.91, 0.92),
    dot("palpate", "int8", 0.04, 0.95, 0.93),
    dot("H-svm", "float", 0.5, 0.93, 0.96, family="L and H"),
    dot("L-gauss", "float", 0.1, 0.6, 0.6, family="L and H"),
    dot("minirocket", "float", 50.0, 0.96, family="MiniRocket"),
    dot("minirocket", "float", 9.0, 0.96, runtime="aeon", runs_on_box=False, family="MiniRocket"),
]
FRONT = {"speed": [0, 2, 6], "lopo": [0, 2, 3]}
"""Indices of the dots on the front over ms_p50, cheapest first."""
SHOWN = [0, 2, 4, 3, 6]
"""Indices of the dots that represent a network over ms_p50 and speed, cheapest first. Each network
is represented by its cheapest dot.
"""

"""Results for the development page: two cases, three methods, a learning curve."""

from __future__ import annotations

from typing import Any


def entry(case: str, method: str, mean: float, each: int = 0) -> dict[str, Any]:
    """One accuracy, its interval five points either way."""
    ends = {"mean": mean, "low": round(mean - 0.05, 4), "high": round(mean + 0.05, 4), "n": 100, "seeds": [1, 2]}
    return {"case": case, "method": method, "each": each, "fit_s": 1.5, "ms_p50": 0.25, "forms": {}} | ends


def figures(**changes: Any) -> dict[str, Any]:
    """Two cases, three methods, one of which could not take the second case; a learning curve of the first."""
    results = [
        entry("one", "default", 0.9), entry("one", "quick <b>", 0.8), entry("one", "quant", 0.85),
        entry("two", "default", 0.7), entry("two", "quant", 0.755),
        entry("one", "default", 0.5, each=5), entry("one", "quant", 0.61, each=5),
    ]  # fmt: skip
    cases = [
        {"case": name, "set": f"{name}.npz", "only": ["force<=180"], "protocol": "leave:force", "means_removed": True,
         "sweeps": 100, "materials": 4, "format": "2x2", "digest": f"digest of {name}", "curve": True}
        for name in ("one", "two")
    ]  # fmt: skip
    made = {"methods": ["default", "quick <b>", "quant"], "seeds": [1, 2], "effort": 1.0, "commit": "0123abcd",
            "machine": "x86_64, 2 cores", "cases": cases, "results": results,
            "left_out": {"quick <b>, two": "a window of 8 frames is too short"}}  # fmt: skip
    return made | changes

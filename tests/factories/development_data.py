"""Results for the page of development: two cases, three methods and a learning curve."""

from __future__ import annotations

from typing import Any


def entry(case: str, method: str, mean: float, each: int = 0) -> dict[str, Any]:
    """An accuracy with an interval of five points each way. `default` is in int8; its float
    accuracy is a point higher.
    """
    ends = {
        "mean": mean,
        "low": round(mean - 0.05, 4),
        "high": round(mean + 0.05, 4),
        "n": 100,
        "seeds": [1, 2],
    }
    forms = {"float": ends | {"mean": round(mean + 0.01, 4)}} if method == "palpate" else {}
    return {
        "case": case,
        "method": method,
        "each": each,
        "fit_s": 1.5,
        "ms_p50": 0.25,
        "forms": forms,
    } | ends


def figures(**changes: Any) -> dict[str, Any]:
    """Two cases, three methods and a learning curve of the first case.

    The third method cannot run the second case.
    """
    results = [
        entry("one", "palpate", 0.9),
        entry("one", "quick <b>", 0.8),
        entry("one", "quant", 0.85),
        entry("two", "palpate", 0.7),
        entry("two", "quant", 0.755),
        entry("one", "palpate", 0.5, each=5),
        entry("one", "quant", 0.61, each=5),
    ]
    cases = [
        {
            "case": name,
            "set": f"{name}.npz",
            "only": ["force<=180"],
            "protocol": "leave:force",
            "means_removed": True,
            "sweeps": 100,
            "materials": 4,
            "format": "2x2",
            "digest": f"digest of {name}",
            "curve": [5],
            "simulated": name == "two",
        }
        for name in ("one", "two")
    ]
    names = ["palpate", "quick <b>", "quant"]
    runs = [
        {
            "methods": names,
            "seeds": [1, 2],
            "effort": 1.0,
            "commit": "0123abcd",
            "machine": "x86_64, 2 cores",
        }
    ]
    made = {
        "methods": names,
        "runs": runs,
        "cases": cases,
        "results": results,
        "times": {
            "set": "sim:T-REAL:1",
            "format": "1500x4x4",
            "left_out": {},
            "entries": [
                {
                    "method": name,
                    "precision": "float",
                    "runtime": "onnx",
                    "runs_on_box": True,
                    "ms_p50": ms,
                    "ms_p99": 2 * ms,
                }
                for name, ms in (("palpate", 0.1), ("quant", 22.0), ("minirocket", 10.0))
            ],
        },
        "left_out": {"quick <b>, two": "a window of 8 frames is too short"},
    }
    return made | changes

"""Results for the page of development: a tactile, a simulated and a published test."""

from typing import Any

SERIES = "GunPoint, published split"


def entry(case: str, method: str, mean: float, **more: Any) -> dict[str, Any]:
    """An accuracy with an interval of five points each way. `palpate` is in int8; its float
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
        "fit_s": 1.5,
        "forms": forms,
    } | (ends | more)


def case(name: str, **more: Any) -> dict[str, Any]:
    """A test with a set of its own; `two` is simulated."""
    return {
        "case": name,
        "set": f"{name}.npz",
        "only": ["force<=180"],
        "protocol": "leave:force",
        "means_removed": True,
        "sweeps": 100,
        "materials": 4,
        "format": "2x2 int16 at 100 Hz, window 200",
        "digest": f"digest of {name}",
        "simulated": name == "two",
    } | more


def timed(method: str, ms: float, precision: str = "float", form: str = "") -> dict[str, Any]:
    """The costs of a method in one precision."""
    return {
        "method": method,
        "form": form,
        "precision": precision,
        "runtime": "onnx",
        "runs_on_box": True,
        "ms_p50": ms,
        "ms_p99": 2 * ms,
    }


def times(*entries: dict[str, Any]) -> dict[str, Any]:
    """The times of one run."""
    return {
        "set": "sim:T-REAL:1",
        "format": "4x4 uint8 at 750 Hz, window 1500",
        "processor": "a processor",
        "left_out": {},
        "box": {"ms_p50": 0.7, "ms_p99": 1.2},
        "entries": list(entries),
    }


def figures(**changes: Any) -> dict[str, Any]:
    """Three tests and four methods; the third cannot run the second test."""
    results = [
        entry("one", "palpate", 0.9),
        entry("one", "quick <b>", 0.8),
        entry("one", "quant", 0.85),
        entry("two", "palpate", 0.7),
        entry("two", "quant", 0.755),
        entry(SERIES, "palpate", 0.92),
        entry(SERIES, "quant", 0.93),
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
        "cases": [case("one"), case("two"), case(SERIES, protocol="split:split=0->1")],
        "results": results,
        "times": times(
            timed("palpate", 0.1, "int8"), timed("quant", 22.0), timed("minirocket", 10.0)
        ),
        "left_out": {"quick <b>, two": "a window of 8 frames is too short"},
    }
    return made | changes

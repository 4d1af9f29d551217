"""Results for the page of development: a tactile, a simulated and a published test."""

from typing import Any

SERIES = "GunPoint, published split"


def entry(case: str, method: str, mean: float, **more: Any) -> dict[str, Any]:
    """An accuracy, five points each way; `palpate` is int8, a point below its float."""
    ends = {"mean": mean, "low": round(mean - 0.05, 4), "high": round(mean + 0.05, 4)}
    ends |= {"n": 100, "seeds": [1, 2]}
    forms = {"float": ends | {"mean": round(mean + 0.01, 4)}} if method == "palpate" else {}
    made = {"case": case, "method": method, "fit_s": 1.5, "forms": forms}
    return made | ends | more


def case(name: str, **more: Any) -> dict[str, Any]:
    """A test with a set of its own; `two` is simulated."""
    made = {"case": name, "set": f"{name}.npz", "only": ["force<=180"], "protocol": "leave:force"}
    made |= {"means_removed": True, "sweeps": 100, "materials": 4}
    made |= {"format": "2x2 int16 at 100 Hz, window 200", "digest": f"digest of {name}"}
    return made | {"simulated": name == "two"} | more


def timed(method: str, ms: float, precision: str = "float", form: str = "") -> dict[str, Any]:
    """The costs of a method in one precision."""
    made = {"method": method, "form": form, "precision": precision, "runtime": "onnx"}
    return made | {"runs_on_box": True, "ms_p50": ms, "ms_p99": 2 * ms}


def times(*entries: dict[str, Any]) -> dict[str, Any]:
    """The times of one run."""
    made = {"set": "sim:T-REAL:1", "format": "4x4 uint8 at 750 Hz, window 1500"}
    made |= {"processor": "a processor", "left_out": {}}
    return made | {"entries": list(entries)}


def figures(**changes: Any) -> dict[str, Any]:
    """Three tests and four methods; the third cannot run the second test."""
    means = {"one": (0.9, 0.8, 0.85), "two": (0.7, None, 0.755), SERIES: (0.92, None, 0.93)}
    names = ["palpate", "quick <b>", "quant"]
    results = [
        entry(name, method, mean)
        for name, row in means.items()
        for method, mean in zip(names, row, strict=True)
        if mean is not None
    ]
    run = {"methods": names, "seeds": [1, 2], "effort": 1.0}
    ours = timed("palpate", 0.1, "int8") | {"answer_ms": 0.7}
    costs = ours, timed("quant", 22.0), timed("minirocket", 10.0)
    made = {
        "methods": names,
        "runs": [run | {"commit": "0123abcd", "machine": "x86_64, 2 cores"}],
        "cases": [case("one"), case("two"), case(SERIES, protocol="split:split=0->1")],
        "results": results,
        "times": times(*costs),
        "left_out": {"quick <b>, two": "a window of 8 frames is too short"},
    }
    return made | changes

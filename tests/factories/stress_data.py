"""Invented results of the study stress: six methods and a bundle, three corruptions."""

from typing import Any

from palpate_train.evaluate import robustness

SEVERITIES = {
    "dead": ("dead taxels", "taxels", [0.0, 1.0, 2.0]),
    "hum": ("50 Hz hum", "deviations", [0.0, 1.0, 2.0]),
    "gain-up": ("higher gain", "share", [0.0, 0.2, 0.5]),
}
PAIRS = {"hum+dead": "50 Hz hum and dead taxels", "gain-up+hum": "higher gain and 50 Hz hum"}
METHODS = {
    "palpate": {"dead": (98, 96, 80), "hum": (98, 90, 60), "gain-up": (98, 97, 97)},
    "minirocket": {"dead": (96, 50, 30), "hum": (96, 96, 40), "gain-up": (96, 95, 95)},
    "minirocket-augmented": {"dead": (97, 98, 90), "hum": (97, 85, 70), "gain-up": (97, 97, 97)},
    "H-svm": {"dead": (80, 80, 79), "hum": (80, 79, 79), "gain-up": (80, 79, 78)},
    "L-svm": {"dead": (80, 80, 79), "hum": (80, 70, 60), "gain-up": (80, 79, 78)},
    "L-knn": {"dead": (80, 80, 79), "hum": (80, 79, 79), "gain-up": (80, 79, 10)},
}
BOX = {
    "correct": {"dead": (95, 5, 0), "hum": (95, 40, 10), "gain-up": (95, 95, 94)},
    "wrong": {"dead": (1, 0, 0), "hum": (1, 2, 3), "gain-up": (1, 1, 7)},
    "unsure": {"dead": (2, 0, 0), "hum": (2, 8, 7), "gain-up": (2, 2, 0)},
    "unknown": {"dead": (2, 0, 0), "hum": (2, 50, 80), "gain-up": (2, 2, 0)},
    "refused": {"dead": (0, 100, 100), "hum": (0, 0, 0), "gain-up": (0, 0, 0)},
    "network": {"dead": (98, 96, 80), "hum": (98, 90, 60), "gain-up": (98, 97, 97)},
}


def figures() -> dict[str, Any]:
    """100 sweeps, one seed; `quant` refused the set; the first method is ours."""
    tasks = [task(name, right) for name, right in METHODS.items()]
    refused = {"method": "quant", "seed": 1, "set": "x", "refused": "needs aeon"}
    methods = robustness.merge([*tasks, refused])["methods"]
    box = robustness.merge([task(name, right) for name, right in BOX.items()])["methods"]
    counted = {kind: {n: entry[kind] for n, entry in box.items()} for kind in ("curves", "pairs")}
    bundle = {"name": "six", "version": "3", "id": "8933e0d5"}
    made = {"set": "sim:T-REAL:1-6", "recipe": {"reattached": True}}
    sets = {"sets": ["sim:T-REAL:101:2"], "train": "sim:T-REAL:1", "train_sweeps": 540}
    sets |= {"train_digest": "aa11", "test": "sim:T-REAL:101:2", "test_sweeps": 100}
    sets |= {"test_digest": "bb22", "attachments": 9, "format": "4x4 uint8 at 750 Hz, window 1500"}
    return sets | {
        "methods": {name: methods[name] for name in (*METHODS, "quant")},
        "box": {"bundle": bundle, "made": made} | counted,
        **{"seeds": [1], "commit": "c0ffee", "machine": "abacus, 2 cores"},
    }


def task(name: str, right: dict[str, tuple[int, ...]]) -> dict[str, Any]:
    """A result of robustness.evaluate_method."""
    curves = {
        key: curve(key, title, unit, severities, right[key])
        for key, (title, unit, severities) in SEVERITIES.items()
    }
    pairs = {}
    for key, title in PAIRS.items():
        parts = [right[part] for part in key.split("+")]
        both = (parts[0][0], min(part[1] for part in parts) - 5 * ("dead" in key))
        pairs[key] = curve(key, title, "", [0.0, 1.0], both)
    made = {"method": name, "seed": 1, "set": "sim:T-REAL:101:2", "refused": "", "total": 100}
    return made | {"curves": curves, "pairs": pairs}


def curve(
    key: str, title: str, unit: str, severities: list[float], right: tuple[int, ...]
) -> dict[str, Any]:
    """The counts of one corruption, of 100 sweeps."""
    return {
        "title": title,
        "unit": unit,
        "about": f"about {key}",
        "severities": severities,
        "right": list(right),
        "low": [n / 100 - 0.05 for n in right],
        "high": [n / 100 + 0.01 for n in right],
    }

"""Invented contents of choice.json: a choice that reaches the target, and one that misses it."""

from __future__ import annotations

from typing import Any

Json = dict[str, Any]


def _accuracy(mean: float) -> Json:
    return {"mean": mean, "low": round(mean - 0.05, 3), "high": round(min(mean + 0.04, 1), 3)}


def _difference(mean: float) -> Json:
    return {"mean": mean, "se": 0.012, "low": round(mean - 0.02, 3), "high": round(mean + 0.02, 3)}


def _model(
    method: str, ms: float, accuracy: float | None, behind: float, why_not: str = ""
) -> Json:
    return {
        "method": method,
        "ms": ms,
        "kb": 100 * ms,
        "mb": 57.0,
        "why_not": why_not,
        "used": {"ms": ms / 50},
        "accuracy": None if accuracy is None else _accuracy(accuracy),
        "behind": None if accuracy is None else _difference(behind),
    }


def _points(*points: tuple[str, float, float]) -> list[Json]:
    return [
        {
            "name": name,
            "share": 1.0,
            "accuracy": _accuracy(mean),
            "behind": _difference(behind),
            "fine": behind <= 0.012,
        }
        for name, mean, behind in points
    ]


def _curve(kind: str, points: list[Json], kept: str, **more: Any) -> Json:
    return {
        "kind": kind,
        "points": points,
        "kept": kept,
        "set": f"set {kind} so",
        "applied": False,
    } | more


def choice(**more: Any) -> Json:
    """Four models with all curves. They reach the target."""
    curves = [
        _curve(
            "window",
            _points(("all", 0.935, 0.0), ("0.5 s", 0.93, 0.005), ("0.2 s", 0.815, 0.12)),
            "0.5 s",
            applied=True,
        ),
        _curve("rate", _points(("750 Hz", 0.935, 0.0), ("375 Hz", 0.875, 0.06)), "750 Hz"),
        _curve(
            "taxels",
            _points(("16", 0.935, 0.0), ("4", 0.928, 0.007)),
            "4",
            taxels=[[0, 0], [0, 3], [3, 0], [3, 3]],
        ),
        _curve("bits", _points(("8", 0.935, 0.0), ("6", 0.932, 0.003)), "6"),
        _curve(
            "classes",
            _points(("3", 0.935, 0.0), ("2", 0.965, 0.0)),
            "3",
            proposed=[["metal", "plastic <smooth>"]],
        ),
    ]
    made = {
        "chosen": "compact-4k",
        "best": "compact-10k",
        "accuracy": _accuracy(0.935),
        "next": "compact-50k",
        "wanted": 0.9,
        "rungs": [
            _model("compact-1k", 0.08, 0.812, 0.131),
            _model("compact-4k", 0.12, 0.935, 0.008),
            _model("compact-10k", 0.31, 0.943, 0.0),
            _model("compact-50k", 0.9, None, 0.0, "over the budget"),
        ],
        "honest": _accuracy(0.928)
        | {
            "groups": {"place": _accuracy(0.928), "day": _accuracy(0.94)},
            "chose": {"compact-4k": 4, "compact-10k": 1},
        },
        "smaller": {"method": "compact-1k"} | _difference(0.123),
        "larger": {"method": "compact-10k"} | _difference(0.008),
        "parts": [
            {"group": "place", "values": list(range(10))},
            {"group": "day", "values": [1, 2]},
        ],
        "conditions": [
            {"name": "as recorded", "accuracy": 0.943},
            {"name": "noise 0.3", "accuracy": 0.927},
        ],
        "confused": [{"is": "metal", "named": "plastic <smooth>", "share": 0.115}],
        "less": curves,
        "left": _accuracy(0.93) | {"behind": _difference(0.005)},
        "bundle": {
            "kb": 12.0,
            "ms": 0.118,
            "mb": 57.0,
            "used": {"ms": 0.014, "kb": 0.024},
            "name": "drawer",
        },
        "scene": "drawer & co",
        "command": "palpate-train choose --scene drawer.toml --out drawer",
        "set": "sim:T-REAL:1",
        "digest": "7f7b49c7",
        "sweeps": 480,
        "materials": ["metal", "plastic <smooth>", "foam"],
        "varies": ["place", "day"],
        "budget": {"ms": 50, "kb": 500, "slower": 3},
        "effort": 0.5,
        "seeds": [1, 2],
        "commit": "c0ffee",
        "machine": "abacus",
    }
    return made | more


def missed() -> Json:
    """A single model that misses the target, with no data held out and no budget."""
    alone = [_model("compact-1k", 0.08, 0.512, 0.0)]
    return choice(
        chosen="compact-1k",
        best="compact-1k",
        next=None,
        wanted=0.99,
        rungs=alone,
        smaller=None,
        larger=None,
        less=[],
        honest=_accuracy(0.51) | {"groups": {"place": _accuracy(0.51)}, "chose": {"compact-1k": 2}},
        confused=[],
        bundle={"kb": 12.0, "ms": 0.118, "mb": 57.0, "used": {}, "name": "drawer"},
        budget={"slower": 3},
        varies=[],
        conditions=[{"name": "as recorded", "accuracy": 0.512}],
    )

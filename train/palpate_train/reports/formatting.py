"""Shares, differences and times as text for pages, pictures and the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import ceil
from typing import Any


def percent(share: float, places: int = 1) -> str:
    """A share as per cent: 0.973 is "97.3 %"."""
    return f"{100 * share:.{places}f} %"


def exact_percent(share: float) -> str:
    """A share as per cent without superfluous decimals: 0.86 is "86 %", 0.923 is "92.3 %"."""
    return f"{round(100 * share, 6):g} %"


def interval(ends: Sequence[float], places: int = 1) -> str:
    """Two shares as per cent: "81.0 – 90.3 %"."""
    low, high = ends
    return f"{100 * low:.{places}f} – {100 * high:.{places}f} %"


def estimate(shares: Sequence[float], places: int = 1) -> str:
    """A share with the ends of its interval: (0.864, 0.81, 0.903) is "86.4 % [81.0, 90.3]"."""
    mean, low, high = shares
    return f"{percent(mean, places)} [{100 * low:.{places}f}, {100 * high:.{places}f}]"


def counted(figure: Mapping[str, float]) -> str:
    """An accuracy with its interval and number of sweeps: "86.4 % [81.0, 90.3] of 250"."""
    ends = [figure[name] for name in ("accuracy", "low", "high")]
    return f"{estimate(ends)} of {figure['n']}"


def figure_lines(figures: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A line for each accuracy of a bundle: the answers of the box with all other outcomes, and the
    network alone."""
    for protocol, figure in figures.items():
        if "wrong" in figure:
            others = ", ".join(
                f"{figure[name]} {name}" for name in ("wrong", "unsure", "unknown", "refused")
            )
            yield f"{protocol}, as the box answers: {counted(figure)}; {others}"
        elif "accuracy" in figure:
            yield f"{protocol}: {counted(figure)}"


def points(difference: float, sign: bool = False) -> str:
    """A difference of shares in percentage points: "2.3", "−0.4". sign: write a plus as well."""
    rounded = round(100 * difference, 1) + 0.0  # no −0
    return f"{rounded:{'+' if sign else ''}.1f}".replace("-", "−")


def amount(value: float, unit: str = "") -> str:
    """A cost in three significant digits with its unit: "0.401 ms", "104 ms"; thousands of KB are
    MB: "15.9 MB"."""
    if unit == "KB" and value >= 1000:
        value, unit = value / 1000, "MB"
    digits = float(f"{value:.3g}")
    return f"{digits:,.0f} {unit}".strip() if digits >= 100 else f"{digits:g} {unit}".strip()


def seconds(value: float) -> str:
    """A duration: "12 min", "31 s", "0.25 s"."""
    return (
        f"{value / 60:.0f} min"
        if value >= 600
        else f"{value:.0f} s"
        if value >= 10
        else f"{value:.2g} s"
    )


def level(curve: Mapping[str, Any], severity: float) -> str:
    """A severity for readers: "35 %", "3 % of full load", "1 taxel", "0.7 rows". A fraction of a
    taxel counts as a whole one."""
    unit = curve["unit"]
    if unit.startswith(("share", "of ")):
        return f"{100 * severity:.2g} % {unit.removeprefix('share')}".rstrip()
    number = f"{ceil(severity) if unit == 'taxels' else severity:.{2 if severity < 99.5 else 3}g}"
    unit = "bits fewer" if unit.startswith("fewer") else unit
    return f"{number} {unit.removesuffix('s') if number == '1' else unit}"

"""Lines of the feed as the box writes them (PROTOCOL.md, part 4), for an invented shift."""

from base64 import b64encode
from typing import Any

import numpy as np
from numpy.typing import NDArray

LABELS = ("metal", "wood", "paper", "plastic rough", "plastic smooth", "foam")
SECOND = 1_000_000_000
RATE_HZ, FRAMES = 750.0, 1500
PLACE = {"pitch_mm": 4.0, "rows_mm": [6.0, 6.4, 6.8], "cols_mm": [6.0, 5.8, 6.2], "limit_mm": 0.6}
FORMAT = {"rows": 4, "cols": 4, "rate_hz": RATE_HZ, "window": FRAMES, "dtype": "uint8"}


def hello(
    pid: int = 71, bundle: str = "9f3c2a1b", source: str = "usb", **other: Any
) -> dict[str, Any]:
    """The first line."""
    alignment = {"contact": 5.0, "place": PLACE, "unloaded": [[0.0] * 4] * 4}
    made = {"type": "hello", "schema": 1, "version": "0.2.0", "pid": pid, "source": source}
    made |= {"bundle": bundle, "labels": list(LABELS), "skin": "palpate", "format": FORMAT}
    made |= {"window_s": FRAMES / RATE_HZ, "frames_hz": 20.0}
    return made | {"alignment": alignment | {"fingertip": "first-row"}} | other


def health(at_s: float, **other: Any) -> dict[str, Any]:
    """The state that the box sends each second."""
    time_ns, frames = round(at_s * SECOND), round(at_s * RATE_HZ)
    made = {"type": "health", "time_ns": time_ns, "since_ns": 0, "skin": "streaming", "trouble": ""}
    made |= {"streams": True, "sweeping": False, "ready": True, "answered": round(at_s / 6)}
    made |= {"frames": frames, "lost_frames": 0, "garbage_bytes": 0, "enumerations": 1}
    made |= {"dropped": 0, "bundle": "9f3c2a1b", "source": "usb"}
    made |= dict.fromkeys(("stale_frames", "overflows", "fifo_overflows", "glitches"), 0)
    made |= {"lost_edges": 0, "storms": 0, "loss_known": True, "degraded": "", "pid": 71}
    made |= {"version": "0.2.0", "model": "tubes 3, 6 labels"}
    return made | {"trial": "on trial: 12 of 20 sweeps", "shadow": ""} | other


def state(skin: str = "streaming", trouble: str = "", *, sweeping: bool = False) -> dict[str, Any]:
    """A change of state."""
    ready = skin == "streaming" and not sweeping
    return {"type": "state", "skin": skin, "trouble": trouble, "sweeping": sweeping, "ready": ready}


def verdict(
    sweep: int, at_s: float, label: str = "plastic rough", status: str = "ok", **other: Any
) -> dict[str, Any]:
    """The answer to a sweep. Its probability is lower if the status is not ok."""
    p = 0.962 if status == "ok" else 0.481
    scores = [p if name == label else (1 - p) / (len(LABELS) - 1) for name in LABELS]
    without = status not in ("ok", "unsure", "undecided")
    made = {"type": "verdict", "sweep": sweep, "time_ns": round(at_s * SECOND), "status": status}
    made |= {"label": "", "probability": 0.0, "margin": 0.0, "scores": [], "own": []}
    if not without:
        made |= {"label": label, "probability": p, "margin": p - (1 - p) / 5}
        made |= {"scores": scores, "own": scores}
    made |= {"fused": 1, "lost": 0, "latency_ns": 1_200_000 + 10_000 * (sweep % 37)}
    made |= {"bundle": "9f3c2a1b", "detail": "", "share": 1.0, "moved": "", "after": 0}
    return made | other


def load(row: float, col: float, strength: float = 120.0) -> NDArray[np.float64]:
    """Raw counts [4, 4] of a contact with its centre at this row and column, in taxels from 0."""
    rows, cols = np.mgrid[0:4, 0:4]
    away = ((rows - row) / 1.1) ** 2 + ((cols - col) / 1.4) ** 2
    return np.asarray(np.round(strength * np.exp(-away)))


def frame(at_s: float, taxels: NDArray[np.float64]) -> dict[str, Any]:
    """The newest frame."""
    return {"type": "frame", "time_ns": round(at_s * SECOND), "taxels": taxels.astype(int).tolist()}


def sweep(number: int, hz: float = 55.0) -> dict[str, Any]:
    """The window of a sweep whose contact vibrates at `hz`."""
    t = np.arange(FRAMES)[:, None, None] / RATE_HZ
    counts = load(1.5, 1.5) * (1 + 0.15 * np.sin(2 * np.pi * hz * t) * np.sin(2 * np.pi * 0.7 * t))
    data = np.clip(np.round(counts), 0, 255).astype(np.uint8)
    made = {"type": "sweep", "sweep": number, "start_ns": 0, "shape": list(data.shape)}
    return made | {"dtype": "uint8", "data": b64encode(data.tobytes()).decode()}

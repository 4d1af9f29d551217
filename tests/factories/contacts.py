"""Contacts on a skin of 4 x 4 taxels for tests: loads, frames and trained positions."""

from typing import Any

import numpy as np

from palpate.answer.contact import ContactPositions

TARE = np.zeros((4, 4))
MIDDLE = ContactPositions(4.0, (6.0, 6.4), (6.0, 5.8), 0.6)


def counts(load: Any) -> np.ndarray:
    """Frames [2, R, C] with this load."""
    return np.stack([np.asarray(load, float)] * 2)


def patch(row: float, col: float) -> np.ndarray:
    """Loads of a round contact, 1.2 taxels wide each way. row, col: its centre in taxels."""
    r, c = np.mgrid[0:4, 0:4]
    return np.maximum(0, 100 * (1 - ((r - row) ** 2 + (c - col) ** 2) / 1.3**2))

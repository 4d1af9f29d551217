"""Loads the time series that the package aeon ships, with their published splits.

They were not recorded with a skin. They show whether a method works only for one kind of sensor.
Nothing is ever downloaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate_train.data import extras

PREFIX = "aeon:"
RATE_HZ = 100.0
"""Assumed frames per second of all series. The files state no rate, but features in Hz need one."""
SETS: Mapping[str, str] = MappingProxyType(
    {
        "ACSF1": "100 + 100 sweeps of 10 appliances, 1460 frames of their power",
        "ArrowHead": "36 + 175 sweeps of 3 arrow heads, 251 frames of their outline",
        "BasicMotions": "40 + 40 sweeps of 4 motions, 100 frames of 6 channels of a watch",
        "GunPoint": "50 + 150 sweeps of 2 motions, 150 frames of a hand's position",
        "ItalyPowerDemand": "67 + 1029 sweeps of 2 seasons, 24 frames of power",
        "OSULeaf": "200 + 242 sweeps of 6 leaves, 427 frames of their outline",
    }
)
"""The contents of each set: sweeps of the published training part + sweeps of the test part."""


def load(name: str) -> tuple[Array, Array, tuple[str, ...], dict[str, Array]]:
    """(samples float32 [N, T, channels, 1], labels int [N], class names, groups) of one of SETS.

    Groups: `split` is 0 for the published training part and 1 for the test part; `recording` is a
    different number for each sweep. Raises FormatError for an unknown name, or if aeon or its copy
    of the set is missing.
    """
    if name not in SETS:
        raise FormatError(
            f"set {PREFIX + name!r} is unknown; use {PREFIX}NAME, NAME one of {', '.join(SETS)}"
        )
    parts = [_part(name, split) for split in ("train", "test")]
    series, classes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    names, labels = np.unique(classes.astype(str), return_inverse=True)
    split = np.repeat([0, 1], [len(part[1]) for part in parts])
    samples = np.ascontiguousarray(series.transpose(0, 2, 1)[..., None], np.float32)
    return (
        samples,
        labels,
        tuple(names.tolist()),
        {"split": split, "recording": np.arange(len(labels))},
    )


def _part(name: str, split: str) -> tuple[Array, Array]:
    """(series [n, channels, T], classes [n])."""
    with extras.needed_for(f"set {PREFIX + name!r}"):
        import aeon.datasets
    # load_classification would download a missing file
    if not (
        Path(aeon.datasets.__file__).parent / "data" / name / f"{name}_{split.upper()}.ts"
    ).is_file():
        raise FormatError(f"this version of aeon does not hold {name}; try {extras.advice('aeon')}")
    series, classes = aeon.datasets.load_classification(name, split=split)
    return series, classes

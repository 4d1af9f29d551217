"""The time series that the package aeon ships, with their published splits.

They were not recorded with a skin. They show whether a method works only for one kind of sensor.
Nothing is ever downloaded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate_train.data import extras
from palpate_train.data.sets import Dataset

PREFIX = "aeon:"
RATE_HZ = 100.0
"""Assumed frames per second of all series. The files state no rate, but features in Hz need one."""


def load(name: str) -> Dataset:
    """The set aeon:NAME; a channel becomes a taxel.

    Groups: `split` is 0 for the published training part and 1 for the test part; `recording` is a
    different number for each sweep. Raises FormatError if aeon or its copy of the set is missing.
    """
    parts = [_part(name.removeprefix(PREFIX), split) for split in ("train", "test")]
    series, classes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    names, labels = np.unique(classes.astype(str), return_inverse=True)
    split = np.repeat([0, 1], [len(part[1]) for part in parts])
    samples = np.ascontiguousarray(series.transpose(0, 2, 1)[..., None], np.float32)
    groups = {"split": split, "recording": np.arange(len(labels))}
    return Dataset(samples, labels, tuple(names.tolist()), RATE_HZ, groups, name)


def _part(name: str, split: str) -> tuple[Array, Array]:
    """(series [n, channels, T], classes [n])."""
    with extras.needed_for(f"set {PREFIX + name!r}"):
        import aeon.datasets
    # load_classification would download a missing file
    folder = Path(aeon.datasets.__file__).parent / "data" / name
    if not (folder / f"{name}_{split.upper()}.ts").is_file():
        raise FormatError(f"this version of aeon does not hold {name}; try {extras.advice('aeon')}")
    series, classes = aeon.datasets.load_classification(name, split=split)
    return series, classes

"""The room of a model alone in a process: its resident memory. In: a packed model's folder, sweeps. Out: JSON.

It is run by its path, not as a part of the package, so that nothing of the desktop is in the process but what the model
itself needs: for a bundle the box's code alone, for a guest its own library.
"""

from __future__ import annotations

import json
import os
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SWEEPS = 20
"""How many it answers before its memory is read."""
TORCH, AEON = "model.pt", "model.npz"
DESKTOP = ("torch", "sklearn", "scipy", "aeon", "numba", "onnx", "train")
"""Packages that the box never has."""


def load(folder: Path) -> Callable[[Any], Any]:
    """What answers digits [T, R, C] with logits [K], as it runs where it can: features are part of it.

    Raises BundleError, and ImportError where a guest's library is missing.
    """
    if (folder / TORCH).is_file():
        return _torch(folder / TORCH)
    if (folder / AEON).is_file():
        return _aeon(folder / AEON)
    from appliance.bundle.bundle import load as load_bundle
    from appliance.core.clock import SystemClock
    from appliance.inference.classifier import Classifier

    return Classifier(load_bundle(folder), SystemClock()).logits


def _torch(path: Path) -> Callable[[Any], Any]:
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of TorchScript, which needs none of our code to be read
        network = torch.jit.load(path)

    def answer(digits: Any) -> Any:
        with torch.inference_mode():
            return network(torch.from_numpy(digits[None])).numpy()[0]

    return answer


def _aeon(path: Path) -> Callable[[Any], Any]:
    from aeon.transformations.collection.convolution_based import MiniRocket

    with np.load(path, allow_pickle=False) as z:
        parameters, silence, weight, bias = tuple(z[f"p{i}"] for i in range(5)), z["silence"], z["weight"], z["bias"]
    features, before = MiniRocket(n_jobs=1), np.random.get_state()
    features.fit(silence)  # it wants to have seen the form of a sweep; what it found there is not used
    np.random.set_state(before)
    features.parameters = parameters

    def answer(digits: Any) -> Any:
        series = np.ascontiguousarray(digits.reshape(1, len(digits), -1).transpose(0, 2, 1), np.float32)
        return weight @ features.transform(series)[0] + bias

    return answer


def main(folder: str, sweeps: str) -> None:
    """Answer some sweeps and tell the resident memory, in 2**20 bytes, and what of the desktop was loaded."""
    answer = load(Path(folder))
    digits = np.load(sweeps)
    for i in range(SWEEPS):
        answer(digits[i % len(digits)])
    resident = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{os.getpid()}/status").read_text())
    assert resident
    foreign = sorted({name.split(".")[0] for name in sys.modules} & set(DESKTOP))
    print(json.dumps({"rss_mb": round(int(resident[1]) / 1024, 1), "foreign": foreign}))


if __name__ == "__main__":
    main(*sys.argv[1:])

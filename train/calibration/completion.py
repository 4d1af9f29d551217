"""The room where a fit becomes complete. In: a Fit. Out: what goes into its bundle beside the network.

The int8 trunk looks at all of the fit's sweeps, and at the copies that taught its head; what stands on it is found there
(finish.py).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.calibration.posthoc import Copies, Finish, finish
from train.models.compact.augment import Augmentation
from train.models.compact.fit import COPIES, Fit, copies, varied
from train.onnx_tools.graph_builder import run

Array = NDArray[Any]
Seen = tuple[Array, Array, Array, Array, int, Copies]
"""The arguments of finish.finish."""


def seen(made: Fit) -> Seen:
    """What its int8 trunk makes of the sweeps that were trained on and held out, in this order.

    Raises FormatError where none was held out: nothing could judge.
    """
    train, held, by = made.train, made.held, made.about["held_out_by"]
    if by == "nothing":
        raise FormatError(f"{train.source}: too few groups to hold some out; record more positions")
    tenths = run(made.trunk(tenths=True), np.concatenate([train.samples, held.samples]))
    labels, groups = np.append(train.labels, held.labels), np.append(train.group(by), held.group(by))
    change = partial(varied, rows=train.format.rows, scene=Augmentation(**made.about["recipe"]["scene"]))
    trunk, seed = made.trunk(), made.about["seed"]
    changed = np.concatenate([run(trunk, copy.samples) for copy in copies(made.network(), train, change, seed)])
    also = Copies(changed, np.tile(train.labels, COPIES), np.tile(train.group(by), COPIES))
    return tenths, labels, groups, np.arange(len(labels)) >= len(train), made.bands, also


def complete(made: Fit) -> Finish:
    """All that stands on the trunk of `made`. Raises FormatError as `seen` and finish.finish."""
    return finish(*seen(made))

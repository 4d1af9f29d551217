"""Static quantization: puts the expensive nodes of a float graph into int8."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

Array = NDArray[Any]
CALIBRATION_SWEEPS = 96
PERCENTILE = 99.9
"""Percentile of the values that is the end of the int8 range. With the full range, one outlier
sweep would take resolution from all others."""


def quantize(
    model: onnx.ModelProto, sweeps: Array, ops: Sequence[str] = ("Conv", "Relu")
) -> onnx.ModelProto:
    """`model` with its nodes `ops` in int8. The ranges come from some of `sweeps`, raw counts [N,
    T, R, C].

    Weights have seven bits: two products of eight bits overflow the 16-bit sums of an x86 without
    VNNI, and the answer there would differ from the answer on Arm.
    """
    from onnxruntime import quantization as ort  # not for the constants of this module alone

    left = iter(calibration_sweeps(sweeps))

    class Sweeps(ort.CalibrationDataReader):  # type: ignore[misc]  # onnxruntime ships no types
        def get_next(self) -> dict[str, Array] | None:
            sweep = next(left, None)
            return None if sweep is None else {"sweep": sweep[None]}

    copy = onnx.ModelProto()
    copy.CopyFrom(model)  # a copy, because onnxruntime moves the weights of its argument to a file
    # nothing to simplify beforehand
    copy.metadata_props.add(key="onnx.quant.pre_process", value="onnxruntime.quant")
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "int8.onnx"
        ort.quantize_static(
            copy,
            path,
            Sweeps(),
            ort.QuantFormat.QDQ,
            list(ops),
            per_channel=True,
            reduce_range=True,
            activation_type=ort.QuantType.QUInt8,
            weight_type=ort.QuantType.QInt8,
            calibrate_method=ort.CalibrationMethod.Percentile,
            extra_options={"CalibPercentile": PERCENTILE},
        )
        made = onnx.load(path)
    for constant in made.graph.initializer:
        # onnxruntime sets this field to its default; the box refuses the field
        constant.ClearField("data_location")
    return made


def calibration_sweeps(sweeps: Array) -> Array:
    """At most CALIBRATION_SWEEPS of `sweeps` [N, ...], evenly spaced. Ranges and comparisons use
    them."""
    some: Array = sweeps[
        np.linspace(0, len(sweeps) - 1, min(CALIBRATION_SWEEPS, len(sweeps))).astype(int)
    ]
    return some

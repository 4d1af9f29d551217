"""The room of int8. In: a float graph, sweeps of the training set. Out: the graph with its heavy nodes in int8."""

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
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

Array = NDArray[Any]
CALIBRATION_SWEEPS = 96
PERCENTILE = 99.9
"""Of the values that int8 must reach: with their full range one outlier sweep takes the resolution from all others."""


def quantize(model: onnx.ModelProto, sweeps: Array, ops: Sequence[str] = ("Conv", "Relu")) -> onnx.ModelProto:
    """`model` with its nodes `ops` in int8, ranges found on some of `sweeps`: digits [N, T, R, C].

    Weights keep to seven bits: two products of eight overflow the 16-bit sums of an x86 without VNNI, and then the
    answer there is another than on Arm.
    """
    some = np.linspace(0, len(sweeps) - 1, min(CALIBRATION_SWEEPS, len(sweeps))).astype(int)
    mine = onnx.ModelProto()
    mine.CopyFrom(model)  # onnxruntime moves the weights of what it is given to a file
    mine.metadata_props.add(key="onnx.quant.pre_process", value="onnxruntime.quant")  # nothing to simplify beforehand
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "int8.onnx"
        quantize_static(
            mine, path, _CalibrationReader(sweeps[some]), QuantFormat.QDQ, list(ops), per_channel=True, reduce_range=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.Percentile, extra_options={"CalibPercentile": PERCENTILE},
        )  # fmt: skip
        return onnx.load(path)


class _CalibrationReader(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime ships no types
    """Hands sweeps to the calibration one by one."""

    def __init__(self, sweeps: Array) -> None:
        self._left = iter(sweeps)

    def get_next(self) -> dict[str, Array] | None:
        """The next input of the graph, None at the end."""
        sweep = next(self._left, None)
        return None if sweep is None else {"sweep": sweep[None]}

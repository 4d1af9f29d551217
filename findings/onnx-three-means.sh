#!/bin/bash
# Library: onnxruntime 1.32.0.
# Behaviour: the mean over time of a long float32 recording depends on the operator and on the
#   order of axes, and each is wrong by another amount: sums are added up in float32.
# Seen: for 30 minutes at 750 Hz (1.35 million frames) of 50000 with noise of 1 (x86-64 with
#   AVX-512)
#     ReduceMean, time first: 49398.9; time last: 50071.0; GlobalAveragePool: 50123.5
# What most would expect: 50000.0 three times, or the same error three times.
# Where a user meets it: the rest level or a long average as a part of an exported network on a
#   skin of 16 bits: errors of 70 to 600 counts, where materials differ by 2. At 8,800 frames it is
#   up to 0.2 counts. Subtract a constant first, or average averages of short pieces.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    onnxruntime==1.32.0 onnx==1.23.2 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

FRAMES = 1_350_000


def mean(kind, x, axis=None):
    """The first channel's mean by an operator."""
    inputs = ["x"] if axis is None else ["x", "axes"]
    options = {} if axis is None else {"keepdims": 0}
    ends = [helper.make_tensor_value_info("x", TensorProto.FLOAT, x.shape)]
    out = [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)]
    constants = [] if axis is None else [numpy_helper.from_array(np.array([axis]), "axes")]
    node = helper.make_node(kind, inputs, ["y"], **options)
    graph = helper.make_graph([node], "g", ends, out, constants)
    opset = [helper.make_opsetid("", 20)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=10).SerializeToString()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return float(session.run(None, {"x": x})[0].ravel()[0])


first = (50000 + np.random.default_rng(0).normal(size=(1, FRAMES, 4))).astype(np.float32)
last = np.ascontiguousarray(first.transpose(0, 2, 1))
found = [mean("ReduceMean", first, 1), mean("ReduceMean", last, 2), mean("GlobalAveragePool", last)]
print("ReduceMean, time first: {:.1f}; time last: {:.1f}; GlobalAveragePool: {:.1f}".format(*found))
print(f"in float64: {first[0, :, 0].mean(dtype=np.float64):.4f}")
sys.exit(not (abs(found[0] - 50000) > 100 and max(found) - min(found) > 100))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

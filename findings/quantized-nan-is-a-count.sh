#!/bin/bash
# Library: onnxruntime 1.32.0 (the same in 1.31.1).
# Behaviour: QuantizeLinear makes the lowest count of NaN, the same as of minus infinity, and not
#   the zero point. The int8 network after it sees an ordinary sample of full negative load.
# Seen: for NaN, +inf, -inf, 0 with scale 0.1
#     int8 (zero point 0): -128 127 -128 0; uint8 (zero point 128): 0 255 0 128
# What most would expect: the zero point for NaN (saturate, then convert 0), or an error.
# Where a user meets it: a skin that sends float32 and NaN for a broken taxel, with model.onnx of
#   a bundle run by a program of one's own: a confident label instead of a refusal. Check isfinite
#   before the model.
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

x = np.array([np.nan, np.inf, -np.inf, 0], np.float32)
found = {}
for kind, number, zero in (("int8", TensorProto.INT8, 0), ("uint8", TensorProto.UINT8, 128)):
    node = helper.make_node("QuantizeLinear", ["x", "scale", "zero"], ["y"])
    values = {"scale": np.float32(0.1), "zero": np.dtype(kind).type(zero)}
    constants = [numpy_helper.from_array(np.asarray(value), name) for name, value in values.items()]
    given = helper.make_tensor_value_info("x", TensorProto.FLOAT, [4])
    out = helper.make_tensor_value_info("y", number, [4])
    graph = helper.make_graph([node], "g", [given], [out], constants)
    opset = [helper.make_opsetid("", 21)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=10).SerializeToString()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    found[kind] = session.run(None, {"x": x})[0].tolist()
    print(f"{kind} (zero point {zero}):", *found[kind])
sys.exit(found != {"int8": [-128, 127, -128, 0], "uint8": [0, 255, 0, 128]})
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

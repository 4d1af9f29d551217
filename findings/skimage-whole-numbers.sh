#!/bin/bash
# Library: scikit-image 0.26.0 with NumPy 2.3.5.
# Behaviour: resize() and gaussian() divide whole numbers by the largest value of their type,
#   whatever the values are. The same frame of counts comes back in four scales, by its type alone.
# Seen: for a 4 x 4 frame of 200, resized to 2 x 2
#     uint8: 0.784, uint16: 0.00305, int64: 2.17e-17, float64: 200.0
# Guess before it was run: 0.784 for uint8 is known from pictures; for int64, which a list, JSON
#   or a table gives, the counts themselves.
# Where a user meets it: frames of another grid brought to the shape of a bundle: read from .npy
#   as uint8 they are in 0..1, read from JSON as int64 they are all but 0, and a network trained on
#   one sees nothing in the other. preserve_range=True keeps counts.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    scikit-image==0.26.0 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
from skimage.transform import resize

shown = {
    kind: float(resize(np.full((4, 4), 200, kind), (2, 2))[0, 0])
    for kind in ("uint8", "uint16", "int64", "float64")
}
print(", ".join(f"{kind}: {value:.3g}" for kind, value in shown.items()))
expected = {"uint8": 200 / 255, "uint16": 200 / 65535, "int64": 200 / 2**63, "float64": 200}
sys.exit(not all(np.isclose(shown[kind], expected[kind], atol=0) for kind in shown))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

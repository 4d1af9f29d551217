#!/bin/bash
# Library: scipy.ndimage of SciPy 1.17.1.
# Behaviour: filters of whole numbers give the type of their input, and cut fractions off; they do
#   not round. Smoothing lowers the level by half a count, however small the filter. A filter whose
#   result leaves the type wraps.
# Seen: for uint8 counts that alternate between 100 and 101 (mean 100.5)
#     gaussian_filter1d: mean 100.0, as float: 100.5
#     laplace of a taxel of 12 among taxels of 10: 248
# Guess before it was run: float results as from scipy.signal, or rounded ones, so that the mean
#   stays.
# Where a user meets it: a smoothed rest level of uint8 counts, which is subtracted from
#   unsmoothed sweeps: half a count of load that is not there, on a skin whose soft materials differ
#   by one or two counts. Convert to float32 before filtering.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    scipy==1.17.1 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
from scipy import ndimage

counts = np.tile(np.array([100, 101], np.uint8), 300)
whole = ndimage.gaussian_filter1d(counts, 3)
real = ndimage.gaussian_filter1d(counts.astype(float), 3)
frame = np.full((3, 3), 10, np.uint8)
frame[1, 1] = 12
edge = int(ndimage.laplace(frame)[1, 1])
print(f"gaussian_filter1d: mean {whole[30:-30].mean():.1f}, as float: {real[30:-30].mean():.1f}")
print(f"laplace of a taxel of 12 among taxels of 10: {edge}")
means = whole[30:-30].mean(), real[30:-30].mean()
sys.exit(not (means[0] == 100 and abs(means[1] - 100.5) < 1e-6 and edge == 248))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

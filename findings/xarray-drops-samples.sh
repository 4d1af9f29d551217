#!/bin/bash
# Library: xarray 2026.9.0.
# Behaviour: arithmetic keeps only the labels that both arrays have, bit by bit. Two time axes
#   that were computed in two ways share most of their times, not all; the rest is dropped without a
#   word.
# Seen: 1500 samples at 750 Hz, times as k / 750 and as k * (1 / 750)
#     1158 samples in the difference
# What most would expect: 1500 samples, matched by place because the lengths are equal, or an
#   error.
# Where a user meets it: the difference of two fingertips, or of a sweep and its rest, whose times
#   come from two programs: a fifth of the frames is missing, at no regular places, and spectra of
#   the rest are wrong. xarray.set_options(arithmetic_join='exact') raises instead.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    xarray==2026.9.0 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
import xarray

k = np.arange(1500)
left = xarray.DataArray(np.ones(1500), coords={"t": k / 750}, dims="t")
right = xarray.DataArray(np.ones(1500), coords={"t": k * (1 / 750)}, dims="t")
apart = float(np.abs(left.t.values - right.t.values).max())
print(f"{(left - right).size} samples of 1500; times differ by up to {apart:.1g} s")
sys.exit(not (1000 < (left - right).size < 1500 and apart < 1e-15))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

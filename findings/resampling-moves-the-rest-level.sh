#!/bin/bash
# Library: scipy.signal of SciPy 1.17.1.
# Behaviour: both usual ways to a lower rate change a signal that does not change: decimate()'s
#   default filter has 0.1 dB of ripple and its order is even, so the level falls by 1.1 %;
#   resample_poly() takes everything outside of the signal as 0, so both ends dip by a sixth.
# Seen: for 200 all the time, from 750 Hz
#     decimate to 75 Hz: 197.7 throughout
#     resample_poly to 500 Hz: 166.7 at the first sample, 200.0 in the middle
# What most would expect: 200.0 throughout; a filter's gain at 0 Hz is 1.
# Where a user meets it: a skin of another rate brought to the rate of a bundle: two counts off
#   the level of soft materials with decimate(), and a false touch at the start of each sweep with
#   resample_poly(). ftype='fir', or padtype='line', keeps the level.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    scipy==1.17.1 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
from scipy import signal

rest = np.full(1500, 200.0)
fewer = signal.decimate(rest, 10)
other = signal.resample_poly(rest, 2, 3)
print(f"decimate: {fewer.min():.1f} to {fewer.max():.1f}")
print(f"resample_poly: {other[0]:.1f} at the first sample, {other[500]:.1f} in the middle")
kept = [signal.decimate(rest, 10, ftype="fir"), signal.resample_poly(rest, 2, 3, padtype="line")]
right = all(abs(one[len(one) // 2] - 200) < 0.1 for one in kept) and abs(kept[1][0] - 200) < 0.1
sys.exit(not (abs(fewer - 197.71).max() < 0.05 and abs(other[0] - 166.7) < 0.5 and right))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

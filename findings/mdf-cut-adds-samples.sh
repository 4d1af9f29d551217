#!/bin/bash
# Library: asammdf 8.8.28.
# Behaviour: MDF.cut(start, stop) adds a sample at each limit that falls between two samples:
#   whole numbers repeat the last value, floats are drawn on the straight line between neighbours.
#   The cut signal has samples that no sensor sent, at times that are off its rate.
# Seen: ten samples at 750 Hz, cut from 2.0 to 6.5 ms
#     3 recorded samples lie inside; cut gives 5, the first at 2.0 ms, the last at 6.5 ms
# Guess before it was run: the three samples inside, with their own times.
# Where a user meets it: sweeps cut out of a long MF4 recording of a test bench: each begins and
#   ends with an invented frame and has two steps of time that are no 1/750 s, so that a check of
#   the rate refuses it or a resampling shifts it. Select by timestamps instead.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    asammdf==8.8.28 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
from asammdf import MDF, Signal

times = np.arange(10) / 750
for kind in (np.uint8, np.float32):
    file = MDF()
    file.append([Signal(np.arange(10).astype(kind), times, name="taxel")])
    cut = file.cut(0.002, 0.0065).get("taxel")
    inside = int(((times >= 0.002) & (times <= 0.0065)).sum())
    print(np.dtype(kind), inside, "inside; cut:", len(cut.samples), "at", *cut.timestamps.round(5))
    if not (inside == 3 and len(cut.samples) == 5 and cut.timestamps[0] == 0.002):
        sys.exit("the behaviour has changed")
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

#!/bin/bash
# Library: polars 2.1.0, beside NumPy 2.3.5.
# Behaviour: quantile() takes the nearest row and does not interpolate, so that quantile(0.5) is
#   not median().
# Seen: for errors 0, 1, 2, 10
#     polars: quantile(0.5) 2.0, median 1.5, quantile(0.9) 10.0; NumPy: 1.5 and 7.6
# Guess before it was run: 1.5 and 7.6, linear as in NumPy, pandas, R and SQL's percentile_cont.
# Where a user meets it: a table of evaluation, median accuracy over four fingertips or latency at
#   90 %: with few groups the number differs from the one that pandas gives by a whole row. Say
#   interpolation='linear'.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    polars==2.1.0 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
import polars

errors = [0, 1, 2, 10]
column = polars.Series(errors)
found = [column.quantile(0.5), column.median(), column.quantile(0.9)]
other = np.quantile(errors, [0.5, 0.9]).round(6).tolist()
print("polars: quantile(0.5) {}, median {}, quantile(0.9) {};".format(*found), "NumPy:", *other)
sys.exit(found != [2.0, 1.5, 10.0] or other != [1.5, 7.6])
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

#!/bin/bash
# Library: pandas 3.1.1 with NumPy 2.3.5.
# Behaviour: the first difference of a Series is NaN, so the result is float; yet for unsigned
#   counts the subtraction is done before in the unsigned type, and wraps. Signed counts are
#   widened. A group's difference of the same column is right.
# Seen: for counts 5, 3
#     uint8: diff 254.0, diff of a group -2.0
#     uint16: diff 65534.0, diff of a group -2.0
#     int8 of -100, 100: diff 200.0
# Guess before it was run: -2.0 everywhere, because the result is float and has room for the sign.
# Where a user meets it: steps of a taxel's counts, or lost frames from a counter, in a table that
#   pandas read from a recording of uint8 or uint16: every fall becomes a large rise. Convert to
#   int64 before diff().
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    pandas==3.1.1 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
import pandas

found = []
for kind in ("uint8", "uint16"):
    counts = pandas.DataFrame({"sweep": [1, 1], "count": np.array([5, 3], kind)})
    plain, group = counts["count"].diff().iloc[1], counts.groupby("sweep")["count"].diff().iloc[1]
    print(f"{kind}: diff {plain}, diff of a group {group}")
    found += [plain, group]
signed = pandas.Series(np.array([-100, 100], np.int8)).diff().iloc[1]
print(f"int8 of -100, 100: diff {signed}")
sys.exit([*found, signed] != [254, -2, 65534, -2, 200])
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

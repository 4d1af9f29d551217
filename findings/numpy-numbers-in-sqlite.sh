#!/bin/bash
# Library: Python's sqlite3 with NumPy 2.3.5 (Python 3.11, SQLite 3.40.1, and later ones).
# Behaviour: np.float32, np.int64 and np.bool_ have a buffer, so sqlite3 stores their raw bytes as
#   a BLOB, also in a REAL column; np.float64 is a Python float and is stored as a number. SQL takes
#   a BLOB as larger than every number in comparisons, and as 0 in averages.
# Seen: for np.float32(0.2), np.float32(0.4) in a REAL column
#     type blob; rows with p > 0.5: 2 of 2; avg(p): 0.0
# What most would expect: numbers, or an InterfaceError about an unknown type.
# Where a user meets it: probabilities of a network are float32: a log of verdicts written
#   straight from NumPy has certain verdicts only, and their mean is 0. float(p) before storing;
#   STRICT tables refuse the rest.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sqlite3
import sys

import numpy as np

db = sqlite3.connect(":memory:")
db.execute("create table verdicts (p real)")
db.executemany("insert into verdicts values (?)", [(np.float32(0.2),), (np.float32(0.4),)])
(kind,) = db.execute("select distinct typeof(p) from verdicts").fetchone()
(passed,) = db.execute("select count(*) from verdicts where p > 0.5").fetchone()
(mean,) = db.execute("select avg(p) from verdicts").fetchone()
print(f"SQLite {sqlite3.sqlite_version}: type {kind}; p > 0.5: {passed} of 2; avg(p): {mean}")
sys.exit((kind, passed, mean) != ("blob", 2, 0.0))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

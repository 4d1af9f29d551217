#!/bin/bash
# Library: polars 2.1.0 and DuckDB 2.0.1, beside pandas 3.1.1.
# Behaviour: polars and DuckDB count NaN as larger than every number and equal to itself, so a row
#   without a valid probability passes `p > 0.5`. Yet polars' max() leaves NaN out. pandas compares
#   as IEEE 754 does.
# Seen: for p = 0.2, NaN, 0.9, rows with p > 0.5
#     pandas 1, polars 2, duckdb 2; polars' max: 0.9
# Guess before it was run: one row everywhere: a comparison with NaN is false.
# Where a user meets it: verdicts or a benchmark in Parquet or CSV, filtered by certainty: failed
#   sweeps are counted as certain ones, and two colleagues get two numbers from one file. Ask for
#   is_finite (polars) or isfinite (DuckDB) as well.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    pandas==3.1.1 polars==2.1.0 duckdb==2.0.1 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import duckdb
import pandas
import polars

VALUES = "select p from (values (0.2), ('nan'::double), (0.9)) t(p) where p > 0.5"
p = [0.2, float("nan"), 0.9]
frame = polars.DataFrame({"p": p})
passed = {
    "pandas": int((pandas.Series(p) > 0.5).sum()),
    "polars": frame.filter(polars.col("p") > 0.5).height,
    "duckdb": len(duckdb.sql(VALUES).fetchall()),
}
print(", ".join(f"{name} {n}" for name, n in passed.items()) + f"; polars' max: {frame['p'].max()}")
sys.exit(passed != {"pandas": 1, "polars": 2, "duckdb": 2} or frame["p"].max() != 0.9)
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

#!/bin/bash
# Library: h5py 3.16.0 and zarr 3.1.6 with NumPy 2.3.5.
# Behaviour: numbers outside of the type of a data set are written without an error by both, as
#   other numbers: HDF5 takes the nearest end of the range, zarr the lowest bits. NumPy's own
#   assignment of a list raises.
# Seen: for 300, -1, 70000 written into a uint8 set
#     h5py: 255 0 255; zarr: 44 255 112; NumPy from a list: OverflowError
# Guess before it was run: 44 255 112 in both, or an error in both.
# Where a user meets it: a recorder that stores 10- or 12-bit counts in a set that was made for 8
#   bits: in HDF5 a pressed taxel looks saturated and may be noticed, in zarr a firm touch looks
#   like a light one. Compare the range of the counts with the set's type before writing.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    h5py==3.16.0 zarr==3.1.6 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import h5py
import numpy as np
import zarr

counts = np.array([300, -1, 70000])
with h5py.File(f"{sys.argv[1]}/skin.h5", "w") as file:
    taxels = file.create_dataset("skin", (3,), "u1")
    taxels[:] = counts
    first = taxels[:].tolist()
taxels = zarr.create_array(f"{sys.argv[1]}/skin.zarr", shape=(3,), dtype="u1")
taxels[:] = counts
second = taxels[:].tolist()
try:
    np.zeros(3, np.uint8)[:] = counts.tolist()
    third = "written"
except OverflowError as e:
    third = type(e).__name__
print("h5py:", *first, "zarr:", *second, "NumPy from a list:", third)
sys.exit((first, second, third) != ([255, 0, 255], [44, 255, 112], "OverflowError"))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

#!/bin/bash
# Library: pyEDFlib 0.1.42.
# Behaviour: EDF has whole records, here of a second. The writer fills the last record with the
#   lowest digital value, and neither the file nor the reader tells filled samples from recorded
#   ones.
# Seen: 2.5 s of a constant 127 at 750 Hz, physical range 0 to 255
#     2250 samples, 3.0 s, the last 375 are 0.0
# What most would expect: 1875 samples back, or the last value held.
# Where a user meets it: sweeps exported to EDF by a laboratory's software: each ends with a
#   sudden release of all taxels, half a second long, which looks like the end of contact. Keep the
#   number of samples beside the file.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    pyedflib==0.1.42 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
import pyedflib

path = f"{sys.argv[1]}/skin.edf"
writer = pyedflib.EdfWriter(path, 1)
ranges = {"physical_min": 0, "physical_max": 255, "digital_min": -32768, "digital_max": 32767}
texts = {"label": "taxel", "dimension": "", "transducer": "", "prefilter": ""}
writer.setSignalHeader(0, {**texts, **ranges, "sample_frequency": 750})
writer.writeSamples([np.full(1875, 127.0)])
writer.close()
with pyedflib.EdfReader(path) as reader:
    taxel, seconds = reader.readSignal(0), reader.file_duration
print(f"{len(taxel)} samples, {seconds} s, the last 375 are {np.unique(taxel[1875:])}")
sys.exit(not (len(taxel) == 2250 and seconds == 3 and not taxel[1875:].any()))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

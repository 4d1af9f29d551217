#!/bin/bash
# Library: soundfile 0.14.0 (libsndfile).
# Behaviour: int32 counts written to WAV become PCM_16 by default, of which libsndfile keeps the
#   upper half: counts below 65536 are zeros. The other way, a WAV of floats read as int16 is cut to
#   whole numbers and not scaled.
# Seen: counts 300, -5, 32767 written as int32 and read as int16: 0 -1 0 (as int16: 300 -5 32767)
#     0.5, -0.25, 1.0 in a FLOAT file, read as int16: 0 0 1
# Guess before it was run: a 32-bit file for 32-bit counts, or an error; 16384 -8192 32767 for the
#   floats.
# Where a user meets it: the waveform of a microphone or vibration sensor in the fingertip, saved
#   as WAV from an array of int32: a file of near silence. Say subtype='PCM_32', or write int16.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    soundfile==0.14.0 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
import soundfile

path = f"{sys.argv[1]}/skin.wav"
counts = [300, -5, 32767]
soundfile.write(path, np.array(counts, np.int32), 750)
wide = soundfile.read(path, dtype="int16")[0].tolist()
soundfile.write(path, np.array(counts, np.int16), 750)
narrow = soundfile.read(path, dtype="int16")[0].tolist()
soundfile.write(path, np.array([0.5, -0.25, 1.0]), 750, subtype="FLOAT")
floats = soundfile.read(path, dtype="int16")[0].tolist()
print("int32 counts:", *wide, "int16 counts:", *narrow, "floats:", *floats)
sys.exit((wide, narrow, floats) != ([0, -1, 0], counts, [0, 0, 1]))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

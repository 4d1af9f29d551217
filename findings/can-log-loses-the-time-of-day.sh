#!/bin/bash
# Library: python-can 4.6.1.
# Behaviour: the reader of Vector's ASC logs gives times since the first frame, though the file
#   holds the date and the reader of every other format gives seconds since 1970. Times in ASC, LOG
#   and TRC have microseconds, in BLF more.
# Seen: three frames, the first at 1764302040.1234567, 1/750 s apart, written by Logger, read by
#   LogReader
#     asc: 0.0 0.001333 0.002667; blf: 1764302040.1234567 and so on
# Guess before it was run: times of day in each: one interface writes and reads all formats.
# Where a user meets it: a skin or gripper on CAN, recorded beside the robot's own log: after
#   conversion to ASC the sweeps cannot be placed in time, and frames of two files seem to begin
#   together. ASCReader(file, relative_timestamp=False) gives the time of day.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    python-can==4.6.1
cat >"$folder/try.py" <<'PY'
import sys

import can

BEGIN = 1764302040.1234567
found = {}
for kind in ("asc", "blf", "csv", "log"):
    path = f"{sys.argv[1]}/skin.{kind}"
    with can.Logger(path) as log:
        for k in range(3):
            log(can.Message(arbitration_id=0x100, data=[k], timestamp=BEGIN + k / 750))
    found[kind] = [frame.timestamp for frame in can.LogReader(path)]
    print(f"{kind}:", *found[kind])
relative = found.pop("asc")
near = all(abs(times[0] - BEGIN) < 1e-5 for times in found.values())
sys.exit(not (relative[0] == 0 and abs(relative[2] - 2 / 750) < 1e-5 and near))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

#!/bin/bash
# Library: rosbags 0.11.9.
# Behaviour: an array of a message is written as its bytes lie in memory, though the message is
#   declared little-endian. A big-endian array, as many recorders and network formats give it, is
#   read back as other numbers.
# Seen: Float32MultiArray of 1.0, 2.0 as '>f4'
#     read back: 4.6e-41 8.97e-44
# What most would expect: 1.0 2.0: NumPy hides byte order from everyone who only computes.
# Where a user meets it: recordings converted to ROS 2 bags: comparison before writing is right,
#   each number after reading is wrong and near 0, like an unloaded skin.
#   array.astype(array.dtype.newbyteorder('=')) first.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    rosbags==0.11.9 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import numpy as np
from rosbags.typesys import Stores, get_typestore

types = get_typestore(Stores.ROS2_HUMBLE)
layout = types.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
kind = "std_msgs/msg/Float32MultiArray"
read = {}
for order in "<>":
    message = types.types[kind](layout=layout, data=np.array([1, 2], f"{order}f4"))
    read[order] = types.deserialize_cdr(types.serialize_cdr(message, kind), kind).data.tolist()
    print(f"written as {order}f4:", *read[order])
sys.exit(not (read["<"] == [1, 2] and 0 < max(read[">"]) < 1e-40))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

#!/bin/bash
# Library: OpenCV 5.0.0.93 for Python with NumPy 2.3.5.
# Behaviour: an array of four numbers beside a picture is not broadcast along rows or columns. It
#   is a colour: its first number is the value for the picture's one channel, the others are
#   dropped. The same happens with three numbers; five and more raise an error.
# Seen: for a 4 x 4 frame of 50 and a rest level of 10, 20, 30, 40 for its columns
#     cv2.subtract: each row is 40 40 40 40; NumPy: 40 30 20 10
# Guess before it was run: broadcasting as in NumPy, or an error about sizes.
# Where a user meets it: a skin of 4 x 4 taxels, whose rest level per column or row is taken off
#   with OpenCV before the sweep is stored: three quarters of the columns keep another offset, and
#   nothing says so. Use NumPy's minus, or a rest level of the frame's full shape.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    opencv-python-headless==5.0.0.93 numpy==2.3.5
cat >"$folder/try.py" <<'PY'
import sys

import cv2
import numpy as np

frame = np.full((4, 4), 50, np.float32)
rest = np.array([10, 20, 30, 40], np.float32)
left, right = cv2.subtract(frame, rest), frame - rest
print("cv2.subtract:", *left[0], "NumPy:", *right[0])
sys.exit(not ((left == 40).all() and right[0].tolist() == [40, 30, 20, 10]))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

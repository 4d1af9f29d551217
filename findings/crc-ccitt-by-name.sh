#!/bin/bash
# Library: anycrc 2.1.0, fastcrc 0.5.0, Python's binascii.
# Behaviour: 'CRC16-CCITT' means three different checksums. They differ in start value and in the
#   order of bits, and none of the packages says so when it is asked by name.
# Seen: of the text 123456789
#     anycrc CRC16-CCITT: 0x2189; binascii.crc_hqx(data, 0): 0x31c3
#     fastcrc ibm_3740, often called CCITT-FALSE: 0x29b1
# What most would expect: 0x29b1 for the first, which most data sheets mean, or an exception for
#   an ambiguous name.
# Where a user meets it: a maker's data sheet says 'CRC-16 CCITT' and `skin new` asks for the
#   checksum: each frame is refused, or an own sender is tested against an own receiver that share
#   the mistake. Compare the checksum of 123456789, never the name.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    anycrc==2.1.0 fastcrc==0.5.0
cat >"$folder/try.py" <<'PY'
import binascii
import sys

import anycrc
import fastcrc

DATA = b"123456789"
found = {
    "anycrc CRC16-CCITT": anycrc.Model("CRC16-CCITT").calc(DATA),
    "binascii.crc_hqx": binascii.crc_hqx(DATA, 0),
    "fastcrc ibm_3740": fastcrc.crc16.ibm_3740(DATA),
}
print(", ".join(f"{name}: {value:#06x}" for name, value in found.items()))
sys.exit(list(found.values()) != [0x2189, 0x31C3, 0x29B1])
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

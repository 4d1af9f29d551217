#!/bin/bash
# Library: apsw 3.46.1.0, which brings SQLite 3.46.1, Debian 13's; Debian 12's 3.40.1 does the
#   same. SQLite 3.54.1 writes all digits.
# Behaviour: a REAL keeps all its bits in the table, but SQLite writes 15 digits of it wherever it
#   makes text: json_object(), CAST AS TEXT, ||, group_concat(). Seconds since 1970 with
#   microseconds have 16.
# Seen: for 1764302040.1234567
#     column: 1764302040.1234567; json_object: 1764302040.12346
#     three times 1/750000 s apart: 1 time as text
# Guess before it was run: the shortest text that reads back as the same number, as from Python,
#   JavaScript and PostgreSQL.
# Where a user meets it: verdicts or frames kept in SQLite and handed on as JSON: times are
#   rounded to 10 microseconds, frames of fast skins fall together, and a join on the time finds
#   nothing. Store microseconds as INTEGER.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    apsw==3.46.1.0
cat >"$folder/try.py" <<'PY'
import json
import sys

import apsw

times = [1764302040.1234567, 1764302040.1234567 + 1 / 750000, 1764302040.1234567 + 2 / 750000]
db = apsw.Connection(":memory:")
db.execute("create table frames (t real)")
db.executemany("insert into frames values (?)", [(t,) for t in times])
rows = db.execute("select t, json_object('t', t), cast(t as text) from frames").fetchall()
read = [json.loads(text)["t"] for _, text, _ in rows]
print(f"column: {rows[0][0]!r}; json_object: {read[0]!r}; as text: {rows[0][2]}")
print(f"{len(set(read))} different times of {len({t for t, *_ in rows})}")
sys.exit(not (rows[0][0] == times[0] and read[0] == 1764302040.12346 and len(set(read)) < 3))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

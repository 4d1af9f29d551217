#!/bin/bash
# Library: apsw 3.46.1.0, which brings SQLite 3.46.1 (the same with apsw 3.40.0.0, SQLite 3.40.0).
# Behaviour: a database that lost less than its last page is opened and read without an error. All rows
#   come; what the lost bytes held reads as zeros. Only `PRAGMA integrity_check` notices it.
# Seen: 400 bytes cut off a file of 40 messages of 200 bytes:
#     40 of 40 rows, 2 with other content, integrity_check: not ok
# Guess before it was run: "database disk image is malformed", as for a file that lost a whole page.
# Where a user meets it: a ROS 2 bag (.db3) that was copied from a robot whose card was full, or while it
#   was recorded: the last messages are partly zeros, and nothing says so. The header tells the right
#   length (page size at byte 16 times number of pages at byte 28), which a reader has to compare.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check apsw==3.46.1.0
cat >"$folder/try.py" <<'PY'
import os
import sys

import apsw

path = os.path.join(sys.argv[1], "recording.db3")
messages = [bytes([i]) * 200 for i in range(1, 41)]
with apsw.Connection(path) as db:
    db.execute("create table messages (id integer primary key, data blob)")
    db.executemany("insert into messages (data) values (?)", [(one,) for one in messages])
db.close()
os.truncate(path, os.path.getsize(path) - 400)
db = apsw.Connection(path, flags=apsw.SQLITE_OPEN_READONLY)
rows = [data for (data,) in db.execute("select data from messages order by id")]
other = sum(row != message for row, message in zip(rows, messages))
(found,) = db.execute("pragma integrity_check").fetchone()
told = "ok" if found == "ok" else "not ok"
print(f"{len(rows)} of 40 rows, {other} with other content, integrity_check: {told}")
sys.exit(not (len(rows) == 40 and other > 0 and told == "not ok"))
PY
"$folder/venv/bin/python" "$folder/try.py" "$folder"

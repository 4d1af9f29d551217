#!/bin/bash
# Library: mypy 2.4.1.
# Behaviour: with --strict, a list that holds a lambda beside a typed function cannot be called in
#   typed code: "untyped function (unknown)". The revealed type of the list is right, and in a
#   tuple the same two can be called.
# Seen: [first, second]           0 errors   list[def () -> str]
#     [first, lambda: "b"]        1 error    list[def () -> str]
#     (first, lambda: "b")        0 errors
#     declared list[Callable[[], str]]  0 errors
# Guess before the run: 0 errors each, as the revealed type says.
# Where a user meets it: a table of steps or handlers, one of them too short for a name of its own,
#   passes until somebody makes a list of it. Give it a name, or declare the list.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mypy==2.4.1
cd "$folder"
functions='from collections.abc import Callable
def first() -> str:
    return "a"
def second() -> str:
    return "b"
'
errors() { # CODE: the number of errors that mypy finds in it
  printf '%s%s\nreveal_type(names)\nfor name in names: print(name())\n' "$functions" "$1" >try.py
  "$folder/venv/bin/mypy" --no-incremental --strict try.py >said || true
  grep -c ': error:' said || true
}
named=$(errors 'names = [first, second]')
list=$(errors 'names = [first, lambda: "b"]')
type=$(grep -c 'type is "list\[def () -> str\]"' said || true)
tuple=$(errors 'names = (first, lambda: "b")')
told=$(errors 'names: list[Callable[[], str]] = [first, lambda: "b"]')
echo "errors: two functions $named, list with a lambda $list, tuple $tuple, declared list $told"
[ "$named $list $type $tuple $told" = "0 1 1 0 0" ]

"""`palpate-backup`: saves a box, and restores it on this box or another."""

from __future__ import annotations

import argparse
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from palpate.core import storage
from palpate.core.errors import ApplianceError
from palpate.core.text import printable
from palpate.deployment import backup

SERVICES = ("palpate", "palpate-teach")


def main(argv: list[str] | None = None, root: Path = Path("/")) -> int:
    """Save or restore; the exit code. root: the folder that holds the box's file system."""
    parser = argparse.ArgumentParser("palpate-backup", description=backup.__doc__)
    parser.add_argument("action", choices=("save", "restore"))
    parser.add_argument("file", metavar="FILE", help="the backup; - is standard output or input")
    args = parser.parse_args(argv)
    try:
        print((_save if args.action == "save" else _restore)(args.file, root), file=sys.stderr)
    except ApplianceError as e:
        print(printable(f"palpate-backup: {e}"), file=sys.stderr)
        return e.exit_code
    except OSError as e:
        why = f"{e.filename or args.file}: {e.strerror or e}; use sudo, and check the room (df -h)"
        print(printable(f"palpate-backup: {why}"), file=sys.stderr)
        return 1
    return 0


def _save(name: str, root: Path) -> str:
    with ExitStack() as stack:
        out: IO[bytes] = sys.stdout.buffer
        if name != "-":
            out = stack.enter_context(storage.file(Path(name)))
            Path(f"{name}{storage.PART}").chmod(0o600)  # it holds the keys of this box
        elif out.isatty():
            raise ApplianceError("a backup does not go to a terminal; name a file")
        count = backup.save(out, root)
        out.flush()
    return f"saved {count} files; the backup holds the keys of this box: keep it to yourself"


def _restore(name: str, root: Path) -> str:
    with ExitStack() as stack:
        source: IO[bytes] = sys.stdin.buffer
        if name != "-":
            source = stack.enter_context(Path(name).open("rb"))
        new = backup.unpack(source, root)
    _systemctl("stop", *SERVICES)
    try:
        backup.swap(new, root)
    finally:
        _systemctl("--no-block", "start", SERVICES[0])
    kept = " and ".join(f"{place}{backup.BEFORE}" for place in backup.PARTS.values())
    return f"restored; what was here before is in {kept}. The service starts: palpate status"


def _systemctl(*words: str) -> None:
    try:
        done = subprocess.run(["systemctl", *words], capture_output=True, text=True, check=False)
    except FileNotFoundError as e:
        raise ApplianceError("there is no systemctl here; restore on a box") from e
    if done.returncode:
        raise ApplianceError(f"systemctl {' '.join(words)}: {done.stderr.strip()}; run it again")


if __name__ == "__main__":
    sys.exit(main())

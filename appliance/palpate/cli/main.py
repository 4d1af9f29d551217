"""The command `palpate`: help, or one command with its exit code."""

from __future__ import annotations

import os
import sys

from palpate.core.errors import INTERRUPTED, ApplianceError
from palpate.core.text import printable, replace_unprintable

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; its exit code."""
    _fill_streams()
    replace_unprintable()
    # One loop, one thread. Otherwise OpenBLAS starts a thread for each core when numpy is imported,
    # and a product in the loop waits for a thread that a busy processor does not run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        code = _run(sys.argv[1:] if argv is None else list(argv))
        _flush()
        return code
    except ApplianceError as e:
        print(printable(f"palpate: {e}"), file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        print("palpate: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        print("palpate: the reader of standard output has closed it", file=sys.stderr)
        _give_up_output()
        return 1
    except OSError as e:
        print(
            f"palpate: {e.filename or 'a file'}: {e.strerror}; check its path and who may use it",
            file=sys.stderr,
        )
        return 1


def _run(words: list[str]) -> int:
    """The command in these words. `status` does without the parser and all that others need."""
    if words[:1] == ["status"]:
        from palpate.cli import status_command
        from palpate.core import runtime_folder

        if words[1:] in status_command.PLAIN and runtime_folder.is_default():
            return status_command.show(as_json=len(words) > 1)
    from importlib import import_module

    from palpate.cli import parser
    from palpate.core.interrupts import during_imports

    if not words or words == ["help"]:
        words = ["--help"]
    with during_imports("palpate"):
        args = parser.arguments(words[0], words[1:])
        module, _, function = args.run.rpartition(".")
        run = getattr(import_module(f"palpate.{module}"), function)
        if "palpate.core.log" in sys.modules:  # a command without a log starts sooner
            from palpate.core.log import to_stderr

            to_stderr()
    return int(run(args))


def _fill_streams() -> None:
    """Open /dev/null for each standard stream that is closed. Otherwise the next file that is
    opened, a device for example, would take its number, and Python would have no stream."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def _flush() -> None:
    """Write the rest of standard output; on a full disk it is lost."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError) as e:
        print(f"palpate: standard output: {e}; the rest of it is lost", file=sys.stderr)
        _give_up_output()


def _give_up_output() -> None:
    """Write nothing more to standard output, not even at the end of the interpreter."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

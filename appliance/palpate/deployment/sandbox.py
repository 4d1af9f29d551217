"""Runs work that may crash, hang or take all memory in a limited child process.

The child is a fork, so it works on exactly the bytes that were read and checked here, and cannot
damage this process. The kernel limits its address space and its processor time; the parent ends it
after a time by the clock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from palpate.core.errors import ApplianceError, BundleError

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

DEADLINE_S, PROCESSOR_S = 30.0, 15
"""Limits of time by the clock and of processor time. The golden sweeps of our largest network take
0.1 s on a desktop."""
MOST_BYTES = 192 << 20
"""Address space that the child may use in addition to the parent's memory. The service needs 60 MB
without a model and may have 256 (systemd/palpate.service)."""
MOST_MESSAGE = 2000
"""Bytes of the child's message that are read."""


def run_limited(work: Callable[[], object]) -> None:
    """Do `work` in a child process. Raises BundleError if it raises, dies, or takes longer than
    DEADLINE_S."""
    import multiprocessing  # imported here since only commands need it, not the service
    import signal

    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_work, args=(work, sender), daemon=True)
    child.start()
    sender.close()
    child.join(DEADLINE_S)
    if child.is_alive():
        child.kill()
        child.join()
        raise BundleError(f"model was not run within {DEADLINE_S:g} s; export the bundle again")
    if receiver.poll():
        try:
            raise BundleError(receiver.recv_bytes(MOST_MESSAGE).decode(errors="replace"))
        except EOFError:
            pass
    if child.exitcode:
        name = (
            signal.Signals(-child.exitcode).name
            if child.exitcode < 0
            else f"exit code {child.exitcode}"
        )
        raise BundleError(
            f"model killed the process that tried it ({name}); export the bundle again"
        )


def _work(work: Callable[[], object], sender: Connection) -> None:
    """Run in the child: set the limits, do the work, send the error if there is one."""
    import resource

    with open("/proc/self/statm", "rb") as f:
        used = int(f.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_S, PROCESSOR_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        work()
    except ApplianceError as e:
        sender.send_bytes(str(e).encode()[:MOST_MESSAGE])
    except MemoryError:
        sender.send_bytes(
            f"model asks for more than {MOST_BYTES >> 20} MB; export a smaller one".encode()
        )
    except Exception as e:  # the classes of onnxruntime have no other base in common
        sender.send_bytes(f"model cannot be run: {type(e).__name__}: {e}".encode()[:MOST_MESSAGE])

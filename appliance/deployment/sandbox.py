"""Work that may die, hang or ask for all memory, done apart. In: something to call. Out: nothing, or why it failed.

The child is a fork: it has what was read and checked here, byte for byte, and what it does to itself stays with it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from appliance.core.errors import ApplianceError, BundleError

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

DEADLINE_S = 30.0
"""The golden sweeps of our largest network take .1 s on a desktop."""
MOST_BYTES = 256 << 20
"""Of address space beyond what the process has already."""
MOST_TOLD = 2000


def apart(work: Callable[[], object]) -> None:
    """Do `work` in a child process of its own. Raises BundleError where it raises, dies, or takes too long."""
    import multiprocessing  # these two here: only commands need them, not the service
    import signal

    context = multiprocessing.get_context("fork")
    heard, told = context.Pipe(duplex=False)
    child = context.Process(target=_work, args=(work, told), daemon=True)
    child.start()
    told.close()
    child.join(DEADLINE_S)
    if child.is_alive():
        child.kill()
        child.join()
        raise BundleError(f"model was not run within {DEADLINE_S:g} s; export the bundle again")
    if heard.poll():
        try:
            raise BundleError(heard.recv_bytes(MOST_TOLD).decode(errors="replace"))
        except EOFError:
            pass
    if child.exitcode:
        name = signal.Signals(-child.exitcode).name if child.exitcode < 0 else f"exit code {child.exitcode}"
        raise BundleError(f"model killed the process that tried it ({name}); export the bundle again")


def _work(work: Callable[[], object], told: Connection) -> None:
    """The child's part."""
    import resource

    with open("/proc/self/statm", "rb") as f:
        has = int(f.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (has + MOST_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        work()
    except ApplianceError as e:
        told.send_bytes(str(e).encode()[:MOST_TOLD])
    except MemoryError:
        told.send_bytes(f"model asks for more than {MOST_BYTES >> 20} MB; export a smaller one".encode())
    except Exception as e:  # of onnxruntime's classes, which share no base but this
        told.send_bytes(f"model cannot be run: {type(e).__name__}: {e}".encode()[:MOST_TOLD])

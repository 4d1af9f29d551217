"""`python -m tests.cuts.counted THREAD NAME COUNT MODULE ...` runs a module. One of its threads
begins with COUNT system calls NAME. All of them fail and change nothing.

strace kills at a number of a call, and counts the calls of each thread separately. With these calls
the thread is the first to reach a number. THREAD 0 is the main thread; any other is the thread that
writes to the disk.
"""

import ctypes
import runpy
import sys

from palpate.core.disk_thread import DiskThread


def main() -> None:
    """Run the module."""
    thread, name, count, module = sys.argv[1:5]
    call = getattr(ctypes.CDLL(None), name)

    def begin() -> None:
        for _ in range(int(count)):
            call(-1, None, None)

    def run(disk: DiskThread, run_disk: object = DiskThread._run) -> None:
        begin()
        run_disk(disk)  # type: ignore[operator]

    if int(thread):
        DiskThread._run = run  # type: ignore[method-assign]
    else:
        begin()
    sys.argv[:5] = [module]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()

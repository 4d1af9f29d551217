"""Releases memory with library code that only the start of the program needed.

Opening a model runs through most of onnxruntime's code once, to register its operators. These
15 MiB stay resident while memory is not short, and 3 MiB of Python and numpy after the imports. A
released page is read from the file again when the processor next needs it.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

MADV_DONTNEED = 4
"""From <sys/mman.h>; the same on all architectures."""
MAPS = Path("/proc/self/maps")


def give_back(library: str = "", maps: Path = MAPS) -> int:
    """Release the code pages of the file `library`, or of all files, until they run again; returns
    the bytes, 0 if there are none or Linux refuses.

    Only executable pages that are not writable are released: they equal the file, so nothing can be
    lost.
    """
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    total, wanted = 0, os.path.realpath(library) if library else ""
    for line in maps.read_text().splitlines() if maps.is_file() else []:
        where, access, *_, name = line.split(maxsplit=5)
        if access == "r-xp" and name.startswith("/") and wanted in ("", name):
            start, end = (int(number, 16) for number in where.split("-"))
            if madvise(start, end - start, MADV_DONTNEED) == 0:
                total += end - start
    return total

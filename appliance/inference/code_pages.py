"""Gives back the memory of a library's code that only starting needed. In: the library's file. Out:
how many bytes.

Opening a model runs through most of onnxruntime's code once, to register its operators: 15 MiB that
stay resident as long as memory is not short. The processor's next access to a page that is given
back reads it again from the file.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

MADV_DONTNEED = 4
"""Of <sys/mman.h>: on all architectures the same."""
MAPS = Path("/proc/self/maps")


def give_back(library: str, maps: Path = MAPS) -> int:
    """Unmap the pages of code of the file `library` until they are run again; 0 where it has none,
    or Linux refuses.

    Only what is executable and not writable: it is as it stands in the file, so nothing can be
    lost.
    """
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    total, library = 0, os.path.realpath(library)
    for line in maps.read_text().splitlines() if maps.is_file() else []:
        where, access, *_, name = line.split(maxsplit=5)
        if name == library and access == "r-xp":
            start, end = (int(number, 16) for number in where.split("-"))
            if madvise(start, end - start, MADV_DONTNEED) == 0:
                total += end - start
    return total

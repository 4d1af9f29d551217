"""Runs a command in a namespace where arm64 programs run, too. In: a command. Out: its exit code;
nothing else changes.

The kernel hands foreign programs to an emulator that is registered in a binfmt_misc of its own: one
that lives in a private user and mount namespace, in which all ids are mapped. Needs root, Linux 6.7
and qemu-aarch64-static.
"""

import ctypes
import os
import shutil
import sys

NEW_NAMESPACES = 0x20000 | 0x10000000  # CLONE_NEWNS, CLONE_NEWUSER
FOLDER = b"/proc/sys/fs/binfmt_misc"
# ELF, 64 bits, little-endian, a program or a library, for machine 183; a mask of the bits that may
# differ
MAGIC = rb"\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00"
MASK = rb"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff"


def main(command: list[str]) -> int:
    """Run `command`; its exit code."""
    emulator = shutil.which("qemu-aarch64-static")
    if not emulator:
        sys.exit("no qemu-aarch64-static here; apt-get install qemu-user-static")
    ready_read, ready_write = os.pipe()
    mapped_read, mapped_write = os.pipe()
    child = os.fork()
    if child == 0:
        _inside(command, emulator.encode(), ready_write, mapped_read)
    os.read(ready_read, 1)
    for ids in ("uid_map", "gid_map"):
        with open(f"/proc/{child}/{ids}", "w") as f:
            f.write("0 0 65536")
    os.write(mapped_write, b".")
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _inside(command: list[str], emulator: bytes, ready: int, mapped: int) -> None:
    """The child: into its namespaces, register the emulator, become the command."""
    libc = ctypes.CDLL(None, use_errno=True)
    _check(libc.unshare(NEW_NAMESPACES), "make namespaces")
    os.write(ready, b".")
    os.read(mapped, 1)
    os.setresgid(0, 0, 0)
    os.setresuid(0, 0, 0)
    _check(
        libc.mount(b"binfmt_misc", FOLDER, b"binfmt_misc", 0, None),
        "mount binfmt_misc (Linux 6.7 can)",
    )
    with open(FOLDER + b"/register", "wb") as f:
        f.write(b":arm64:M::" + MAGIC + b":" + MASK + b":" + emulator + b":F")
    os.execvp(command[0], command)


def _check(failed: int, doing: str) -> None:
    if failed:
        sys.exit(f"cannot {doing}: {os.strerror(ctypes.get_errno())}; this needs root")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

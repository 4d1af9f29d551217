"""The fast tests in a Debian 13 with its Python 3.13, as on a Raspberry Pi of today.

`python -m tests.campaigns debian13 [OPTION ...]` runs them as root on a clone of the last commit;
options go to pytest. The Debian with its virtual environment is kept in ~/.cache/palpate: at first
it takes some minutes and 6 GB. `build` brings it up to date and runs nothing.
"""

import hashlib
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.rig.emulated_machines import HOME, ROOT, Missing, run, whole

SUITE = "trixie"
PACKAGES = ("ca-certificates", "git", "libusb-1.0-0", "make", "openssh-client", "python3-venv")
SHARED = ("/etc/resolv.conf", "/etc/ssl/certs", "/dev", "/sys")
"""Of this machine, for its network and its devices."""
SOURCE, VENV = "/palpate/source", "/palpate/venv"
ENTER = """
mount --make-rprivate /
for path in {shared}; do mount --rbind "$path" "$0$path"; done
mount -t proc proc "$0/proc"
exec chroot "$0" env -i {env} sh -euc "$1"
"""


def inside(root: Path, command: str) -> int:
    """Run a shell command in the Debian, with the network of this machine; its exit code."""
    kept = {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
    kept.pop("PIP_FIND_LINKS", None)  # a folder of this machine
    env = kept | {"HOME": "/root", "LANG": "C.UTF-8", "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}
    words = " ".join(f"{name}={shlex.quote(value)}" for name, value in env.items())
    script = ENTER.format(shared=" ".join(SHARED), env=words)
    apart = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-euc", script)
    return subprocess.run([*apart, root, command], check=False).returncode


def folder() -> Path:
    """The folder of the Debian; it depends on its packages."""
    name = hashlib.sha256(repr((SUITE, PACKAGES, SHARED)).encode()).hexdigest()[:16]
    return HOME.parent / "debian13" / name


def _make(root: Path) -> None:
    options = ("--variant=minbase", "--format=directory", "--aptopt=Acquire::Languages none")
    run("mmdebstrap", *options, f"--include={','.join(PACKAGES)}", SUITE, root)
    (root / "etc" / "resolv.conf").touch()


def _clone(source: Path) -> None:
    """Check out the last commit; unchanged files keep their times, so `make` installs little."""
    git = ("git", "-C", source)
    run("git", "init", "-q", source)
    run(*git, "fetch", "-q", "--depth", "1", f"file://{ROOT}", "HEAD")
    run(*git, "checkout", "-q", "--force", "FETCH_HEAD")
    run(*git, "clean", "-qfd")


def main(options: Sequence[str]) -> int:
    """Run the fast tests there, or only build it; the exit code of make."""
    if os.geteuid():
        raise Missing("a Debian needs root; use sudo")
    root = whole(folder(), _make)
    _clone(root / SOURCE[1:])
    more = shlex.quote(shlex.join(options))
    goal = f"{VENV}/tools.done" if options == ["build"] else f"PYTEST_OPTIONS={more} test-fast"
    return inside(root, f"cd {SOURCE}; make VENV={VENV} {goal}")


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except Missing as e:
        sys.exit(str(e))

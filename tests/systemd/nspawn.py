"""A real systemd: a container with Debian, systemd as PID 1 and the box installed as on a board.

`python -m tests.systemd.nspawn` makes the Debian once, in ~/.cache/palpate/nspawn: packages of
Debian, and a virtual environment with the wheels of appliance/requirements.lock. `Machine` boots it
in half a second. Changes stay in memory and are lost at the end. The container has no devices, and
its limits of memory and processor are not enforced. It needs root.
"""

import hashlib
import json
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

from tests.rig.emulated_machines import HOME, LOCK, PIP, ROOT, Missing, run, wheel, whole

CACHE = HOME.parent / "nspawn"
SUITE, PYTHON = "bookworm", "3.11"
"""Debian 12, the boards' system, and its Python."""
PACKAGES = (
    *("systemd", "systemd-sysv", "python3-venv", "libstdc++6"),
    *("libusb-1.0-0", "openssh-client", "openssl", "udev"),
)
TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "systemd-nspawn": "systemd-container",
    "nsenter": "util-linux",
    "setpriv": "util-linux",
}
UNITS = (
    *("palpate.service", "palpate@.service", "palpate-watch.service", "palpate-teach.path"),
    *("palpate-teach.service", "palpate-bridge@.service"),
)
PLACES = {unit: f"/etc/systemd/system/{unit}" for unit in UNITS} | {
    f"palpate.{kind}": f"/usr/lib/{kind}.d/palpate.conf" for kind in ("sysusers", "tmpfiles")
}
"""The destinations of the files of systemd/."""
CABLE = """
import os, sys, time
from palpate.__main__ import main
from palpate.sim import usb
class Cable(usb.RigBackend):
    # plugged in while /run/skin is there; its bus hangs while /run/hang is
    def _touch(self, what=""):
        while os.path.exists("/run/hang"):
            time.sleep(0.01)
        self.plug() if os.path.exists("/run/skin") else self.unplug()
        super()._touch(what)
usb.RigBackend = Cable
sys.exit(main())
"""
SIM = "ExecStart=\nExecStart=/opt/palpate/bin/palpate run --sim skin\n"
CABLED = "ExecStart=\nExecStart=/opt/palpate/bin/python /opt/palpate/cable.py run --sim skin\n"
PALPATE = "/opt/palpate/bin/palpate"
NOBODY = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups")
SITE = "/etc/palpate/palpate.toml"
STREAMS = r"skin streaming\. Sweeps answered: \d+"
WAIT_S = 180
"""Longest wait for an action of a second or two. Other programs may keep this machine busy."""
PATH = "PATH=/usr/sbin:/usr/bin:/sbin:/bin"
BOOT_S = 60
NAMESPACES = ("-m", "-u", "-i", "-n", "-p", "-C", "-r", "-w")
"""Options of nsenter for all namespaces of a container, its root and its folder."""


def folder() -> Path:
    """The folder of the Debian. It depends on the lock file, the suite and the processor."""
    key = repr((SUITE, PYTHON, PACKAGES, platform.machine())).encode()
    return CACHE / hashlib.sha256(LOCK.read_bytes() + key).hexdigest()[:16]


def check() -> None:
    """Raise Missing if this machine cannot run a container."""
    if os.geteuid():
        raise Missing("systemd in a container needs root; use sudo")
    if lacking := [name for name in TOOLS if not shutil.which(name)]:
        wanted = sorted({TOOLS[name] for name in lacking})
        raise Missing(f"no {', '.join(lacking)} here; apt-get install {' '.join(wanted)}")


def set_up() -> Path:
    """The folder of the Debian, made if it is missing. Raises Missing if mmdebstrap or pip fail."""
    check()
    return whole(folder(), _make)


def debian(root: Path, packages: Sequence[str], *options: str) -> None:
    """A minimal Debian with these packages in the folder `root`."""
    without = (f"--dpkgopt=path-exclude=/usr/share/{what}/*" for what in ("man", "doc", "locale"))
    including = (f"--include={','.join(packages)}", "--aptopt=Acquire::Languages none", *without)
    run("mmdebstrap", "--variant=minbase", *including, *options, "--format=directory", SUITE, root)


def _make(root: Path) -> None:
    debian(root, PACKAGES)
    wheels = root / "wheels"
    binary = ("--no-deps", "--only-binary", ":all:", "--python-version", PYTHON)
    run(*PIP, "download", *binary, "--require-hashes", "-r", LOCK, "-d", wheels)
    shutil.copy(LOCK, wheels)
    inside = ("chroot", root, "env", "-i", PATH)
    run(*inside, "python3", "-m", "venv", "/opt/palpate")
    run(*inside, *_pip("--find-links", "/wheels", "--require-hashes", "-r", f"/wheels/{LOCK.name}"))
    shutil.rmtree(wheels)


def _pip(*args: str) -> tuple[str, ...]:
    pip = ("/opt/palpate/bin/pip", "--disable-pip-version-check", "-q", "install")
    return (*pip, "--no-index", *args)


def _group() -> Path | None:
    """A new control group or None; in a shared one containers would end each other's programs."""
    mounts = (line.split() for line in Path("/proc/mounts").read_text().splitlines())
    mounted = next((Path(where) for _, where, kind, *_ in mounts if kind == "cgroup2"), None)
    return Path(tempfile.mkdtemp(prefix="palpate-", dir=mounted)) if mounted else None


class Machine:
    """A container that has booted; `run` runs a command in it as root.

    first: the number of its first process. root: the folder from `set_up`. parcel: a folder that
    the container sees, read-only, as /parcel. log: file for the messages of nspawn. volatile:
    changes are lost at the end. Raises Missing if this machine cannot boot a container.
    """

    def __init__(self, root: Path, parcel: Path, log: Path, *, volatile: bool = True) -> None:
        self.parcel, self._log, self._group = parcel, log, _group()
        with (
            tempfile.TemporaryDirectory() as place,
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear,
        ):
            ear.bind(f"{place}/notify")
            inside = ("sh", "-c", 'echo $$ >"$0/cgroup.procs"; exec "$@"', self._group)
            command = (
                *(inside if self._group else ()),
                *("setpriv", "--pdeathsig", "TERM"),  # a killed test run leaves no container
                *("systemd-nspawn", "--quiet", f"--directory={root}", "--boot", "--keep-unit"),
                *(f"--machine=palpate-{os.getpid()}", "--register=no", "--console=pipe"),
                *("--private-network", "--notify-ready=yes"),
                *(("--volatile=overlay",) if volatile else ()),
                "--system-call-filter=bpf",  # IPAddressDeny= of the units
                f"--bind-ro={parcel}:/parcel",
            )
            env = os.environ | {"NOTIFY_SOCKET": f"{place}/notify"}
            env |= {"SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"}
            with log.open("wb") as out:
                self._process = subprocess.Popen(
                    command, env=env, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
                )
            try:
                self.first = self._booted(ear)
            except BaseException:
                self.close()
                raise

    def _booted(self, ear: socket.socket) -> str:
        """Wait until its systemd has booted. Returns the number of its first process."""
        ear.settimeout(0.2)
        first, end = "", time.monotonic() + BOOT_S
        while time.monotonic() < end and self._process.poll() is None:
            with suppress(TimeoutError):
                key = dict(
                    line.partition("=")[::2] for line in ear.recv(4096).decode().splitlines()
                )
                first = key.get("X_NSPAWN_LEADER_PID", first)
                if key.get("READY") == "1":
                    return first
        raise Missing(
            "systemd does not boot in a container here: "
            f"{self._log.read_text(errors='replace').strip()}"
        )

    def run(
        self, *command: str, say: str = "", limit_s: float = 300
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in it to the end, with `say` as its input."""
        return subprocess.run(
            [*self._enter(), *command],
            input=say,
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
        )

    def begin(self, *command: str) -> subprocess.Popen[str]:
        """Start a command in it as `run` does, with its output in a pipe."""
        return subprocess.Popen(
            [*self._enter(), *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def _enter(self) -> tuple[str, ...]:
        return ("nsenter", "-t", self.first, *NAMESPACES, "env", "-i", PATH)

    @contextmanager
    def still(self) -> Iterator[None]:
        """None of its processes runs meanwhile. Needs control groups of version 2."""
        assert self._group, "no cgroup2 is mounted here"
        freeze, events = self._group / "cgroup.freeze", self._group / "cgroup.events"
        freeze.write_text("1")
        try:
            while "frozen 1" not in events.read_text():
                time.sleep(0.001)
            yield
        finally:
            freeze.write_text("0")

    def as_user(self, pid: int | str, user: str, *command: str) -> subprocess.CompletedProcess[str]:
        """Run a command as a user, with its groups, in the file system that a process sees."""
        who = ("setpriv", f"--reuid={user}", "--regid=palpate", "--clear-groups")
        return self.run("nsenter", "-t", str(pid), "-m", *who, *command)

    def check_unit(self, name: str) -> None:
        """Check that systemd reports no problem of a unit, and an exposure of at most 1.5 of 10."""
        done = self.run("systemd-analyze", "verify", name.replace("@.", "@tcp."))
        assert (done.returncode, done.stderr) == (0, "")
        how = ("security", "--offline=true", "--threshold=15", PLACES[name])
        done = self.run("systemd-analyze", *how)
        assert done.returncode == 0, done.stdout

    def until(self, condition: str) -> None:
        """Wait for a shell command to succeed."""
        tries = f"for i in $(seq {2 * WAIT_S}); do {condition} && exit; sleep 0.5; done; exit 1"
        done = self.run("sh", "-c", tries, limit_s=2 * WAIT_S)
        assert done.returncode == 0, self.get("journalctl", "-q", "-n", "30", "-o", "cat")

    def shown(self, unit: str, name: str) -> str:
        """A property of a unit."""
        return self.get("systemctl", "show", unit, "--value", "-p", name)

    def get(self, *command: str, say: str = "") -> str:
        """The output of a command, which must succeed."""
        done = self.run(*command, say=say)
        assert done.returncode == 0, f"{command} gave {done.returncode}: {done.stdout}{done.stderr}"
        return done.stdout.strip()

    def put(self, path: str, text: str) -> None:
        """Write a file and make its folder."""
        self.get("mkdir", "-p", str(Path(path).parent))
        self.get("tee", path, say=text)

    def install(self) -> None:
        """Install the box as on a board. `parcel` holds its wheel and the files of systemd/."""
        self.get("sh", "-c", f"{' '.join(_pip('--no-deps'))} /parcel/*.whl")
        for name, place in PLACES.items():
            self.get("install", "-D", "-m", "644", f"/parcel/{name}", place)
        self.get("systemd-sysusers", PLACES["palpate.sysusers"])
        self.get("systemd-tmpfiles", "--create", PLACES["palpate.tmpfiles"])
        self.get("systemctl", "daemon-reload")

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._group:
            for place in (*sorted(self._group.rglob("*/"), reverse=True), self._group):
                with suppress(OSError):  # a program in it is still ending
                    place.rmdir()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Service:
    """palpate.service on a machine."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self._begin = time.time()

    def configure(self, text: str) -> None:
        """Add lines to [Service] with a drop-in."""
        self.machine.put("/run/systemd/system/palpate.service.d/test.conf", f"[Service]\n{text}\n")
        self.machine.get("systemctl", "daemon-reload")

    def start(self, text: str = SIM) -> int:
        """Start it with a drop-in, wait until it is active; returns the number of its process."""
        self.configure(text)
        self.machine.get("systemctl", "start", "palpate")
        return int(self["MainPID"])

    def __getitem__(self, name: str) -> str:
        return self.machine.get("systemctl", "show", "palpate", "--value", "-p", name)

    def until(self, name: str, wanted: str) -> None:
        """Wait until a property matches `wanted`, a regular expression."""
        end = time.monotonic() + WAIT_S
        while not re.fullmatch(wanted, value := self[name]):
            assert time.monotonic() < end, f"{name} stays {value!r}: {self.journal()}"
            time.sleep(0.2)

    def kill(self, signal: str) -> None:
        """Send a signal to the process itself, behind systemd's back."""
        self.machine.get("systemctl", "kill", "--kill-whom=main", f"--signal={signal}", "palpate")

    def journal(self, *more: str) -> list[str]:
        """The journal of the service, and of systemd about it, since the test began."""
        about = ("-u", "palpate", "-o", "cat", f"--since=@{self._begin:.6f}", *more)
        return self.machine.get("journalctl", "-q", *about).splitlines()

    def log_lines(self, *more: str) -> list[str]:
        """The journal of the program, without the lines of systemd."""
        return self.journal("_SYSTEMD_UNIT=palpate.service", *more)

    def answers(self) -> list[str]:
        return [line for line in self.log_lines() if line.startswith("sweep ")]

    def status(self) -> dict[str, Any]:
        """The output of `palpate status --json` for an unprivileged user."""
        return dict(json.loads(self.machine.run(*NOBODY, PALPATE, "status", "--json").stdout))


def pack(parcel: Path, source: Path) -> None:
    """Put the wheel of this checkout and systemd/ into a parcel. source: an empty folder."""
    wheel(parcel, source)
    for name in PLACES:
        shutil.copy(ROOT / "systemd" / name, parcel)


if __name__ == "__main__":
    try:
        print(set_up())
    except Missing as e:
        sys.exit(str(e))

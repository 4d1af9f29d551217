"""Real hosts: containers with Debian, each with a network namespace, an sshd and a bare user.

`make install` and `make deploy` are tested on them, as root on this machine. `python -m
tests.systemd.hosts` makes their Debian.

Their Debian is made once, in ~/.cache/palpate/hosts, in two kinds: `bare` has the packages of an
install in apt's cache, as from a mirror; `ready` has them installed. Changes on a host are lost
when it stops. A drop-in for the unit selects the simulated skin.
"""

import hashlib
import os
import platform
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from itertools import count
from pathlib import Path
from typing import Self

from tests.rig.emulated_machines import HOME, ROOT, Missing, run, whole
from tests.systemd import nspawn

CACHE = HOME.parent / "hosts"
PACKAGES = ("systemd", "systemd-sysv", "openssh-server", "sudo", "dbus")
WANTED = ("python3-venv", "libusb-1.0-0", "openssh-client")
"""Packages that an install gets by apt-get."""
USER = "robot"
_NUMBERS = count(os.getpid() * 8)
"""Numbers of hosts: another one for each that this process starts, away from other processes."""
NET = "10.213"


def folder() -> Path:
    """The folder of both Debians. It depends on the packages and on the processor."""
    key = repr((nspawn.SUITE, PACKAGES, WANTED, platform.machine())).encode()
    return CACHE / hashlib.sha256(key).hexdigest()[:16]


def check() -> None:
    """Raise Missing if such hosts cannot run here."""
    nspawn.check()
    if lacking := [tool for tool in ("ip", "ssh", "ssh-keygen") if not shutil.which(tool)]:
        raise Missing(f"no {', '.join(lacking)} here; apt-get install iproute2 openssh-client")


def set_up() -> Path:
    """The folder with the Debians `bare` and `ready`, made if missing. Raises Missing."""
    check()
    return whole(folder(), _make)


def _make(part: Path) -> None:
    bare, ready = part / "bare", part / "ready"
    nspawn.debian(bare, PACKAGES, "--skip=cleanup/apt")
    _inside(bare, "useradd", "--create-home", "--shell", "/bin/sh", USER)
    (bare / "etc/sudoers.d/user").write_text(f"{USER} ALL=(ALL) NOPASSWD: ALL\n")
    install = ("apt-get", "install", "-y", "-qq", "--no-install-recommends")
    _inside(bare, "apt-get", "clean")
    _inside(bare, *install, "--download-only", *WANTED)
    run("cp", "-a", bare, ready)
    _inside(ready, *install, *WANTED)


def _inside(root: Path, *command: str) -> None:
    run("chroot", root, "env", "-i", nspawn.PATH, "DEBIAN_FRONTEND=noninteractive", *command)


FETCH = """
import platform, sys; from release import LOCK, fetch, locked
fetch(locked(LOCK.read_text(), sys.argv[1], platform.machine()), sys.argv[1], platform.machine())
"""


def _fetch_wheels() -> None:
    """Fetch the wheels for such a host: its network does not reach their registry."""
    python = f"{nspawn.PYTHON}.2"
    run("env", f"PYTHONPATH={ROOT / 'systemd'}:{ROOT}", sys.executable, "-c", FETCH, python)


class Host:
    """A host that has booted and answers on its ssh port.

    number: a unique number, 1 to 250, on this machine. work: an empty folder. key: its owner may
    log in. volatile: changes are lost at the end. Raises Missing if the host does not boot.
    """

    def __init__(
        self, root: Path, number: int, work: Path, key: Path, *, volatile: bool = True
    ) -> None:
        self.name, self.address, self._key = f"box-{number}", f"{NET}.{number}.2", key
        (work / "parcel").mkdir(parents=True)
        log = work / "nspawn.log"
        self.machine = nspawn.Machine(root, work / "parcel", log, volatile=volatile)
        self.service = nspawn.Service(self.machine)
        try:
            self.pid = self.machine.first
            link, far = f"palpate{number}", f"palpate{number}f"
            run("ip", "link", "add", link, "type", "veth", "peer", "name", far, "netns", self.pid)
            run("ip", "addr", "add", f"{NET}.{number}.1/30", "dev", link)
            run("ip", "link", "set", link, "up")
            for rest in (f"addr add {self.address}/30 dev {far}", f"link set {far} up"):
                run("nsenter", "-t", self.pid, "-n", "ip", *rest.split())
            home = f"/home/{USER}/.ssh"
            self.machine.put(f"{home}/authorized_keys", key.with_suffix(".pub").read_text())
            self.machine.get("chown", "-R", f"{USER}:{USER}", home)
            self.machine.get("sh", "-c", "echo 127.0.0.1 localhost $(hostname) > /etc/hosts")
            self.service.configure(nspawn.SIM)
            self._answers()
        except BaseException:
            self.close()
            raise

    def _answers(self) -> None:
        end_s = time.monotonic() + nspawn.BOOT_S
        while time.monotonic() < end_s:
            with suppress(OSError), socket.create_connection((self.address, 22), 1) as way:
                if way.recv(4) == b"SSH-":
                    return
            time.sleep(0.1)
        raise Missing(f"{self.address} has no sshd after {nspawn.BOOT_S} s")

    def close(self) -> None:
        """Shut it down."""
        self.machine.close()


def changed_wheel(wheel: Path, folder: Path, name: str, text: str) -> Path:
    """Another release: the wheel with a new file, or with more text at the end of one."""
    made = folder / wheel.name
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(made, "w") as new:
        texts = {member: old.read(member) for member in old.namelist()}
        texts[name] = texts.get(name, b"") + text.encode()
        for member, content in texts.items():
            new.writestr(member, content)
    return made


def key_of(home: Path) -> Path:
    """The key of a new user, in a new home without known hosts."""
    ssh = home / ".ssh"
    ssh.mkdir(parents=True)
    (ssh / "known_hosts").touch()
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", ssh / "id_ed25519")
    return ssh / "id_ed25519"


def desktop(
    home: Path, command: str, *args: str | Path, where: Sequence[str] = (), limit_s: float = 600
) -> subprocess.CompletedProcess[str]:
    """Run systemd/COMMAND.py as the user with this home. where: a prefix of the command."""
    return subprocess.run(
        [*where, sys.executable, ROOT / "systemd" / f"{command}.py", *map(str, args)],
        env=os.environ | {"HOME": str(home)},
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
    )


class Hosts:
    """Several hosts, and a desktop that may log in on them. kind: "bare" or "ready"."""

    def __init__(self, count: int, work: Path, kind: str = "ready") -> None:
        self._stack = ExitStack()
        self.work = work
        key = key_of(work)
        root = set_up() / kind
        _fetch_wheels()
        with self._stack:
            self.hosts = [
                self._stack.enter_context(closing(Host(root, number, work / f"host-{number}", key)))
                for number in (1 + next(_NUMBERS) % 240 for _ in range(count))
            ]
            self._stack = self._stack.pop_all()

    def inventory(self) -> Path:
        """An inventory of all hosts."""
        shared = {
            "ssh_user": USER,
            "ssh_key": str(self.work / ".ssh/id_ed25519"),
            "ssh_known_hosts_file": str(self.work / ".ssh/known_hosts"),
        }
        file = self.work / "inventory.py"
        hosts = [(host.name, {"ssh_hostname": host.address}) for host in self.hosts]
        file.write_text(f"hosts = ({hosts!r}, {shared!r})\n")
        return file

    def desktop(
        self, command: str, *args: str | Path, inside: Host | None = None, limit_s: float = 600
    ) -> subprocess.CompletedProcess[str]:
        """Run systemd/COMMAND.py as the user with the key, in the network of `inside` or here."""
        where = ("nsenter", "-t", inside.pid, "-n") if inside else ()
        return desktop(self.work, command, *args, where=where, limit_s=limit_s)

    def cut(self, command: str, *args: str | Path, words: str, after_s: float) -> None:
        """Run a command, and kill it `after_s` after it has printed `words`."""
        with subprocess.Popen(
            [sys.executable, ROOT / "systemd" / f"{command}.py", *map(str, args)],
            env=os.environ | {"HOME": str(self.work)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            while words not in (line := process.stderr.readline()):
                if not line:
                    raise AssertionError(f"ended without {words!r}")
            time.sleep(after_s)
            process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


if __name__ == "__main__":
    try:
        print(set_up())
    except Missing as e:
        sys.exit(str(e))

"""`make install` and `make deploy` into a bare arm64 Debian, over ssh: install, start, deliver,
trial, power cut, rollback.

In: a guest without Palpate, with the lines, the serial port and the skin of a cell, its sshd at a
port of this machine. Out: which bundle answers the robot. The stages share the guest's disk and
come in their order.
"""

import hashlib
import json
import re
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from palpate.bundle import bundle
from palpate.deployment.state import MOST_STARTS
from palpate.sim import script
from tests.factories import deliveries
from tests.factories.install_scripts import require_pyinfra
from tests.rig import emulated_machines
from tests.rig.cell import Cell
from tests.rig.image import GUEST, Image, ground, layer
from tests.rig.kept import PALPATE, found
from tests.rig.machine import Guest
from tests.rig.notes import HOW, Note
from tests.rig.sound import known, not_wrong
from tests.systemd import hosts

pytestmark = pytest.mark.skipif(
    HOW != "full",
    reason="installs a bare guest; PALPATE_RIG=full python -m tests.campaigns test-rig",
)
require_pyinfra()

BOOT_S, BACK_S = 300, 180
INSTALL_S = 1800
"""Longest time for a command of the desktop: the guest builds a virtual environment, at the pace of
an emulator."""
TRIES = 3
"""Sweeps until one is named: while an emulator is busy with something else, one may come to
nothing."""
NETWORK = (
    "[Match]\nType=ether\n[Network]\nAddress=10.0.2.15/24\nLinkLocalAddressing=no\n"
    "IPv6AcceptRA=no\n"
)
"""What QEMU's network without a way out expects."""
ROBOT_PORT = 'SUBSYSTEM=="tty", KERNELS=="0000:00:08.0", SYMLINK+="palpate-robot"\n'
ADMIT = f"""set -e
rm -r /opt/palpate
useradd --create-home --shell /bin/sh {hosts.USER}
echo '{hosts.USER} ALL=(ALL) NOPASSWD: ALL' > /etc/sudoers.d/user
mkdir /home/{hosts.USER}/.ssh; cat > /home/{hosts.USER}/.ssh/authorized_keys
chown -R {hosts.USER} /home/{hosts.USER}/.ssh
systemctl enable --now systemd-networkd ssh
"""
"""Takes the ground's runtime away and lets a person in, as a card that was written for a new board
does."""
AS_PALPATE = "runuser -u palpate --"


class BareBox:
    """A disk on top of a ground's, a desktop with a key to it, and a person who signs bundles.

    port: of this machine, that leads to the guest's sshd. sha: of the bundles, in the order in
    which they were delivered.
    """

    def __init__(self, on: Path, folder: Path) -> None:
        self.folder, self.sha = folder, list[str]()
        self.disk = layer(on, folder)
        self._image = Image(on, self.disk)
        self._home, self._signer = folder / "home", deliveries.key(folder / "keys")
        self._key = hosts.key_of(self._home)
        (folder / "signers").write_text(deliveries.line(self._signer))
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]

    @contextmanager
    def on(self) -> Iterator[Cell]:
        """Power on, with a robot's cell; the power goes at the end, as it is."""
        with Guest(self._image, self.folder, disk=self.disk, ssh=self.port) as guest:
            guest.ready(BOOT_S)
            cell = Cell(guest)
            cell.acts = known(script.tubes(len(self.sha)))
            cell.plug()
            yield cell

    def prepare(self, cell: Cell) -> None:
        """Before the first install: a card with a network, a key, the cell's settings."""
        run, put = cell.machine.run, cell.machine.put
        put("/etc/systemd/network/wire.network", NETWORK.encode())
        put("/etc/udev/rules.d/71-rig.rules", ROBOT_PORT.encode())
        run("udevadm control --reload; udevadm trigger --settle", check=True, timeout_s=60)
        run(ADMIT, stdin=self._key.with_suffix(".pub").read_bytes(), check=True, timeout_s=120)
        run("mkdir -p /etc/palpate", check=True)
        put("/etc/palpate/palpate.toml", (GUEST / "palpate.toml").read_bytes())

    def desktop(self, command: str, *args: str | Path) -> str:
        """What `make install` or `make deploy` says. Raises AssertionError where it fails."""
        at = ("--host", f"{hosts.USER}@127.0.0.1:{self.port}", "--signers", self.folder / "signers")
        done = hosts.desktop(self._home, command, *at, *args, limit_s=INSTALL_S)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def install(self) -> str:
        """`make install` of this checkout."""
        for name in ("dist", "source"):
            (self.folder / name).mkdir()
        emulated_machines.wheel(self.folder / "dist", self.folder / "source")
        shutil.rmtree(self.folder / "source")
        return self.desktop("install", "--wheel", next((self.folder / "dist").glob("*.whl")))

    def deploy(self) -> str:
        """`make deploy` of a new bundle, signed, with the next counter."""
        number = len(self.sha) + 1
        made = deliveries.put(
            self.folder / f"bundle-{number}", deliveries.files(number, self._signer)
        )
        self.sha.append(hashlib.sha256((made / bundle.MANIFEST).read_bytes()).hexdigest())
        return self.desktop("deploy", made)


def roles(cell: Cell) -> dict[str, dict[str, Any]]:
    """The role of each bundle by its sha256, as the box states it."""
    told = cell.machine.run(f"{AS_PALPATE} {PALPATE} bundles --json", timeout_s=90, check=True).out
    return {one["sha"]: one for one in json.loads(told)}


def answered_by(cell: Cell, sha: str) -> None:
    """READY, and a sweep is classified correctly, by this bundle."""
    cell.until_ready(BACK_S)
    for _ in range(TRIES):
        touch, answer = cell.sweep()
        assert answer.bundle == sha[:8], f"{answer.bundle} answered instead of {sha[:8]}"
        if not_wrong(touch, answer) == "ok":
            return
    raise AssertionError(f"no sweep was named; the box says: {cell.journal()}")


def sound(box: BareBox) -> None:
    """The file system is in order after the cut."""
    code, _ = found(box.disk, box.folder)
    assert code == 0, f"e2fsck ended with {code}"


def test_the_way_of_a_bundle(tmp_path: Path, note: Note):
    """Installed, on trial through a loss of power; crashes and `palpate rollback`."""
    box = BareBox(ground(), tmp_path)
    with box.on() as cell:
        box.prepare(cell)
        said = box.install()
        assert re.search(r"is READY [0-9.]+ s after the command\n", said), said
        answered_by(cell, bundle.load(bundle.DEFAULT).id)
        note(
            "make install on a bare Debian for arm64, over ssh",
            "service started, READY; a sweep classified correctly",
            1,
        )
        said = box.deploy()
        assert re.search(r"is READY [0-9.]+ s after the command; .* on trial: ", said), said
        first = box.sha[0]
        answered_by(cell, first)
        assert roles(cell)[first]["role"] == "on trial"
        note(
            "make deploy of a signed bundle",
            "on trial, READY; a sweep classified correctly by it",
            1,
        )
    sound(box)
    with box.on() as cell:
        answered_by(cell, first)
        told = roles(cell)[first]
        assert (told["role"], told["detail"].split(",")[0]) == (
            "on trial",
            f"start 1 of {MOST_STARTS}",
        ), told
        note("power cut in the trial", "on trial still, READY after the boot; file system clean", 1)
        cell.machine.run(f"{AS_PALPATE} {PALPATE} commit", timeout_s=90, check=True)
        box.deploy()
        second = box.sha[1]
        answered_by(cell, second)
        dies(cell)
        answered_by(cell, first)
        told = roles(cell)
        assert (told[first]["role"], told[second]["role"]) == ("current", "left"), told
        note(
            "bundle on trial with which the program dies at each start",
            "left without help, the one before answers",
            1,
        )
        box.deploy()
        answered_by(cell, box.sha[2])
    sound(box)
    with box.on() as cell:
        answered_by(cell, box.sha[2])
        cell.machine.run(
            f"{AS_PALPATE} {PALPATE} rollback && systemctl restart --no-block palpate",
            timeout_s=90,
            check=True,
        )
        cell.lines.wait("READY", False, BACK_S)
        answered_by(cell, first)
        note(
            "power cut in the trial, then palpate bundles rollback", "the bundle before answers", 1
        )
    sound(box)


def dies(cell: Cell) -> None:
    """Each start of the trial ends with a crash once it is READY."""
    for _ in range(MOST_STARTS):
        cell.until_ready(BACK_S)
        cell.machine.run("systemctl kill -s SEGV palpate", check=True)
        assert cell.lines.wait("READY", False, BACK_S)

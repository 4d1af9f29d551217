"""One running guest, made from an image, with its USB port, lines and serial port within reach of a
test.

It boots from its disk, or continues from the snapshot in two seconds. `cut` cuts the power. Nothing
of a run is kept: each run has a disk of its own on top of the image's, unless it is asked to write
into the image itself.
"""

import base64
import json
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import Any, Self

from tests.rig import guest_clock
from tests.rig.emulated_machines import run
from tests.rig.far_end import FarEnd
from tests.rig.image import LINES, MACHINE, Image
from tests.rig.lines import GuestLines
from tests.rig.qtest import Qtest
from tests.rig.shell import Done, GuestFailed, Shell
from tests.rig.usbredir import UsbRedirPeer

START_S = 60
"""Longest wait for QEMU to open its sockets, or to load a snapshot."""
CARDS_S = 600
"""Longest wait for a booting kernel to set up its cards, in the host's time: the guest's clock
needs these cards."""


class Guest:
    """A guest that runs until `close`, `cut`, or until it powers off.

    image: the box. folder: for its sockets and its disk. snapshot: continue from there instead of
    booting. disk: use this disk as it is and write into it. code: a folder that becomes its second
    disk, read-only. ssh: port of this machine that leads to the guest's port 22; 0 gives no
    network. clock: its time. lines, serial, skin: the robot's ends of trigger and result lines, of
    the serial port, and of the USB cable.
    """

    def __init__(
        self,
        image: Image,
        folder: Path,
        *,
        snapshot: bool = False,
        disk: Path | None = None,
        code: Path | None = None,
        ssh: int = 0,
    ) -> None:
        self._folder = Path(folder) / f"vm{time.monotonic_ns()}"
        self._folder.mkdir(parents=True)
        if disk is None and snapshot:
            disk = self._folder / "disk.qcow2"
            shutil.copy(image.disk, disk)
        self.disk = disk or image.disk
        self._code_disk(code)
        redir = socket.socket(socket.AF_UNIX)
        redir.bind(str(self._folder / "skin"))
        redir.listen(1)
        self._process = subprocess.Popen(
            self._command(image, snapshot, ssh),
            stdin=subprocess.DEVNULL,
            stdout=(self._folder / "qemu.log").open("wb"),
            stderr=subprocess.STDOUT,
        )
        try:
            self._qmp = self._connect("qmp").makefile("rw")
            self._qmp.readline()
            self.qmp("qmp_capabilities")
            agent = self._connect("agent")
            self._qtest = Qtest(self._connect("qtest"))
            self.clock = guest_clock.find(self._qtest, CARDS_S)
            self._shell = Shell(agent, self.clock)
            self.serial = FarEnd(self._folder / "robot", self.clock)
            self.lines = GuestLines(self._qtest, self.clock, self._find("pl061"), LINES)
            self.skin = self._plug_cable(redir)
        except BaseException:
            self.cut()
            raise
        finally:
            redir.close()

    def _code_disk(self, code: Path | None) -> None:
        # always present and of the same size, because a snapshot needs the hardware with which it
        # was made
        given = ["-d", code] if code else []
        path = self._folder / "code.img"
        run("mke2fs", "-q", "-t", "ext4", "-O", "^has_journal", *given, path, "48M")

    def _command(self, image: Image, snapshot: bool, ssh: int) -> list[str | Path]:
        at = self._folder
        return [
            *("qemu-system-aarch64", *MACHINE, "-accel", "tcg,thread=single"),
            *guest_clock.STEADY,
            *("-display", "none", "-kernel", image.kernel),
            *("-initrd", image.ground / "ramdisk", "-dtb", image.ground / "tree.dtb"),
            *("-append", "console=ttyAMA0 quiet systemd.show_status=0 panic=-1", "-no-reboot"),
            *("-drive", f"file={self.disk},format=qcow2,if=none,id=d0"),
            *("-device", "virtio-blk-pci,drive=d0,addr=4"),
            *("-drive", f"file={at}/code.img,format=raw,if=none,id=d1,readonly=on"),
            *("-device", "virtio-blk-pci,drive=d1,addr=5"),
            *("-device", "qemu-xhci,id=xhci,addr=6", "-device", "virtio-rng-pci,addr=7"),
            *(*self._port("robot"), "-device", "pci-serial,chardev=robot,addr=8"),
            *("-device", "virtio-serial-pci,addr=9", *guest_clock.DEVICE),
            *(*self._port("agent"), "-device", "virtserialport,chardev=agent,name=palpate.agent"),
            *(*self._port("bench"), "-device", "virtserialport,chardev=bench,name=palpate.bench"),
            *("-chardev", f"file,id=console,path={at}/console", "-serial", "chardev:console"),
            *("-qmp", f"unix:{at}/qmp,server=on,wait=off"),
            *("-qtest", f"unix:{at}/qtest,server=on,wait=off", "-qtest-log", "/dev/null"),
            *(_network(ssh) if ssh else ()),
            *(("-loadvm", "ready") if snapshot else ()),
        ]

    def _port(self, name: str) -> tuple[str, str]:
        return "-chardev", f"socket,id={name},path={self._folder}/{name},server=on,wait=off"

    def _connect(self, name: str) -> socket.socket:
        end = time.monotonic() + START_S
        while True:
            s = socket.socket(socket.AF_UNIX)
            try:
                s.connect(str(self._folder / name))
                return s
            except OSError as e:
                s.close()
                if self._process.poll() is not None or time.monotonic() > end:
                    log = (self._folder / "qemu.log").read_text(errors="replace")
                    raise GuestFailed(f"qemu opened no {name} socket: {log[-800:] or e}") from e
                time.sleep(0.02)

    def _find(self, kind: str) -> str:
        """Path of a device of the board in QEMU's tree of objects."""
        devices = self.qmp("qom-list", path="/machine/unattached")
        return next(
            f"/machine/unattached/{d['name']}" for d in devices if d["type"] == f"child<{kind}>"
        )

    def _plug_cable(self, listener: socket.socket) -> UsbRedirPeer:
        """Connect the far end of a USB cable to the guest's port, without a device yet."""
        address = {"type": "unix", "data": {"path": str(self._folder / "skin")}}
        self.qmp(
            "chardev-add",
            id="skin",
            backend={"type": "socket", "data": {"addr": address, "server": False}},
        )
        self.qmp("device_add", driver="usb-redir", id="cable", chardev="skin", bus="xhci.0")
        listener.settimeout(START_S)
        return UsbRedirPeer(listener.accept()[0], self.clock)

    def qmp(self, execute: str, **arguments: Any) -> Any:
        """The result of a command to QEMU's monitor. Raises GuestFailed."""
        self._qmp.write(json.dumps({"execute": execute, "arguments": arguments}) + "\n")
        self._qmp.flush()
        for line in self._qmp:
            reply = json.loads(line)
            if "error" in reply:
                raise GuestFailed(f"qemu: {execute}: {reply['error']['desc']}")
            if "return" in reply:
                return reply["return"]
        raise GuestFailed(f"qemu has left during {execute}")

    def ready(self, timeout_s: float) -> None:
        """Wait until the guest runs shell commands. Raises GuestFailed if it does not."""
        self.run("true", timeout_s=timeout_s)

    def run(
        self, line: str, *, timeout_s: float = 30, check: bool = False, stdin: bytes = b""
    ) -> Done:
        """Run a command as root to its end. Raises GuestFailed, also if `check` fails."""
        return self._shell.run(line, timeout_s=timeout_s, check=check, stdin=stdin)

    def out(self, line: str, timeout_s: float = 30) -> str:
        """The output of a shell command, which must succeed."""
        return self.run(line, timeout_s=timeout_s, check=True).out.strip()

    def put(self, path: str, data: bytes) -> None:
        """Write a file of the guest."""
        self.run(f"cat > {path}", stdin=data, check=True)

    def get(self, path: str) -> bytes:
        """Read a file of the guest."""
        return base64.b64decode(self.run(f"base64 {path}", check=True).out)

    def save(self) -> None:
        """Save the guest as the snapshot `ready`, without a USB device, and end it."""
        self.qmp("device_del", id="cable")
        self.run("udevadm settle")
        text = self.qmp("human-monitor-command", **{"command-line": "savevm ready"})
        if text.strip():
            raise GuestFailed(f"qemu: savevm: {text}")
        self.close()

    def bench(self) -> socket.socket:
        """The far end of the port by which tests inside ask for actions outside."""
        return self._connect("bench")

    def console(self) -> str:
        """The console's output of the kernel and systemd."""
        return (self._folder / "console").read_text(errors="replace")

    def cut(self) -> None:
        """Cut the power: the guest cannot shut down."""
        self._process.kill()
        self._process.wait()
        for part in ("serial", "lines", "skin", "_qtest"):
            if hasattr(self, part):
                getattr(self, part).close()

    close = cut

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _network(ssh: int) -> tuple[str, ...]:
    """QEMU's options for a network without a way out; port `ssh` leads to 22."""
    forward = f"user,id=net,restrict=on,hostfwd=tcp:127.0.0.1:{ssh}-:22"
    return "-netdev", forward, "-device", "virtio-net-pci,netdev=net,addr=0xb,romfile="

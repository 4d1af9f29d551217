"""Builds the virtual box from packages of Debian and Python and this checkout: disks, cached under
their hash.

The first step is a *ground*: Debian for arm64 with its stock kernel and a virtual environment with
the box's locked dependencies. It takes minutes and is the same for every commit. The second is a
*box*: the wheel, units, rules and settings of this checkout, installed in the running guest as a
person would, and a snapshot of the guest after its service has started.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.factories.install_scripts import run_here
from tests.rig import emulated_machines
from tests.rig.emulated_machines import ROOT, Missing, run, whole

HERE = Path(__file__).parent
GUEST = HERE / "guest"
CACHE = emulated_machines.HOME.parent / "rig"
SUITE = "bookworm"
GUEST_PYTHON = "3.11"
"""Python version of SUITE."""
PACKAGES = (
    *("systemd", "systemd-sysv", "udev", "dbus", "kmod", "libpam-systemd", "python3-venv"),
    *("libusb-1.0-0", "e2fsprogs", "procps", "usbutils", "openssh-server", "openssl", "sudo"),
)
MODULES = (
    *("virtio_blk", "virtio_pci", "ext4", "crc32c_generic", "virtio_console", "virtio_rng"),
    *("autofs4", "xhci-pci", "cdc-acm", "ftdi_sio", "usbserial", "tmpfs", "virtio_net"),
)
EARLY = ("virtio_pci", "virtio_blk", "ext4", "crc32c_generic")
"""Modules that the ramdisk loads; everything else comes from the disk."""
LINES = ("START", "STOP", "READY", "FAULT", "RESULT-VALID", "CLASS-0", "CLASS-1", "CLASS-2")
"""Names of the guest's eight PL061 lines, by offset."""
DISK = "2G"
MACHINE = (
    *("-machine", "virt,gic-version=3", "-cpu", "cortex-a72", "-smp", "2", "-m", "512"),
    *("-nic", "none"),
)
"""The guest's hardware, as far as its device tree describes it."""
TOOLS = {
    "qemu-system-aarch64": "qemu-system-arm",
    "qemu-img": "qemu-utils",
    "qemu-aarch64-static": "qemu-user-static",
    "mmdebstrap": "mmdebstrap",
    "arch-test": "arch-test",
    "fdtput": "device-tree-compiler",
    "mke2fs": "e2fsprogs",
    "depmod": "kmod",
    "cpio": "cpio",
}


@dataclass(frozen=True, slots=True)
class Image:
    """Kernel, ramdisk, device tree, and a disk with the snapshot `ready`."""

    ground: Path
    disk: Path

    @property
    def kernel(self) -> Path:
        """The stock kernel."""
        return self.ground / "vmlinuz"


def image(log: Callable[[str], None] = print) -> Image:
    """The box of this checkout, built if not cached. Raises Missing."""
    return box(ground(log), log)


def built() -> Image | None:
    """The box of this checkout if it has been built, else None."""
    folder = CACHE / _box_name()
    return Image(CACHE / _ground_name(), folder / "disk.qcow2") if folder.exists() else None


def ground(log: Callable[[str], None] = print) -> Path:
    """Folder of vmlinuz, ramdisk, tree.dtb, disk.img, built if not cached. Raises Missing."""
    target = CACHE / _ground_name()
    if not target.exists():
        _need(TOOLS)
        if os.geteuid():
            raise Missing(
                "the virtual box is made as root, since files of many owners are; use sudo"
            )
        log(f"making the ground of the virtual box: Debian {SUITE} for arm64, about three minutes")
        whole(target, _make_ground)
    return target


def box(on: Path, log: Callable[[str], None] = print) -> Image:
    """This checkout installed on a ground, built if it is not cached. Raises Missing."""
    target = CACHE / _box_name()
    made = Image(on, target / "disk.qcow2")
    if not target.exists():
        _need(["qemu-system-aarch64", "qemu-img", "mke2fs"])
        log("installing this checkout on it, about a minute")
        whole(target, lambda part: _make_box(part, on))
    return made


def layer(on: Path, folder: Path) -> Path:
    """A new disk in `folder` on top of a ground's disk, which is not changed."""
    disk = folder / "disk.qcow2"
    run("qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", on / "disk.img", disk)
    return disk


def lacking(tools: Iterable[str] = TOOLS) -> list[str]:
    """Debian packages of those of `tools` that are not installed."""
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
    return sorted({TOOLS[name] for name in tools if not shutil.which(name, path=path)})


def _need(tools: Iterable[str]) -> None:
    os.environ["PATH"] += ":/usr/sbin:/sbin"
    if packages := lacking(tools):
        raise Missing(
            f"the virtual box needs more than is here; apt-get install {' '.join(packages)}"
        )


def _ground_name() -> str:
    inside = (GUEST / name for name in ("agent.py", "agent.service", "init"))
    parts = [emulated_machines.LOCK, HERE / "arm.py", *inside]
    key = repr((SUITE, PACKAGES, MODULES, EARLY, LINES, DISK, MACHINE))
    return f"ground-{_hash(parts, key)}"


def _box_name() -> str:
    parts = [
        p
        for folder in ("appliance", "systemd", "firmware_config")
        for p in sorted((ROOT / folder).rglob("*"))
        if p.is_file() and "__pycache__" not in p.parts
    ]
    parts += [ROOT / "pyproject.toml", GUEST / "install.sh", GUEST / "palpate.toml"]
    parts += [HERE / "machine.py", HERE / "guest_clock.py"]
    return f"box-{_hash(parts, _ground_name())}"


def _hash(parts: Iterable[Path], key: str) -> str:
    total = hashlib.sha256(key.encode())
    for part in parts:
        total.update(hashlib.sha256(part.read_bytes()).digest() + part.name.encode())
    return total.hexdigest()[:16]


def _download_wheels(part: Path) -> None:
    """The locked wheels for the guest's processor."""
    lock = part / emulated_machines.LOCK.name
    lock.write_text(guest_lock())
    run(
        *(*emulated_machines.PIP, "download", *emulated_machines.ARM_WHEELS),
        *("--python-version", GUEST_PYTHON, "--require-hashes"),
        *("-r", lock, "-d", part / "wheels"),
    )


def _make_ground(part: Path) -> None:
    apt = emulated_machines.apt(part, "arm64")
    about = run(*apt, "apt-cache", "depends", "linux-image-arm64").split()
    package = next(
        word for word in about if word.startswith("linux-image-6") or word[12:13].isdigit()
    )
    command = [*apt, "apt-get", "-qq", "download", package, "busybox-static"]
    subprocess.run(command, cwd=part, check=True, timeout=600)
    for deb in part.glob("*.deb"):
        run("dpkg-deb", "-x", deb, part / ("kernel" if "linux-image" in deb.name else "busybox"))
    _download_wheels(part)
    version = package.removeprefix("linux-image-")
    _make_root(part, version)
    _make_ramdisk(part, version)
    ext4 = ("mke2fs", "-q", "-t", "ext4", "-E", "lazy_itable_init=1")
    run(*ext4, "-d", part / "root", part / "disk.img", DISK)
    shutil.copy(part / "kernel" / "boot" / f"vmlinuz-{version}", part / "vmlinuz")
    _make_tree(part / "tree.dtb")
    for rest in part.iterdir():
        if rest.name not in ("vmlinuz", "ramdisk", "tree.dtb", "disk.img"):
            shutil.rmtree(rest) if rest.is_dir() else rest.unlink()


def guest_lock() -> str:
    """The locked dependencies for the guest's Python and processor."""
    return run_here(
        f"from release import LOCK, locked; print(locked(LOCK.read_text(), '{GUEST_PYTHON}.2', "
        "'aarch64'))"
    )


def _make_root(part: Path, version: str) -> None:
    """Debian with the box's virtual environment, the agent and the modules of its kernel."""
    shutil.copy(part / emulated_machines.LOCK.name, part / "wheels")
    (part / "wheels").chmod(0o755)
    try_arm = subprocess.run(["arch-test", "arm64"], capture_output=True, timeout=600)
    here = [sys.executable, HERE / "arm.py"] if try_arm.returncode else []
    how = [f"--include={','.join(PACKAGES)}", "--architectures=arm64", "--variant=minbase"]
    how += [f"--dpkgopt=path-exclude=/usr/share/{what}/*" for what in ("man", "doc", "locale")]
    how += [f"--customize-hook={hook}" for hook in _hooks(part)]
    run(*here, "mmdebstrap", *how, "--format=directory", SUITE, part / "root")
    _modules(part / "kernel", part / "root", version, MODULES)


def _hooks(part: Path) -> tuple[str, ...]:
    """Commands by which mmdebstrap installs dependencies and agent; $1: the root."""
    pip = (
        "/opt/palpate/bin/pip install -q --disable-pip-version-check --no-index --find-links "
        "/wheels"
    )
    return (
        f"copy-in {part / 'wheels'} /",
        f"mkdir -p $1/opt/rig && cp {GUEST}/agent.py $1/opt/rig/ && cp {GUEST}/agent.service "
        "$1/etc/systemd/system/",
        'chroot "$1" python3 -m venv /opt/palpate',
        f'chroot "$1" {pip} --require-hashes -r /wheels/{emulated_machines.LOCK.name}',
        'rm -r "$1/wheels"; echo box > "$1/etc/hostname"; '
        'echo uninitialized > "$1/etc/machine-id"; : > "$1/etc/fstab"',
        'chroot "$1" systemctl enable agent.service serial-getty@ttyAMA0.service',
        'chroot "$1" systemctl mask apt-daily.timer apt-daily-upgrade.timer e2scrub_all.timer '
        "e2scrub_reap.service "
        "getty@tty1.service systemd-timesyncd.service systemd-binfmt.service",
        'chroot "$1" systemctl disable ssh.service systemd-networkd.service',
    )


def _modules(kernel: Path, root: Path, version: str, names: Iterable[str]) -> list[Path]:
    """Copy modules and what they need to a root; its files in order of loading."""
    source, target = kernel / "lib/modules" / version, root / "lib/modules" / version
    if not (source / "modules.dep").exists():
        run("depmod", "-b", kernel, version)
    found: dict[Path, None] = {}
    for name in names:
        command = ["modprobe", "-d", kernel, "-S", version, "--show-depends", name]
        listing = subprocess.run(command, capture_output=True, text=True, timeout=600).stdout
        loads = (line.split()[1] for line in listing.splitlines() if line.startswith("insmod"))
        found |= dict.fromkeys(map(Path, loads))
    for file in found:
        place = target / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, place)
    for file in source.glob("modules.*"):
        if file.name in ("modules.builtin", "modules.builtin.modinfo", "modules.order"):
            shutil.copy(file, target)
    run("depmod", "-b", root, version)
    return list(found)


def _make_ramdisk(part: Path, version: str) -> None:
    ramdisk = part / "ram"
    for folder in ("bin", "modules"):
        (ramdisk / folder).mkdir(parents=True)
    order = _modules(part / "kernel", part / "scrap", version, EARLY)
    for file in order:
        shutil.copy(file, ramdisk / "modules")
    (ramdisk / "order").write_text("".join(f"{file.name}\n" for file in order))
    shutil.copy(part / "busybox/bin/busybox", ramdisk / "bin")
    shutil.copy(GUEST / "init", ramdisk / "init")
    (ramdisk / "init").chmod(0o755)
    pack = f"find . | cpio -o -H newc --quiet | gzip -1 > {part / 'ramdisk'}"
    run("sh", "-c", f"cd {ramdisk} && {pack}")


def _make_tree(path: Path) -> None:
    """The machine's device tree, lines named, without a power button on one."""
    option, machine, *rest = MACHINE
    run("qemu-system-aarch64", option, f"{machine},dumpdtb={path}", *rest, "-display", "none")
    run("fdtput", "-r", path, "/gpio-keys")
    run("fdtput", "-t", "s", path, "/pl061@9030000", "gpio-line-names", *LINES)


def _make_box(part: Path, on: Path) -> None:
    from tests.rig.machine import Guest

    for name in ("code", "source"):
        (part / name).mkdir()
    code, source = part / "code", part / "source"
    emulated_machines.wheel(code, source)
    for folder in ("systemd", "firmware_config"):
        shutil.copytree(ROOT / folder, code / folder)
    for file in ("install.sh", "palpate.toml"):
        shutil.copy(GUEST / file, code)
    disk = layer(on, part)
    with Guest(Image(on, disk), part, code=code) as guest:
        guest.ready(180)
        guest.run("mkdir -p /code && mount -o ro /dev/vdb /code", check=True)
        guest.run("sh /code/install.sh /code", timeout_s=180, check=True)
        guest.serial.wait_for("$PPLP,STA,", 120)
        guest.run("umount /code && sync", check=True)
        guest.save()
    for rest in ("code", "source"):
        shutil.rmtree(part / rest)

"""Runs the classifier of the box on emulated processors and collects its outputs.

`python -m tests.rig.emulated_machines` makes an arm64 userland once, in
~/.cache/palpate/machines: unpacked packages of Debian and the wheels of
appliance/requirements.lock. qemu's user mode runs it, and it emulates older x86 processors. It
needs no root and changes nothing outside that folder. With two arguments, FROM TO, the module is
the program that runs on each machine, this machine included.
"""

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.factories.paths import ROOT, SOURCES

LOCK = ROOT / "appliance" / "requirements.lock"
HOME = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "palpate" / "machines"
MACHINES = {
    "x86, AVX2 without VNNI": ("x86_64", "Haswell"),
    "x86, SSE4 without AVX": ("x86_64", "Nehalem"),
    "Raspberry Pi 4": ("aarch64", "cortex-a72"),
    "Raspberry Pi 5": ("aarch64", "cortex-a76"),
    "Arm with all that qemu knows": ("aarch64", "max"),
}
"""Name: (architecture, name of the processor in qemu). The Pi 5 has 8-bit dot products; the Pi 4
does not.

qemu 7.2, Debian 12's, takes another register for xmm4 as the index of a gather of AVX2
(gitlab.com/qemu-project/qemu/-/issues/2474), and ends with signal 11; processors do not. numpy
gathers so for strided float32 in np.maximum and np.minimum, and for products of strided complex64.
"""
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
PACKAGES = (f"{PYTHON}-minimal", f"lib{PYTHON}-stdlib", "libstdc++6")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-q")
ARM_WHEELS = (
    "--no-deps",
    "--only-binary",
    ":all:",
    "--implementation",
    "cp",
    *(f"--platform=manylinux{tag}_aarch64" for tag in ("_2_28", "_2_27", "_2_17", "2014")),
)
CPUINFO = (
    "processor\t: 0\nFeatures\t: fp asimd\nCPU implementer\t: 0x41\n"
    "CPU architecture: 8\nCPU variant\t: 0x0\nCPU part\t: 0xd08\nCPU revision\t: 3\n"
)
"""Replaces /proc/cpuinfo. onnxruntime counts cores there and crashes on an x86's file. It asks the
kernel, here qemu, for the features of the processor.
"""


class Missing(Exception):
    """A requirement of an emulated machine is not installed."""


def folder() -> Path:
    """The folder of the arm64 userland. It depends on the lock file and on the Python version."""
    name = hashlib.sha256(LOCK.read_bytes() + PYTHON.encode()).hexdigest()[:16]
    return HOME / name


def qemu(kind: str) -> str:
    """The emulator of an architecture: this machine's, else that of `set_up`. Raises Missing."""
    for name in (f"qemu-{kind}-static", f"qemu-{kind}"):
        if found := shutil.which(
            name, path=f"{os.environ['PATH']}:{folder() / 'qemu' / 'usr' / 'bin'}"
        ):
            return found
    raise Missing(
        f"no qemu-{kind} here; apt-get install qemu-user-static, "
        "or run python -m tests.rig.emulated_machines"
    )


def command(name: str, *args: str | Path) -> tuple[list[str], dict[str, str]]:
    """Arguments and environment that run this file on a machine of MACHINES. Raises Missing."""
    kind, processor = MACHINES[name]
    if platform.machine() != "x86_64":
        raise Missing("other processors are compared with an x86")
    run = [qemu(kind), "-cpu", processor]
    # without the features of this processor
    kept = {name: v for name, v in os.environ.items() if not name.startswith("OPENBLAS_")}
    env = kept | {"PYTHONPATH": SOURCES, "OPENBLAS_NUM_THREADS": "1"}
    if kind == platform.machine():
        return [*run, sys.executable, __file__, *map(str, args)], env
    usr = folder() / "root" / "usr"
    if not usr.exists():
        raise Missing(
            "no arm64 userland here; run python -m tests.rig.emulated_machines "
            "(30 s, 300 MB in ~/.cache/palpate)"
        )
    env |= {"PYTHONPATH": f"{folder() / 'site'}:{SOURCES}", "PYTHONHOME": str(usr)}
    return [*run, "-L", str(usr.parent), str(usr / "bin" / PYTHON), __file__, *map(str, args)], env


def whole(target: Path, make: Callable[[Path], None]) -> Path:
    """Return the folder `target`; if it is missing, `make` fills an empty folder that takes its
    place.

    So it is complete or missing. Raises Missing with the output of the failed command.
    """
    if target.exists():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f"{target.name}.", suffix=".part", dir=target.parent))
    part.chmod(0o755)
    try:
        make(part)
        with suppress(OSError):  # another process was quicker
            part.rename(target)
    except subprocess.CalledProcessError as e:
        raise Missing(
            f"{' '.join(map(str, e.cmd))[:200]} failed: "
            f"{(e.stderr or e.stdout or '').strip()[-800:]}"
        ) from e
    except FileNotFoundError as e:
        raise Missing(f"no {e.filename} here: this needs Debian's tools") from e
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return target


def set_up() -> Path:
    """The folder of the arm64 userland, made if missing. Raises Missing if apt or pip fail."""
    return whole(folder(), _make)


def _make(part: Path) -> None:
    for made in ("root/proc", "root/sys/devices/system/cpu", "qemu"):
        (part / made).mkdir(parents=True)
    _unpack(part)
    _install(part / "site")
    (part / "root/proc/cpuinfo").write_text(CPUINFO)
    for file in ("possible", "present"):
        (part / "root/sys/devices/system/cpu" / file).write_text("0\n")
    for rest in ("lists", "archives"):
        shutil.rmtree(part / rest)
    for other in (part / "qemu/usr/bin").glob("*"):  # 20 MB each
        if "x86_64" not in other.name and "aarch64" not in other.name:
            other.unlink()


def _unpack(part: Path) -> None:
    """Unpack Debian's Python for arm64, qemu if this machine has none, and their dependencies."""
    mine = run("dpkg", "--print-architecture").strip()
    wanted = {"root": [f"{name}:arm64" for name in PACKAGES]}
    try:
        qemu("aarch64"), qemu("x86_64")
    except Missing:
        wanted["qemu"] = [f"qemu-user-static:{mine}"]
    with_apt = apt(part, "arm64", *([mine] if "qemu" in wanted else []))
    for where, names in wanted.items():
        how = ("-qq", "-y", "--download-only", "--no-install-recommends")
        run(*with_apt, "apt-get", "install", *how, *names)
        for package in (part / "archives").glob("*.deb"):
            run("dpkg-deb", "-x", package, part / where)
            package.unlink()


def apt(part: Path, *known: str) -> tuple[str, str]:
    """The start of a command of apt for these architectures.

    That apt treats no package as installed and keeps its files in `part`. This function fetches the
    lists; apt checks their signatures with this machine's keys.
    """
    for made in ("lists/partial", "archives/partial"):
        (part / made).mkdir(parents=True, exist_ok=True)
    (part / "status").write_bytes(b"")
    (part / "apt.conf").write_text(
        f'APT::Architecture "{known[0]}"; '
        f"APT::Architectures {{ {' '.join(f'{name};' for name in known)} }};\n"
        f'APT::Sandbox::User ""; Acquire::Languages "none";\n'
        f'Dir::State::Lists "{part}/lists"; Dir::State::Status "{part}/status"; '
        f'Dir::Cache "{part}";\n'
    )
    before = ("env", f"APT_CONFIG={part / 'apt.conf'}")
    run(*before, "apt-get", "-qq", "update")
    return before


def _install(site: Path) -> None:
    """Install the locked wheels for arm64."""
    run(*PIP, "install", *ARM_WHEELS, "--require-hashes", "-r", LOCK, "--target", site)


def wheel(out: Path, source: Path) -> None:
    """Build the box's wheel into `out`.

    source: an empty folder to build in. In the checkout, setuptools would add leftovers of older
    builds to the wheel and leave its own there.
    """
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(
        ROOT / "appliance", source / "appliance", ignore=shutil.ignore_patterns("__pycache__")
    )
    run(*PIP, "wheel", "--no-deps", "-w", out, source)


def wheels(out: Path, source: Path) -> tuple[Path, Path]:
    """Build the wheels of palpate and palpate-train, as `wheel` does; both."""
    wheel(out, source)
    shutil.copytree(ROOT / "train", source / "train", ignore=shutil.ignore_patterns("build"))
    run(*PIP, "wheel", "--no-deps", "-w", out, source / "train")
    box, train = sorted(out.glob("palpate*.whl"))
    return box, train


def run(*args: str | Path) -> str:
    """The output of a command. If it fails, its errors are in the exception."""
    return subprocess.run(args, check=True, capture_output=True, text=True, timeout=1800).stdout


def work(given: Path, target: Path) -> None:
    """Run the models in the folders of `given`, each with sweeps [n, T, R, C] in its sweeps.npy.

    The results are in one .npz: the logits of a bundle as NAME/golden and NAME/sweeps, its whole
    answers to both as NAME/answers (status, label, and the reason without its numbers), whether it
    passes its self test as NAME/sound, the outputs of a shown.onnx for the sweeps, one after
    another, as NAME/shown [n, ...].
    """
    import numpy as np

    from palpate.bundle import bundle
    from palpate.core import clock
    from palpate.core.errors import BundleError
    from palpate.core.types import Frames, Status, Sweep
    from palpate.inference import classifier, session

    outputs = {}
    for path in sorted(given.iterdir()):
        sweeps = np.load(path / "sweeps.npy")
        if (path / bundle.MANIFEST).exists():
            box = classifier.Classifier(bundle.load(path), clock.SystemClock())
            outputs[f"{path.name}/golden"] = np.stack(
                [box.logits(sweep) for sweep in box.bundle.golden]
            )
            outputs[f"{path.name}/sweeps"] = np.stack([box.logits(sweep) for sweep in sweeps])
            answers = []
            for sweep in (*box.bundle.golden, *sweeps):
                n = np.arange(len(sweep))
                said = box(Sweep(1, 0, 0, Status.OK, Frames(n, n, sweep)))
                answers.append(f"{said.status} {said.label} {re.sub('[0-9.]+', '', said.detail)}")
            outputs[f"{path.name}/answers"] = np.array(answers)
            try:
                sound = box.self_test() >= 0
            except BundleError:
                sound = False
            outputs[f"{path.name}/sound"] = np.array(sound)
        if (path / "shown.onnx").exists():
            shown = session.session((path / "shown.onnx").read_bytes())
            each = [shown.run(None, {shown.get_inputs()[0].name: sweep[None]}) for sweep in sweeps]
            outputs[f"{path.name}/shown"] = np.stack(
                [np.concatenate([x.ravel() for x in one]) for one in each]
            )
    np.savez(target, **outputs)


if __name__ == "__main__":
    if len(sys.argv) == 3:
        work(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        try:
            print(set_up())
        except Missing as e:
            sys.exit(str(e))

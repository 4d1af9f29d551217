"""The locks: whatever `make` installs is in one of them with its hashes, and all of them agree."""

import re
import tomllib
from collections.abc import Iterable, Iterator
from importlib import metadata

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.factories.paths import ROOT

LOCKS = {
    "appliance/requirements.lock": ("page", "mqtt", "opcua", "found"),
    "appliance/teach.lock": ("page", "mqtt", "opcua", "found", "teach"),
    "systemd/build.lock": (),
    "systemd/fleet.lock": ("deploy",),
    "train/desktop.lock": ("train", "reports"),
    "tests/tools.lock": ("dev", "train", "reports", "peers", "dask", "files"),
    "docs/site/site.lock": ("site",),
}
"""Each lock with the extras that it covers; "train" stands for the desktop's own distribution."""


def entries(lock: str) -> dict[str, list[str]]:
    """Names in a lock with their entries; several where systems differ."""
    found: dict[str, list[str]] = {}
    for entry in re.split(r"\n(?=[a-z])", (ROOT / lock).read_text()):
        found.setdefault(re.split("[=@ ;]", entry)[0], []).append(entry)
    return found


@pytest.mark.parametrize("lock", LOCKS)
def test_every_package_is_locked_with_hashes(lock: str):
    """Every requirement is in the lock of its environment, with one version and its hashes. PyTorch
    is left out, because its builds differ between machines."""

    def wanted(extras: Iterable[str]) -> Iterator[str]:
        """Names of the packages that the two distributions ask for in these extras."""
        asked: list[str] = []
        for file in ("pyproject.toml", "train/pyproject.toml"):
            project = tomllib.loads((ROOT / file).read_text())["project"]
            of_it = project["optional-dependencies"]
            asked += (
                project["dependencies"] if not file.startswith("train") or "train" in extras else []
            )
            asked += [each for extra in extras for each in of_it.get(extra, [])]
        for requirement in map(Requirement, asked):
            if requirement.name.startswith("palpate"):
                yield from wanted(requirement.extras)
            elif requirement.name != "torch":
                yield canonicalize_name(requirement.name)

    found = entries(lock)
    for name, of_it in found.items():
        for entry in of_it:
            assert "==" in entry.split("\n")[0], name
            assert "--hash=sha256:" in entry, name
    assert set(wanted(LOCKS[lock])) <= found.keys() or not LOCKS[lock]
    assert "torch" not in found


def test_all_locks_agree():
    """The same version everywhere: tests and desktop run on a box's versions."""
    versions: dict[str, set[tuple[str, ...]]] = {}
    for lock in LOCKS:
        for name, of_it in entries(lock).items():
            heads = (entry.split(" ")[0] for entry in of_it)
            versions.setdefault(name, set()).add(tuple(sorted(heads)))
    assert {name: found for name, found in versions.items() if len(found) > 1} == {}


def test_nothing_is_installed_without_a_hash():
    """Each line of the Makefile that installs asks for hashes, or installs this project without
    dependencies. PyTorch and the test of ROS 2 are the exceptions, as docs/security.md states."""
    lines = (ROOT / "Makefile").read_text().replace("\\\n", " ").splitlines()
    installs = [
        line.strip()
        for line in lines
        if line.startswith("\t") and re.search(r"\$\(INSTALL\)|\$\(PIP\)|pip install", line)
    ]
    assert [line for line in installs if "--no-deps" not in line] == [
        "$(INSTALL) --no-build-isolation -e train[stages,reports]",
        next(line for line in installs if line.startswith("build/ros/bin/python")),
    ]


def test_the_lock_covers_both_processors():
    """The binary packages have wheels for x86_64 and aarch64 among them."""
    found = entries("appliance/requirements.lock")
    for name in ("numpy", "onnxruntime", "gpiod"):
        assert found[name][0].count("--hash") >= 8, name


def test_tests_run_on_the_numpy_of_the_box():
    """Whatever else the desktop installs."""
    lock = (ROOT / "appliance" / "requirements.lock").read_text()
    assert re.findall(r"(?m)^numpy==(\S+)", lock) == [metadata.version("numpy")]


def test_the_least_onnxruntime_is_what_was_tried():
    """The page of processors says from which version on int8 sums were exact; no older one is
    admitted."""
    page = " ".join((ROOT / "docs" / "reference" / "processors.md").read_text().split())
    wrong, exact = re.findall(
        r"onnxruntime ([\d.]+ to [\d.]+) gives .*?; ([\d.]+) and later", page
    )[0]
    (least,) = [
        asked.specifier
        for file in ("pyproject.toml", "train/pyproject.toml")
        for asked in map(
            Requirement, tomllib.loads((ROOT / file).read_text())["project"]["dependencies"]
        )
        if asked.name == "onnxruntime"
    ]
    assert least.contains(exact)
    assert not any(map(least.contains, [*wrong.split(" to "), "1.26.99"]))

"""The list of all that the box carries is complete; the page has its special licences."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

sys.path.insert(0, str(ROOT / "systemd"))
sbom = pytest.importorskip("sbom")


def test_each_package_of_the_lock_has_version_licence_and_hashes():
    """Nothing of the lock is left out."""
    lock = sbom.LOCK.read_text()
    found = sbom.components(lock)
    assert [c["name"] for c in found] == re.findall(r"(?m)^([a-z0-9-]+)==", lock)
    assert all(c["licenses"][0]["license"]["name"] and c["properties"] for c in found)
    assert sum(len(c["properties"]) for c in found) == lock.count("--hash=sha256:")


def test_the_page_has_every_licence_that_is_not_permissive():
    """A reader learns of each LGPL, GPL, EPL or MPL package without the list itself."""
    page = (ROOT / "docs" / "reference" / "specifications.md").read_text()
    found = {
        c["name"]: c["licenses"][0]["license"]["name"]
        for c in sbom.components(sbom.LOCK.read_text())
    }
    named = [
        n
        for n, licence in found.items()
        if re.search("GPL|General Public|EPL|MPL|Mozilla", licence)
    ]
    assert len(named) >= 3
    assert [name for name in named if name not in page] == []


def test_the_command_writes_it(tmp_path: Path):
    """A valid document with Debian's part."""
    target = tmp_path / "dist" / "box.json"
    command = [sys.executable, ROOT / "systemd" / "sbom.py", target]
    subprocess.run(command, check=True, env={"PYTHONPATH": str(ROOT)}, timeout=120)
    content = json.loads(target.read_text())
    assert (content["bomFormat"], content["specVersion"]) == ("CycloneDX", "1.5")
    assert {"numpy", "libusb-1.0-0"} <= {c["name"] for c in content["components"]}

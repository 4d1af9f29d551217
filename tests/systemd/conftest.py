"""Fixtures of the tests under a real systemd: the machine, the box on it, and its service.

The skin is simulated, in real time. PALPATE_SYSTEMD=1 makes the container (see nspawn.py) and fails
without it. Otherwise tests are skipped without a container. Tests that install on hosts in
containers are thorough: the first install takes minutes.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.rig.emulated_machines import Missing
from tests.systemd import nspawn


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test that uses the hosts."""
    for item in items:
        here = item.path.parent == Path(__file__).parent
        if here and "site" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.thorough)


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[nspawn.Machine]:
    """A machine that has booted, with the locked dependencies and nothing else of the box."""
    insist = os.environ.get("PALPATE_SYSTEMD") == "1"
    parcel, folder = tmp_path_factory.mktemp("parcel"), tmp_path_factory.mktemp("machine")
    try:
        nspawn.check()
        if not insist and not nspawn.folder().exists():
            raise Missing(
                "no Debian for a container here; run python -m tests.systemd.nspawn "
                "(90 s, 370 MB in ~/.cache/palpate)"
            )
        nspawn.pack(parcel, tmp_path_factory.mktemp("source"))
        booted = nspawn.Machine(nspawn.set_up(), parcel, folder / "nspawn.log")
    except Missing as e:
        if insist:
            raise
        pytest.skip(str(e))
    with booted:
        yield booted


@pytest.fixture(scope="session")
def before(machine: nspawn.Machine) -> list[bool]:
    """Install the box. Yields whether its user and folders were there before."""
    tests = (("id", "palpate"), ("test", "-e", "/etc/palpate"), ("test", "-e", "/var/lib/palpate"))
    there = [machine.run(*one).returncode == 0 for one in tests]
    machine.install()
    machine.put("/opt/palpate/cable.py", nspawn.CABLE)
    return there


@pytest.fixture
def service(machine: nspawn.Machine, before: list[bool]) -> Iterator[nspawn.Service]:
    """The installed service, stopped; afterwards stopped, with its packaged settings."""
    yield nspawn.Service(machine)
    machine.run(
        "rm", "-rf", "/run/systemd/system/palpate.service.d", nspawn.SITE, "/run/skin", "/run/hang"
    )
    machine.get("systemctl", "daemon-reload")
    machine.get("systemctl", "stop", "palpate")
    machine.run("systemctl", "reset-failed", "palpate")

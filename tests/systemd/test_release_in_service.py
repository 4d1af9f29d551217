"""A new release under a real systemd that cannot be started, or dies: the old release runs again
without a desktop."""

import json
from collections.abc import Iterator

import pytest

from tests.systemd.nspawn import NOBODY, PALPATE, SIM, STREAMS, Machine, Service

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # systemd in a container

NEW, OLD = "palpate-2-new", "palpate-1-old"
FAST = "RestartSec=100ms"
ACTIVATE = ("-I", "-m", "palpate.deployment.releases", "activate")
BROKEN = {
    "no import": "raise ImportError('a library is missing')",
    "dies": (
        "import os, signal, threading\n"
        "threading.Timer(4, lambda: os.kill(os.getpid(), signal.SIGSEGV)).start()"
    ),
}
"""Lines at the end of the new release's commands."""
WORSE = """
_outputs = Classifier.outputs
Classifier.outputs = lambda self, x, *names: _outputs(
    self, np.clip(x * 1.05, 0, 255).astype(x.dtype), *names
)
"""
"""Lines at the end of a new release's classifier: counts are read 5 % too high. In the simulator
that costs 4 points at places that nobody trained; its golden sweeps pass."""


@pytest.fixture
def releases(machine: Machine, service: Service) -> Iterator[Machine]:
    """The installed box with two releases, the new release on trial; afterwards as it was."""
    for command in (
        f"mv /opt/palpate /opt/{OLD}; ln -s {OLD} /opt/palpate; cp -a /opt/{OLD} /opt/{NEW}",
        f"/opt/{OLD}/bin/python {' '.join(ACTIVATE)} {NEW}",
    ):
        machine.get("sh", "-euc", command)
    yield machine
    machine.get("systemctl", "stop", "palpate")
    back = f"rm -rf /opt/palpate /opt/palpate.* /opt/{NEW}; mv /opt/{OLD} /opt/palpate"
    machine.get("sh", "-euc", back)
    machine.get("systemctl", "daemon-reload")


def append(machine: Machine, module: str, lines: str) -> None:
    """Put lines at the end of a module of the new release."""
    file = f"/opt/{NEW}/lib/python3.11/site-packages/palpate/{module}.py"
    machine.get("sh", "-euc", f"cat >> {file}", say=f"\n{lines}\n")


def release(machine: Machine) -> str:
    """The release that runs from the next start on."""
    return machine.get("readlink", "/opt/palpate")


def test_a_release_that_works_stays(releases: Machine, service: Service):
    """Its trial is shown, and three restarts do not count against it."""
    for _ in range(4):
        service.start()
        service.until("StatusText", STREAMS)
        assert service.status()["release"].startswith("on trial")
        releases.get("systemctl", "stop", "palpate")
    assert release(releases) == NEW
    held = json.loads(releases.get("cat", "/opt/palpate.trial"))
    assert (held["start"], held["standing"]["starts"]) == (4, 1)


@pytest.mark.parametrize("what", BROKEN)
def test_a_release_that_does_not_work_goes_back(releases: Machine, service: Service, what: str):
    """It cannot be imported, or a segmentation fault ends it while it classifies. The release
    before runs again by itself, and `palpate status` says why."""
    append(releases, "cli/run_command", BROKEN[what])
    service.configure(f"ExecStart=\nExecStart={PALPATE} run --sim skin\n{FAST}")
    releases.get("systemctl", "start", "--no-block", "palpate")
    releases.until(f'[ "$(readlink /opt/palpate)" = {OLD} ]')
    service.until("StatusText", STREAMS)
    assert service["ActiveState"] == "active"
    told = releases.run(*NOBODY, PALPATE, "status").stdout
    assert f"{NEW} was sent back" in told
    assert ("SEGV" in told) == (what == "dies")
    assert service["NRestarts"] == ("1" if what == "dies" else "3")
    again = releases.run(f"/opt/{NEW}/bin/python", *ACTIVATE, NEW)
    assert again.returncode == 78
    assert release(releases) == OLD


def test_a_release_that_answers_worse_goes_back_within_fifty_sweeps(
    releases: Machine, service: Service
):
    """While it works: the proven release answers its sweeps again in between."""
    append(releases, "inference/classifier", WORSE)
    service.configure(f"{SIM}{FAST}")
    releases.get("systemctl", "start", "--no-block", "palpate")
    releases.until(f'[ "$(readlink /opt/palpate)" = {OLD} ]')
    answered = [line for line in service.log_lines() if line.startswith("sweep ")]
    service.until("StatusText", STREAMS)
    assert 10 <= len(answered) <= 50
    told = releases.run(*NOBODY, PALPATE, "status").stdout
    assert f"{NEW} was sent back" in told
    assert "otherwise" in told

"""A new bundle (B after A) under a real systemd: its trial, and a candidate's shadow."""

import base64
import hashlib
import io
import itertools
import json
import tarfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.factories import deliveries
from tests.systemd.nspawn import CABLED, PALPATE, SITE, STREAMS, WAIT_S, Machine, Service

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # systemd in a container

CURSED = """
import os, signal, sys, time
from palpate.__main__ import main
from palpate.sim import usb
class Cursed(usb.RigBackend):
    # a second and a half after it has begun, while the current bundle is that in /run/cursed: do
    # what stands there
    begin = time.monotonic()
    def _touch(self, what=""):
        super()._touch(what)
        if time.monotonic() > self.begin + 1.5 and os.path.exists("/run/cursed"):
            sha, does = open("/run/cursed").read().split()
            if os.readlink("/var/lib/palpate/current").endswith(sha):
                os.kill(os.getpid(), signal.SIGSEGV) if does == "die" else time.sleep(60)
usb.RigBackend = Cursed
sys.exit(main())
"""
RUN = (
    "ExecStart=\nExecStart=/opt/palpate/bin/python /opt/palpate/cursed.py run --sim skin "
    "--shadow\nRestartSec=100ms\n"
)
REAL = "ExecStart=\nExecStart=/opt/palpate/bin/palpate run\nRestartSec=100ms\n"
AS_PALPATE = ("setpriv", "--reuid=palpate", "--regid=palpate", "--init-groups", PALPATE)
HANG = "WatchdogSec=5\nTimeoutStartSec=20\nTimeoutStopSec=2\n"
"""On a busy machine a program may hang before it is READY: the start times out then."""
LEFT = "has failed its trial, and "


class DeliveredStore:
    """The store, for a person who deploys. a: sha256 of bundle A's manifest."""

    def __init__(self, machine: Machine, folder: Path) -> None:
        self.machine, self._folder, self._counters = machine, folder, itertools.count(1)
        self._key = deliveries.key(folder / "keys")
        machine.put("/etc/palpate/allowed_signers", deliveries.line(self._key))
        machine.put("/opt/palpate/cursed.py", CURSED)
        self.a = self.deploy()
        self.do("commit")

    def do(self, *command: str) -> str:
        """`palpate bundles`, as its user."""
        return self.machine.get(*AS_PALPATE, "bundles", *command)

    def deploy(self, *options: str, **changes: Any) -> str:
        """Copy bundle A with changes to its manifest there and install it; its sha256."""
        counter = next(self._counters)
        held = deliveries.files(counter, self._key, **changes)
        made = deliveries.put(self._folder / f"b{counter}", held)
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w") as tar:
            tar.add(made, arcname=made.name)
        unpack = "base64 -d | tar -x -C /var/lib/palpate/incoming"
        self.machine.get("sh", "-c", unpack, say=base64.b64encode(packed.getvalue()).decode())
        self.do("install", *options, f"/var/lib/palpate/incoming/{made.name}")
        return hashlib.sha256((made / "manifest.json").read_bytes()).hexdigest()

    def alter(self, sha: str) -> None:
        """Change a byte of the model of an installed bundle."""
        model = f"/var/lib/palpate/bundles/{sha}/model.onnx"
        write = f"printf X | dd of={model} bs=1 seek=5000 conv=notrunc"
        self.machine.get("sh", "-c", f"chmod u+w {model}; {write}")

    @property
    def current(self) -> str:
        """The bundle that runs from the next start on."""
        return Path(self.machine.get("readlink", "/var/lib/palpate/current")).name

    @property
    def ledger(self) -> dict[str, Any]:
        """The content of bundles.json, the records of the box's bundles."""
        return dict(json.loads(self.machine.get("cat", "/var/lib/palpate/bundles.json")))

    def starts(self, sha: str) -> int:
        """How many starts count against a bundle."""
        return int(self.ledger["standings"][sha]["starts"])


@pytest.fixture(scope="module")
def stored(
    machine: Machine, before: list[bool], tmp_path_factory: pytest.TempPathFactory
) -> DeliveredStore:
    """The store with bundle A committed."""
    return DeliveredStore(machine, tmp_path_factory.mktemp("bundles"))


@pytest.fixture
def store(stored: DeliveredStore, service: Service) -> Iterator[DeliveredStore]:
    """The same store, which goes back to A after the test."""
    yield stored
    stored.machine.get("systemctl", "stop", "palpate")
    stored.machine.run("rm", "-f", "/run/cursed")
    if stored.current != stored.a:
        stored.do("rollback")
    assert stored.current == stored.a


def serves(service: Service, sha: str) -> None:
    """Wait until the skin streams and this bundle answers."""
    service.until("ActiveState", "active")
    service.until("StatusText", STREAMS)
    wait_for(lambda: service.status().get("bundle") == sha[:8], service)


def test_a_bundle_that_does_its_work_is_committed(
    machine: Machine, service: Service, store: DeliveredStore
):
    """On trial at first, as `palpate status` shows; committed after its sweeps."""
    new = store.deploy()
    machine.put(SITE, "[store]\ntrial_sweeps = 1\n")
    service.start(RUN)
    serves(service, new)
    wait_for(lambda: store.ledger["standings"][new]["committed"], service)
    assert store.starts(new) == 0
    lines = [line for line in service.log_lines() if line.startswith("bundle ")]
    assert lines == [
        f"bundle {new[:8]} is on trial, start 1 of 3",
        f"bundle {new[:8]} has passed its trial and is committed",
    ]
    machine.get("systemctl", "restart", "palpate")
    serves(service, new)
    store.do("rollback")


@pytest.mark.parametrize(("does", "more"), [("die", ""), ("hang", HANG)])
def test_a_bundle_with_which_the_program_dies_or_hangs_is_left(
    machine: Machine, service: Service, store: DeliveredStore, does: str, more: str
):
    """READY, then it fails or hangs: after three starts A serves again."""
    new = store.deploy()
    machine.put("/run/cursed", f"{new} {does}")
    begin = time.monotonic()
    service.configure(RUN + more)
    machine.get("systemctl", "start", "--no-block", "palpate")
    service.until("NRestarts", "3")
    serves(service, store.a)
    print(f"{does}: A serves again after {time.monotonic() - begin:.1f} s")
    assert store.current == store.a
    *starts, left = [line for line in service.log_lines() if line.startswith(f"bundle {new[:8]} ")]
    assert starts == [f"bundle {new[:8]} is on trial, start {i} of 3" for i in (1, 2, 3)]
    assert LEFT in left
    assert left.endswith("it was started 3 times without being committed")
    assert "started 3 times" in store.do("list")


def test_a_bundle_that_fails_its_checks_at_the_start_is_left_in_that_start(
    machine: Machine, service: Service, store: DeliveredStore
):
    """Altered on the card after it was installed: A serves in the same start, without a restart."""
    new = store.deploy()
    store.alter(new)
    service.start(RUN)
    serves(service, store.a)
    assert (service["NRestarts"], store.current) == ("0", store.a)
    lines = [line for line in service.log_lines() if LEFT in line]
    assert len(lines) == 1
    assert "model.onnx was altered" in lines[0]


def test_a_bundle_that_does_not_fit_the_settings_is_left(
    machine: Machine, service: Service, store: DeliveredStore
):
    """The new bundle does not fit the settings and A does: A serves in the same start."""
    new = store.deploy(early=None)
    machine.put(SITE, "[classifier]\nearly = true\n")
    service.start(RUN)
    serves(service, store.a)
    assert (service["NRestarts"], store.current) == ("0", store.a)
    assert any(
        f"bundle {new[:8]} {LEFT}" in line and "classifier.early" in line
        for line in service.log_lines()
    )


def test_a_committed_bundle_that_is_altered_ends_it_and_rollback_mends(
    machine: Machine, service: Service, store: DeliveredStore
):
    """Exit 78 and the remedy; after `palpate bundles rollback` A serves."""
    new = store.deploy()
    store.do("commit")
    store.alter(new)
    service.configure(RUN)
    machine.run("systemctl", "start", "palpate")
    service.until("ActiveState", "failed")
    assert (service["ExecMainStatus"], service["NRestarts"]) == ("78", "0")
    assert any(
        "model.onnx was altered" in line and "bundles rollback" in line
        for line in service.log_lines()
    )
    store.do("rollback")
    service.start(RUN)
    serves(service, store.a)


@pytest.mark.parametrize(
    "end", ["stopped in order", "killed without a skin", "without a GPIO chip"]
)
def test_what_is_not_the_bundle_s_doing_leaves_it_on_trial(
    machine: Machine, service: Service, store: DeliveredStore, end: str
):
    """Four restarts, kills without a skin, or ends with 69: still its first start."""
    new = store.deploy()
    if end == "without a GPIO chip":
        machine.put(SITE, "[trigger]\nstart = 'GPIO17'\nstop = 'GPIO27'\n")
        service.configure(REAL)
        machine.get("systemctl", "start", "--no-block", "palpate")
        service.until("NRestarts", "[4-9]")
        assert any("no /dev/gpiochip" in line for line in service.log_lines())
        machine.get("systemctl", "stop", "palpate")
    elif end == "stopped in order":
        for _ in range(4):
            service.start(RUN)
            serves(service, new)
            machine.get("systemctl", "stop", "palpate")
    else:
        service.configure(CABLED + "RestartSec=100ms")
        machine.get("systemctl", "start", "--no-block", "palpate")
        for i in range(4):
            service.until("StatusText", "skin absent.*")
            wait_for(lambda: store.starts(new) == 0, service)
            service.kill("SIGKILL")
            service.until("NRestarts", str(i + 1))
        wait_for(lambda: store.starts(new) == 0, service)
    assert (store.current, store.starts(new)) == (new, 0)
    assert not [line for line in service.log_lines() if LEFT in line]


def wait_for(done: Callable[[], bool], service: Service) -> None:
    """Wait for a condition that usually takes a second or two."""
    end = time.monotonic() + WAIT_S
    while not done():
        assert time.monotonic() < end, service.journal()
        time.sleep(0.1)


def test_a_candidate_classifies_beside_and_becomes_the_one(
    machine: Machine, service: Service, store: DeliveredStore
):
    """In the shadow, shown; promoted on trial."""
    new = store.deploy("--shadow")
    assert store.current == store.a
    service.start(RUN)
    serves(service, store.a)
    wait_for(lambda: "on 1 of 1 sweeps" in service.status().get("shadow", ""), service)
    machine.get("systemctl", "restart", "palpate")  # the counts go on
    wait_for(lambda: "on 2 of 2 sweeps" in service.status().get("shadow", ""), service)
    machine.get("systemctl", "stop", "palpate")
    assert f"candidate {new[:8]} agrees with {store.a[:8]} on " in store.do("list")
    store.do("promote")
    service.start(RUN)
    serves(service, new)
    assert service.status()["shadow"] == ""

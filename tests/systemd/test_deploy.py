"""Installing and delivering to real hosts: containers with systemd and sshd, reached as a bare user
(see hosts.py).

The skin is simulated. That takes minutes, so it runs only with PALPATE_SYSTEMD=1, which also makes
the containers.
"""

import hashlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from threading import Thread

import pytest

from tests.factories import deliveries, emulated_machines, hosts
from tests.factories.install_scripts import SCRIPTS, require_pyinfra, run_here
from tests.factories.nspawn import CABLE, CABLED, PALPATE, SIM, WAIT_S
from tests.factories.paths import ROOT

require_pyinfra()


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    emulated_machines.wheel(
        folder := tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source")
    )
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hosts.Hosts]:
    """Two bare hosts, and a desktop that may log in there; the second host stays bare."""
    if os.environ.get("PALPATE_SYSTEMD") != "1":
        pytest.skip("installs on real hosts take minutes; run python -m tests.campaigns systemd")
    with hosts.Hosts(2, tmp_path_factory.mktemp("hosts") / "work", "bare") as made:
        yield made


@pytest.fixture(scope="session")
def installed(site: hosts.Hosts, wheel: Path) -> str:
    """Installs the first host over loopback, as a user without a profile; the output of that."""
    (site.work / "signers").write_text(deliveries.line(deliveries.key(site.work / "keys")))
    words = ("--host", f"{hosts.USER}@127.0.0.1", "--wheel", wheel, "--board", "rpi5")
    signers = ("--signers", site.work / "signers")
    done = site.desktop("install", *words, *signers, inside=site.hosts[0])
    assert done.returncode == 0, done.stdout + done.stderr
    # reported, not changed silently
    assert "No host key for 127.0.0.1 found in known_hosts, accepting" in done.stderr
    return done.stdout


@pytest.fixture
def host(site: hosts.Hosts, installed: str) -> hosts.Host:
    """The installed host."""
    return site.hosts[0]


@pytest.fixture
def at(host: hosts.Host) -> tuple[str, str]:
    """The options that name this host."""
    return ("--host", f"{hosts.USER}@{host.address}:22")


def changed(wheel: Path, folder: Path, name: str, text: str) -> Path:
    """Another release: the wheel with a new file, or with more text at the end of one."""
    made = folder / wheel.name
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(made, "w") as new:
        texts = {member: old.read(member) for member in old.namelist()}
        texts[name] = texts.get(name, b"") + text.encode()
        for member, content in texts.items():
            new.writestr(member, content)
    return made


def release(host: hosts.Host) -> str:
    """The release that the link leads to."""
    return host.machine.get("readlink", "/opt/palpate")


def start_again(host: hosts.Host) -> None:
    """As after a power cut: systemd starts the release on the disk."""
    if host.service["MainPID"] != "0":
        kill = ("systemctl", "kill", "--kill-whom=main", "--signal=SIGKILL", "palpate")
        done = host.machine.run(*kill)  # the delivery may just have stopped the process
        assert done.returncode == 0 or "No main process" in done.stderr, done.stderr
    host.machine.get("systemctl", "daemon-reload")
    host.machine.get("systemctl", "--no-block", "restart", "palpate")
    host.service.until("ActiveState", "active")


def test_a_bare_host_is_installed_as_a_bare_user(host: hosts.Host, installed: str):
    """From a Debian without Python to an active service with the board's name."""
    assert re.fullmatch(r"robot@127\.0\.0\.1: \S+ is READY [0-9.]+ s .*\n", installed)
    assert (host.service["ActiveState"], host.service["UnitFileState"]) == ("active", "enabled")
    name = release(host)
    assert host.machine.get("cat", "/opt/palpate/stamp") == name
    assert name in host.machine.get("cat", f"/proc/{host.service['MainPID']}/maps")
    assert host.machine.get("cat", "/etc/palpate/palpate.toml") == 'board = "rpi5"'
    settings = host.machine.get("/usr/local/bin/palpate", "check", "--settings")
    assert settings.count("# board-rpi5.toml") > 3
    assert host.machine.get("stat", "-c", "%U %a", "/etc/palpate/allowed_signers") == "root 644"
    assert host.machine.run("systemd-analyze", "verify", "palpate.service").stderr == ""
    files = [f"/etc/palpate/watch/{one}" for one in ("token", "key.pem", "certificate.pem")]
    owners = host.machine.get("stat", "-c", "%U:%G %a", *files).splitlines()
    assert set(owners) == {"root:palpate-watch 640"}
    off = ("palpate-watch", "palpate-bridge@tcp", "palpate-bridge@modbus")
    enabled = host.machine.run("systemctl", "is-enabled", *off).stdout.split()
    assert enabled == ["linked", "disabled", "disabled"]
    assert host.machine.get("find", f"/home/{hosts.USER}", "-name", ".palpate*") == ""


def test_a_second_install_changes_nothing(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], wheel: Path
):
    """The same command again: the process goes on, settings and signers stay."""
    pid, name = host.service["MainPID"], release(host)
    done = site.desktop(
        "install", *at, "--wheel", wheel, "--board", "rpi5", "--signers", site.work / "signers"
    )
    assert done.returncode == 0
    assert done.stdout.endswith(f"{name.removeprefix('palpate-')} runs already\n")
    assert (host.service["MainPID"], release(host)) == (pid, name)
    assert host.machine.get("cat", "/etc/palpate/palpate.toml") == 'board = "rpi5"'


def test_the_board_that_is_named_last_holds(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], wheel: Path
):
    """It replaces a wrong board, other settings stay, and the service starts with it."""
    file, pid = "/etc/palpate/palpate.toml", host.service["MainPID"]
    host.machine.put(file, 'board = "rpi9"\n# mine\n')
    done = site.desktop("install", *at, "--wheel", wheel, "--board", "rpi5")
    assert done.returncode == 0, done.stdout
    assert f'board = "rpi5" stands in {file} now' in done.stderr
    assert host.machine.get("cat", file) == 'board = "rpi5"\n# mine'
    assert host.service["MainPID"] != pid
    host.machine.put(file, 'board = "rpi5"\n')


@pytest.mark.slow
def test_a_board_without_a_file_is_refused_before_any_box_is_asked():
    """The error lists the existing boards."""
    words = ("--host", "robot@127.0.0.1:1", "--wheel", __file__, "--board", "rpi9")
    command = [sys.executable, SCRIPTS / "install.py", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (1, "")
    assert "board-rpi9.toml" in done.stderr
    assert "rpi4, rpi5" in done.stderr


def test_signers_are_never_overwritten(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], wheel: Path, tmp_path: Path
):
    """Another signers' file is refused with a reason; the box keeps its own."""
    (tmp_path / "others").write_text(deliveries.line(deliveries.key(tmp_path)))
    before = host.machine.get("cat", "/etc/palpate/allowed_signers")
    done = site.desktop("install", *at, "--wheel", wheel, "--signers", tmp_path / "others")
    assert done.returncode == 1
    assert "/etc/palpate/allowed_signers differs" in done.stdout
    assert host.machine.get("cat", "/etc/palpate/allowed_signers") == before


def test_a_box_without_packages_and_mirror_is_refused(site: hosts.Hosts, wheel: Path):
    """Nothing is changed there before the packages can be installed."""
    machine = site.hosts[1].machine
    machine.get("find", "/var/cache/apt/archives", "-name", "*.deb", "-delete")
    at = ("--host", f"{hosts.USER}@{site.hosts[1].address}")
    done = site.desktop("install", *at, "--wheel", wheel)
    assert done.returncode == 1
    assert "FAILED: python3-venv libusb-1.0-0 openssl " in done.stdout
    assert "Debian's mirrors" in done.stdout
    assert machine.get("ls", "/opt") == ""


def test_what_a_person_put_there_stays(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], wheel: Path
):
    """Their settings are kept; a file in the way ends it before anything else."""
    settings, program = "/etc/palpate/skin.toml", "/usr/local/bin/palpate"
    pid = host.service["MainPID"]
    for path in (settings, program):
        host.machine.get("rm", path)
        host.machine.put(path, "# mine\n")
    done = site.desktop("install", *at, "--wheel", wheel)
    assert done.returncode == 1
    assert f"{program} is a file there" in done.stdout
    host.machine.get("rm", program)
    done = site.desktop("install", *at, "--wheel", wheel)
    assert done.returncode == 0
    assert f"{settings} stays as it is there" in done.stderr
    assert host.machine.get("cat", settings) == "# mine"
    assert host.service["MainPID"] == pid
    host.machine.get("rm", settings)


@pytest.fixture(scope="session")
def upgraded(
    site: hosts.Hosts, installed: str, wheel: Path, tmp_path_factory: pytest.TempPathFactory
) -> list[tuple[str, str]]:
    """Installs two more releases on the host; each with the output of the command."""
    folder, outputs = tmp_path_factory.mktemp("releases"), [(release(site.hosts[0]), installed)]
    at = ("--host", f"{hosts.USER}@{site.hosts[0].address}")
    for i in range(2):
        other = changed(wheel, folder, "palpate/more.py", f"# {i}\n")
        done = site.desktop("install", *at, "--wheel", other)
        outputs.append((release(site.hosts[0]), done.stdout + done.stderr))
    return outputs


def test_an_upgrade_swaps_everything_at_once(host: hosts.Host, upgraded: list[tuple[str, str]]):
    """Another release runs; the previous release is kept, older releases are removed."""
    releases = [name for name, _ in upgraded]
    assert len({*releases}) == 3
    for _, output in upgraded[1:]:
        assert re.search(r"is READY [0-9.]+ s .*, [0-9.]+ s without", output), output
    there = host.machine.get("sh", "-c", "ls -d /opt/palpate-*").split()
    assert there == sorted(f"/opt/{name}" for name in releases[1:])
    assert host.machine.get("readlink", "/opt/palpate.previous") == releases[1]


def test_a_release_that_does_not_start_gives_way_to_the_old_one(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], wheel: Path, tmp_path: Path
):
    """Self-test passed, no start: the link is swapped back, the old one classifies."""
    before = release(host)
    broken = changed(wheel, tmp_path, "palpate/service/systemd.py", "\nNotifier.turn = None\n")
    done = site.desktop("install", *at, "--wheel", broken)
    assert done.returncode == 1
    assert "TypeError: 'NoneType' object is not callable" in done.stdout
    assert done.stdout.endswith(f"; so {before} runs again\n")
    assert (release(host), host.service["ActiveState"]) == (before, "active")


def test_a_release_that_fails_its_self_test_is_never_swapped_in(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], wheel: Path, tmp_path: Path
):
    """The process that classifies is not touched."""
    before, pid = release(host), host.service["MainPID"]
    fails = "\nraise OSError('not on this box')\n"
    broken = changed(wheel, tmp_path, "palpate/inference/classifier.py", fails)
    done = site.desktop("install", *at, "--wheel", broken)
    assert done.returncode == 1
    assert "FAILED: self-test: OSError: not on this box" in done.stdout
    assert (release(host), host.service["MainPID"]) == (before, pid)


@pytest.mark.parametrize(
    ("said", "after_s"), [("copying", 0.3), ("building", 0.5), ("building", 4.0)]
)
def test_an_install_that_is_cut_is_finished_by_the_next(
    site: hosts.Hosts,
    host: hosts.Host,
    at: tuple[str, str],
    wheel: Path,
    tmp_path: Path,
    said: str,
    after_s: float,
):
    """Cut during the copy or the build: the old release starts, a second call ends it."""
    new = changed(wheel, tmp_path, "palpate/more.py", f"# {said} {after_s}\n")
    before = release(host)
    site.cut("install", *at, "--wheel", new, words=said, after_s=after_s)
    assert release(host) == before
    start_again(host)
    done = site.desktop("install", *at, "--wheel", new)
    assert done.returncode == 0, done.stdout + done.stderr
    assert release(host) != before
    assert host.service["ActiveState"] == "active"


def test_a_swap_that_is_cut_leaves_old_or_new(host: hosts.Host, upgraded: list[tuple[str, str]]):
    """Dead before the N-th command, for each N: one release or the other, complete."""
    new, old = release(host), host.machine.get("readlink", "/opt/palpate.previous")
    script = run_here(f"import install; print(install.swap('/opt/{old}', '{new}'))")
    found = []
    for n in range(1, 20):
        cut = f"n=0; trap 'n=$((n+1)); [ $n -lt {n} ] || kill -KILL $$' DEBUG\n{script}"
        ended = host.machine.run("bash", "-c", cut).returncode
        found.append(release(host))
        start_again(host)
        assert found[-1] in host.machine.get("cat", f"/proc/{host.service['MainPID']}/maps")
        if ended == 0:
            break
    assert (found[0], found[-1]) == (new, old)
    assert len(found) > 5
    assert {*found} == {new, old}


class Sender:
    """Makes signed bundles, each with a higher counter than the last."""

    def __init__(self, folder: Path, key: Path) -> None:
        self.folder, self.key, self.counter = folder, key, 0

    def made(self, counter: int = 0, key: Path | None = None) -> Path:
        """A bundle's folder."""
        self.counter += not counter
        folder = self.folder / f"{len([*self.folder.glob('*')])}"
        return deliveries.put(folder, deliveries.files(counter or self.counter, key or self.key))


@pytest.fixture(scope="session")
def sender(site: hosts.Hosts, installed: str, tmp_path_factory: pytest.TempPathFactory) -> Sender:
    """A sender whose key the host trusts."""
    return Sender(tmp_path_factory.mktemp("bundles"), site.work / "keys" / "key")


def sha(folder: Path) -> str:
    """The sha256 of a bundle's manifest."""
    return hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest()


def listed(host: hosts.Host) -> dict[str, str]:
    """The roles of the box's bundles by sha256."""
    who = ("setpriv", "--reuid=palpate", "--regid=palpate", "--clear-groups")
    output = host.machine.get(*who, PALPATE, "bundles", "--json")
    return {entry["sha"]: entry["role"] for entry in json.loads(output)}


def serves(host: hosts.Host) -> str:
    """The id of the bundle that runs."""
    end_s = time.monotonic() + WAIT_S
    while (done := host.machine.run("cat", "/run/palpate/status.json")).returncode:
        assert time.monotonic() < end_s, done.stderr
        time.sleep(0.1)
    return json.loads(done.stdout)["bundle"]


def test_a_bundle_is_delivered_and_runs_on_trial(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], sender: Sender, tmp_path: Path
):
    """READY and on trial, no files left behind; a second delivery changes nothing."""
    bundle = sender.made()
    more = ("--signers", site.work / "signers", "--json", tmp_path / "report.json")
    done = site.desktop("deploy", *at, bundle, *more)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"is READY [0-9.]+ s .* s without .*; on trial: ", done.stdout)
    (figures,) = json.loads((tmp_path / "report.json").read_text())["boxes"].values()
    assert figures["lost_s"] <= figures["ready_s"]
    assert listed(host)[sha(bundle)] == "on trial"
    assert serves(host) == sha(bundle)[:8]
    left = host.machine.get("ls", "-A", "/var/lib/palpate/incoming", f"/home/{hosts.USER}")
    assert ".palpate" not in left
    pid = host.service["MainPID"]
    done = site.desktop("deploy", *at, bundle)
    assert (done.returncode, done.stdout.strip().endswith("runs already")) == (0, True)
    assert host.service["MainPID"] == pid


def test_a_bundle_with_an_unknown_key_is_refused(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], sender: Sender, tmp_path: Path
):
    """By the desktop if it has the signers, by the box always; the running program goes on."""
    bundle = sender.made(99, deliveries.key(tmp_path))
    before, pid = serves(host), host.service["MainPID"]
    done = site.desktop("deploy", *at, bundle, "--signers", site.work / "signers")
    assert (done.returncode, done.stdout) == (78, "")
    done = site.desktop("deploy", *at, bundle)
    assert done.returncode == 1
    assert "FAILED: checking it there: bundle is signed by none of the signers" in done.stdout
    assert (serves(host), host.service["MainPID"]) == (before, pid)
    assert sha(bundle) not in listed(host)


@pytest.mark.parametrize(
    ("said", "after_s"),
    [(step, 0.0) for step in ("settings", "copying", "checking", "restarting")]
    + [("checking", 0.3), ("restarting", 0.5)],
)
def test_a_delivery_that_is_cut_leaves_old_or_new(
    site: hosts.Hosts,
    host: hosts.Host,
    at: tuple[str, str],
    sender: Sender,
    said: str,
    after_s: float,
):
    """Cut at any time: the old bundle or the new; a second delivery finishes."""
    bundle, before = sender.made(), serves(host)
    site.cut("deploy", *at, bundle, "--verbose", words=said, after_s=after_s)
    start_again(host)
    assert serves(host) in (before, sha(bundle)[:8])
    done = site.desktop("deploy", *at, bundle)
    assert done.returncode == 0, done.stdout + done.stderr
    assert serves(host) == sha(bundle)[:8]


def test_without_a_skin_the_bundle_is_installed_and_ready_waits(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], sender: Sender
):
    """Reported well before the deadline, no failure of the bundle; then READY."""
    host.machine.put("/opt/palpate/cable.py", CABLE)
    host.service.configure(CABLED)
    bundle = sender.made()
    try:
        done = site.desktop("deploy", *at, bundle)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "on trial" in done.stdout
        assert "READY waits: skin absent: no skin 1209:7ac7 on USB" in done.stdout
        host.machine.put("/run/skin", "")
        host.service.until("ActiveState", "active")
        assert serves(host) == sha(bundle)[:8]
    finally:
        host.service.configure(SIM)
        start_again(host)


def test_a_candidate_is_delivered_beside(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], sender: Sender
):
    """With --shadow the old bundle still answers."""
    bundle, before = sender.made(), serves(host)
    done = site.desktop("deploy", *at, bundle, "--shadow")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (listed(host)[sha(bundle)], serves(host)) == ("candidate", before)


def test_boxes_that_fail_do_not_stop_the_others(
    site: hosts.Hosts, host: hosts.Host, sender: Sender, tmp_path: Path
):
    """No connection, no answer, a hang, no Palpate: each its reason, the good one READY."""
    with socket.create_server(("127.0.0.1", 0)) as dumb, stalling(host) as hangs:
        shared = {"ssh_user": hosts.USER, "ssh_key": str(site.work / ".ssh/id_ed25519")}
        there = {"refuses": 1, "dumb": dumb.getsockname()[1], "hangs": hangs}
        boxes = [
            (name, {"ssh_hostname": "127.0.0.1", "ssh_port": port}) for name, port in there.items()
        ]
        boxes += [
            (name, {"ssh_hostname": one.address})
            for name, one in zip(("good", "bare"), site.hosts, strict=True)
        ]
        (tmp_path / "fleet.py").write_text(f"boxes = ({boxes!r}, {shared!r})\n")
        done = site.desktop(
            "deploy", "--hosts", tmp_path / "fleet.py", sender.made(), "--limit", "40"
        )
    assert done.returncode == 1
    lines = dict(line.split(": ", 1) for line in done.stdout.splitlines() if ": " in line)
    assert "is READY" in lines["good"]
    assert lines["refuses"].startswith("FAILED: cannot be reached: Could not connect")
    assert lines["dumb"].startswith("FAILED: cannot be reached: SSH error")
    assert "does not speak ssh" in lines["dumb"]
    assert "no Palpate is installed there" in lines["bare"]
    assert lines["hangs"].startswith("FAILED: ")
    assert "no answer within" in lines["hangs"] or "not done within 40 s" in lines["hangs"]
    assert done.stdout.splitlines()[-1] == "1 of 5 boxes done"


@contextmanager
def stalling(host: hosts.Host) -> Iterator[int]:
    """A port to the host's sshd that stops after 6000 bytes, behind the login."""

    def carry(source: socket.socket, sink: socket.socket, left: float) -> None:
        with suppress(OSError):
            while left > 0 and (data := source.recv(4096)):
                sink.sendall(data)
                left -= len(data)

    with (
        socket.create_server(("127.0.0.1", 0)) as door,
        socket.create_connection((host.address, 22)) as far,
    ):

        def serve() -> None:
            with suppress(OSError):
                near = door.accept()[0]
                Thread(target=carry, args=(near, far, float("inf")), daemon=True).start()
                carry(far, near, 6000)

        Thread(target=serve, daemon=True).start()
        yield door.getsockname()[1]


def test_a_user_who_needs_a_password_for_sudo_is_refused(
    site: hosts.Hosts, host: hosts.Host, at: tuple[str, str], sender: Sender
):
    """At once and with a reason, instead of a prompt that nobody answers."""
    host.machine.put("/etc/sudoers.d/user", f"{hosts.USER} ALL=(ALL) ALL\n")
    try:
        done = site.desktop("deploy", *at, sender.made())
        assert done.returncode == 1
        assert "sudo: a password is required; let the user in without" in done.stdout
    finally:
        host.machine.put("/etc/sudoers.d/user", f"{hosts.USER} ALL=(ALL) NOPASSWD: ALL\n")


@pytest.mark.parametrize(
    ("stderr", "why"),
    [
        ("tar: x: No space left on device\ntar: Exiting", "No space left.*; free some room"),
        ("sudo: a password is required", "is required; let the user in"),
        ("robot is not in the sudoers file.", "sudoers file.; let the user in"),
        ("bash: line 1: sudo: command not found", "not found; log in as root"),
        ("E: one\nE: two", "^copying: E: two$"),
        ("", "no reason given"),
    ],
)
def test_what_a_box_says_comes_with_what_to_do(stderr: str, why: str):
    """Also where the cause stands before the last line; words that are not known stand alone."""
    code = f"""
import fleet
from types import SimpleNamespace
said = SimpleNamespace(stderr={stderr!r}, stdout="")
host = SimpleNamespace(name="box", run_shell_command=lambda *a, **k: (False, said))
try:
    fleet.FleetBox(host, False).run("copying", "tar")
except fleet.Failed as e:
    print(e)
"""
    assert re.search(why, run_here(code))


@pytest.mark.parametrize(
    ("said", "do"),
    [
        ("Could not resolve hostname", "check the name, or use the address"),
        ("Could not connect", "check the address, and that the box is on"),
        ("Authentication error", "let your key in: ssh-copy-id"),
        ("SSH error", "the server there does not speak ssh"),
    ],
)
def test_a_box_that_cannot_be_reached_comes_with_what_to_do(said: str, do: str):
    """pyinfra's words are looked up in its code, so another version's are missed."""
    pyinfra = Path(find_spec("pyinfra").origin).parent
    assert f'"{said}' in (pyinfra / "connectors" / "ssh.py").read_text()
    assert f"; {do}" in run_here(f"import fleet; print(fleet.with_remedy('{said}: box'))")


def test_packages_that_cannot_be_had_come_with_the_cause():
    """Mirrors are named where nothing else is known, and not beside a cause that is."""
    code = """
import install, fleet
class Box:
    def __init__(self, why): self.why = why
    def report(self, text): pass
    def run(self, what, command, **options):
        if what == "apt-get": raise fleet.Failed(fleet.with_remedy(self.why))
        return ""
for why in ("apt-get: E: Unable to locate package", "apt-get: sh: 1: sudo: not found"):
    try: install.packages(Box(why))
    except install.Failed as e: print(e)
"""
    plain, sudo = run_here(code).splitlines()
    assert "Unable to locate package; give the box a way" in plain
    assert "sudo: not found; log in as root" in sudo
    assert "mirrors" not in sudo


def test_a_copy_that_fails_names_the_disk():
    """SFTP reports a full disk just as "Failure"."""
    code = """
import fleet
from types import SimpleNamespace
def full(content, name): raise OSError("Failure")
try:
    fleet.FleetBox(SimpleNamespace(name="box", put_file=full), False).put(None, "bundle.tar")
except fleet.Failed as e:
    print(e)
"""
    assert re.match("copying bundle.tar: Failure; .* disk is full", run_here(code))


@pytest.mark.slow
def test_the_self_test_of_a_release_speaks_of_the_setting(tmp_path: Path):
    """Its error is a line without the names of classes, as the box itself says it."""
    (tmp_path / "skin.toml").write_text("[skin]\nbuad = 9600\n")
    script = run_here("import install; print(install.SELF_TEST)")
    command = [sys.executable, "-c", script, tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "buad" in done.stderr
    assert "Error" not in done.stderr
    assert len(done.stderr.splitlines()) == 1
    shutil.copy(ROOT / "firmware_config" / "skin.toml", tmp_path)
    assert subprocess.run(command, cwd=ROOT, timeout=120).returncode == 0


@pytest.mark.slow
def test_another_system_is_refused_with_what_is_needed():
    """Not Debian, another architecture or file system, an old Python: one line."""
    code = """
import install
class Box:
    good = {"looking at its system": "Debian\\namd64", "looking at /opt": "/"}
    def __init__(self, **outputs): self.outputs = self.good | outputs
    def run(self, what, command, **options): return self.outputs.get(what, "")
    def report(self, text): pass
for outputs in ({"looking at its system": "Alpine Linux v3.19\\n"},
             {"looking at its system": "Raspbian 11\\narmhf"}, {"looking at /opt": "/opt"},
             {"asking for Python": "3.9.2"}):
    try: install.install(Box(**outputs), None, "", "")
    except install.Failed as e: print(e)
"""
    for line, named in zip(
        run_here(code).splitlines(), ("Alpine Linux v3.19", "armhf", "/opt", "3.9.2"), strict=True
    ):
        assert named in line


@pytest.mark.slow
def test_a_box_is_named_as_for_ssh():
    """USER@HOST:PORT, where user and port may be missing; anything else is refused."""
    code = """
import fleet
for text in ("pi@box", "Box.lab:2222", "pi@[fe80::1]:22", "pi@", "a@b@c"):
    found = fleet.NAME.fullmatch(text)
    print(found and "|".join(value or "" for value in found.groups()))
"""
    assert run_here(code).split() == ["pi|box|", "|Box.lab|2222", "pi|[fe80::1]|22", *["None"] * 2]


@pytest.mark.slow
def test_the_lock_is_read_for_the_box_not_for_the_desktop():
    """Markers for the box's Python: numpy differs between 3.11 and 3.13."""
    for python, numpy in (("3.11.2", "2.3.5"), ("3.13.5", "2.3.5")):
        locked = f"release.locked(release.LOCK.read_text(), {python!r}, 'aarch64')"
        lock = run_here(f"import release; print({locked})")
        (line,) = re.findall(r"^numpy==(\S+) \\$", lock, re.MULTILINE)
        assert line.startswith(numpy)
        assert ";" not in lock
        assert lock.count("==") == 9
        assert lock.count("--hash=sha256:") > 100

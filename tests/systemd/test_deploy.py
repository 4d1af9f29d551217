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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from threading import Thread

import pytest

from tests.factories import deliveries
from tests.factories.install_scripts import SCRIPTS, require_pyinfra, run_here
from tests.factories.paths import ROOT
from tests.rig import emulated_machines
from tests.systemd import hosts
from tests.systemd.nspawn import CABLE, CABLED, PALPATE, SIM, WAIT_S

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
    signers = ("--signers", site.work / "signers", "--key", site.work / "keys" / "key")
    done = site.desktop("install", *words, *signers, inside=site.hosts[0])
    assert done.returncode == 0, done.stdout + done.stderr
    # reported, not changed silently
    assert "No host key for 127.0.0.1 found in known_hosts, accepting" in done.stderr
    return done.stdout


class DeployedBox:
    """The installed host, as a person at the desktop uses it."""

    def __init__(self, site: hosts.Hosts) -> None:
        self.site, self.host = site, site.hosts[0]
        self.machine, self.service = self.host.machine, self.host.service
        self.at = ("--host", f"{hosts.USER}@{self.host.address}:22")
        self.get = self.machine.get

    def does(
        self, command: str, *args: str | Path, code: int = 0
    ) -> subprocess.CompletedProcess[str]:
        """Run `install --wheel WHEEL ...` or `deploy BUNDLE ...` for it, which ends with `code`.
        The release that it has is proven before an install."""
        if command == "install":
            self.machine.run("rm", "-f", "/opt/palpate.trial")
        signed = ("--key", self.site.work / "keys" / "key", "--wheel")
        words = (*self.at, *(signed if command == "install" else ()), *args)
        done = self.site.desktop(command, *words)
        assert done.returncode == code, done.stdout + done.stderr
        return done

    def release(self) -> str:
        """The release that the link leads to."""
        return self.get("readlink", "/opt/palpate")

    def runs(self) -> tuple[str, str]:
        """The release, and the number of the process."""
        return self.release(), self.service["MainPID"]

    def start_again(self) -> None:
        """As after a power cut: systemd starts the release on the disk."""
        if self.service["MainPID"] != "0":
            kill = ("systemctl", "kill", "--kill-whom=main", "--signal=SIGKILL", "palpate")
            done = self.machine.run(*kill)  # the delivery may just have stopped the process
            assert done.returncode == 0 or "No main process" in done.stderr, done.stderr
        self.machine.run("rm", "-f", "/opt/palpate.trial")  # else these kills send a release back
        self.get("systemctl", "daemon-reload")
        self.get("systemctl", "--no-block", "restart", "palpate")
        self.service.until("ActiveState", "active")

    def listed(self) -> dict[str, str]:
        """The roles of the box's bundles by sha256."""
        who = ("setpriv", "--reuid=palpate", "--regid=palpate", "--clear-groups")
        output = self.get(*who, PALPATE, "bundles", "--json")
        return {entry["sha"]: entry["role"] for entry in json.loads(output)}

    def serves(self) -> str:
        """The id of the bundle that runs."""
        end_s = time.monotonic() + WAIT_S
        while (done := self.machine.run("cat", "/run/palpate/status.json")).returncode:
            assert time.monotonic() < end_s, done.stderr
            time.sleep(0.1)
        return json.loads(done.stdout)["bundle"]


@pytest.fixture
def box(site: hosts.Hosts, installed: str) -> DeployedBox:
    """The installed host."""
    return DeployedBox(site)


def test_a_bare_host_is_installed_as_a_bare_user(box: DeployedBox, installed: str):
    """From a Debian without Python to an active service with the board's name."""
    assert re.fullmatch(r"robot@127\.0\.0\.1: \S+ is READY [0-9.]+ s .*\n", installed)
    assert (box.service["ActiveState"], box.service["UnitFileState"]) == ("active", "enabled")
    name, pid = box.runs()
    assert box.get("cat", "/opt/palpate/stamp") == name
    assert name in box.get("cat", f"/proc/{pid}/maps")
    assert box.get("cat", "/etc/palpate/palpate.toml") == 'board = "rpi5"'
    assert box.get("/usr/local/bin/palpate", "check", "--settings").count("# board-rpi5.toml") > 3
    assert box.get("stat", "-c", "%U %a", "/etc/palpate/allowed_signers") == "root 644"
    assert box.machine.run("systemd-analyze", "verify", "palpate.service").stderr == ""
    files = [f"/etc/palpate/watch/{one}" for one in ("token-look", "key.pem", "certificate.pem")]
    owners = box.get("stat", "-c", "%U:%G %a", *files).splitlines()
    assert set(owners) == {"root:palpate-watch 640"}
    off = ("palpate-watch", "palpate-bridge@tcp", "palpate-bridge@modbus")
    enabled = box.machine.run("systemctl", "is-enabled", *off).stdout.split()
    assert enabled == ["linked", "disabled", "disabled"]
    assert box.get("find", f"/home/{hosts.USER}", "-name", ".palpate*") == ""


def test_a_second_install_changes_nothing(box: DeployedBox, wheel: Path):
    """The same command again: the process goes on, settings and signers stay."""
    before, signers = box.runs(), box.site.work / "signers"
    done = box.does("install", wheel, "--board", "rpi5", "--signers", signers)
    assert done.stdout.endswith(f"{before[0].removeprefix('palpate-')} runs already\n")
    assert box.runs() == before
    assert box.get("cat", "/etc/palpate/palpate.toml") == 'board = "rpi5"'


def test_the_board_that_is_named_last_holds(box: DeployedBox, wheel: Path):
    """It replaces a wrong board, other settings stay, and the service starts with it."""
    file, (_, pid) = "/etc/palpate/palpate.toml", box.runs()
    box.machine.put(file, 'board = "rpi9"\n# mine\n')
    done = box.does("install", wheel, "--board", "rpi5")
    assert f'board = "rpi5" stands in {file} now' in done.stderr
    assert box.get("cat", file) == 'board = "rpi5"\n# mine'
    assert box.service["MainPID"] != pid
    box.machine.put(file, 'board = "rpi5"\n')


@pytest.mark.slow
def test_a_board_without_a_file_is_refused_before_any_box_is_asked():
    """The error lists the existing boards."""
    words = ("--host", "robot@127.0.0.1:1", "--wheel", __file__, "--board", "rpi9")
    command = [sys.executable, SCRIPTS / "install.py", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (1, "")
    assert "board-rpi9.toml" in done.stderr
    assert "rpi4, rpi5" in done.stderr


def test_signers_are_never_overwritten(box: DeployedBox, wheel: Path, tmp_path: Path):
    """Another signers' file is refused with a reason; the box keeps its own."""
    (tmp_path / "others").write_text(deliveries.line(deliveries.key(tmp_path)))
    before = box.get("cat", "/etc/palpate/allowed_signers")
    done = box.does("install", wheel, "--signers", tmp_path / "others", code=1)
    assert "/etc/palpate/allowed_signers" in done.stdout
    assert box.get("cat", "/etc/palpate/allowed_signers") == before


def test_a_box_without_packages_and_mirror_is_refused(site: hosts.Hosts, wheel: Path):
    """Nothing is changed there before the packages can be installed."""
    machine = site.hosts[1].machine
    machine.get("find", "/var/cache/apt/archives", "-name", "*.deb", "-delete")
    at = ("--host", f"{hosts.USER}@{site.hosts[1].address}")
    done = site.desktop("install", *at, "--wheel", wheel)
    assert done.returncode == 1
    assert "python3-venv libusb-1.0-0" in done.stdout
    assert "Debian's mirrors" in done.stdout
    assert machine.get("ls", "/opt") == ""


def test_what_a_person_put_there_stays(box: DeployedBox, wheel: Path):
    """Their settings are kept; a file in the way ends it before anything else."""
    settings, program, before = "/etc/palpate/skin.toml", "/usr/local/bin/palpate", box.runs()
    for path in (settings, program):
        box.get("rm", path)
        box.machine.put(path, "# mine\n")
    assert f"{program} is a file" in box.does("install", wheel, code=1).stdout
    box.get("rm", program)
    assert f"{settings} stays" in box.does("install", wheel).stderr
    assert box.get("cat", settings) == "# mine"
    assert box.runs() == before
    box.get("rm", settings)


@pytest.fixture(scope="session")
def upgraded(
    site: hosts.Hosts, installed: str, wheel: Path, tmp_path_factory: pytest.TempPathFactory
) -> list[tuple[str, str]]:
    """Installs two more releases on the host; each with the output of the command."""
    folder, box = tmp_path_factory.mktemp("releases"), DeployedBox(site)
    outputs = [(box.release(), installed)]
    for i in range(2):
        done = box.does(
            "install", hosts.changed_wheel(wheel, folder, "palpate/more.py", f"# {i}\n")
        )
        outputs.append((box.release(), done.stdout + done.stderr))
    return outputs


def test_an_upgrade_swaps_everything_at_once(box: DeployedBox, upgraded: list[tuple[str, str]]):
    """Another release runs; the previous release is kept, older releases are removed."""
    releases = [name for name, _ in upgraded]
    assert len({*releases}) == 3
    for _, output in upgraded[1:]:
        assert re.search(r"is READY [0-9.]+ s .*, [0-9.]+ s without", output), output
    there = box.get("sh", "-c", "ls -d /opt/palpate-*").split()
    assert there == sorted(f"/opt/{name}" for name in releases[1:])
    assert box.get("readlink", "/opt/palpate.previous") == releases[1]


def test_a_release_that_does_not_start_gives_way_to_the_old_one(
    box: DeployedBox, wheel: Path, tmp_path: Path
):
    """Self-test passed, no start: the link is swapped back, the old one classifies."""
    before = box.release()
    broken = hosts.changed_wheel(
        wheel, tmp_path, "palpate/service/systemd.py", "\nNotifier.turn = None\n"
    )
    done = box.does("install", broken, code=1)
    assert "TypeError: 'NoneType'" in done.stdout
    assert done.stdout.endswith(f"; so {before} runs again\n")
    assert (box.release(), box.service["ActiveState"]) == (before, "active")


def test_a_release_that_fails_its_self_test_is_never_swapped_in(
    box: DeployedBox, wheel: Path, tmp_path: Path
):
    """The process that classifies is not touched."""
    before, fails = box.runs(), "\nraise OSError('not on this box')\n"
    broken = hosts.changed_wheel(wheel, tmp_path, "palpate/inference/classifier.py", fails)
    assert "self-test: OSError: not on" in box.does("install", broken, code=1).stdout
    assert box.runs() == before


@pytest.mark.parametrize(
    ("said", "after_s"), [("copying", 0.3), ("building", 0.5), ("building", 4.0)]
)
def test_an_install_that_is_cut_is_finished_by_the_next(
    box: DeployedBox, wheel: Path, tmp_path: Path, said: str, after_s: float
):
    """Cut during the copy or the build: the old release starts, a second call ends it."""
    new = hosts.changed_wheel(wheel, tmp_path, "palpate/more.py", f"# {said} {after_s}\n")
    before = box.release()
    key = ("--key", box.site.work / "keys" / "key")
    box.site.cut("install", *box.at, *key, "--wheel", new, words=said, after_s=after_s)
    assert box.release() == before
    box.start_again()
    box.does("install", new)
    assert box.release() != before
    assert box.service["ActiveState"] == "active"


def test_a_release_that_was_sent_back_is_refused(
    box: DeployedBox, upgraded: list[tuple[str, str]], wheel: Path, tmp_path: Path
):
    """A new release is on trial, and dies: the box goes back by itself, the desktop says so, and
    the same release is refused then."""
    before, dies = box.release(), "\nimport os\nNotifier.turn = lambda *_: os.abort()\n"
    broken = hosts.changed_wheel(wheel, tmp_path, "palpate/service/systemd.py", dies)
    assert f"failed its trial, so {before} runs again" in box.does("install", broken, code=1).stdout
    box.service.until("ActiveState", "active")
    assert box.release() == before
    assert "was sent back" in box.does("install", broken, code=1).stdout
    box.get("rm", "/opt/palpate.rejected")


class Sender:
    """Makes signed bundles, each with a higher counter than the last."""

    def __init__(self, folder: Path, key: Path) -> None:
        self.folder, self.key, self.counter = folder, key, 0

    def made(self, counter: int = 0, key: Path | None = None) -> tuple[Path, str]:
        """A bundle's folder, and the sha256 of its manifest."""
        self.counter += not counter
        folder = self.folder / f"{len([*self.folder.glob('*')])}"
        made = deliveries.put(folder, deliveries.files(counter or self.counter, key or self.key))
        return made, hashlib.sha256((made / "manifest.json").read_bytes()).hexdigest()


@pytest.fixture(scope="session")
def sender(site: hosts.Hosts, installed: str, tmp_path_factory: pytest.TempPathFactory) -> Sender:
    """A sender whose key the host trusts."""
    return Sender(tmp_path_factory.mktemp("bundles"), site.work / "keys" / "key")


def test_a_bundle_is_delivered_and_runs_on_trial(box: DeployedBox, sender: Sender, tmp_path: Path):
    """READY and on trial, no files left behind; a second delivery changes nothing."""
    bundle, sha = sender.made()
    more = ("--signers", box.site.work / "signers", "--json", tmp_path / "report.json")
    done = box.does("deploy", bundle, *more)
    assert re.search(r"is READY [0-9.]+ s .* s without .*; on trial: ", done.stdout)
    (figures,) = json.loads((tmp_path / "report.json").read_text())["boxes"].values()
    assert figures["lost_s"] <= figures["ready_s"]
    assert (box.listed()[sha], box.serves()) == ("on trial", sha[:8])
    assert box.get("stat", "-c", "%U %a", "/etc/palpate/counter") == "root 644"
    assert box.get("cat", "/etc/palpate/counter") == str(sender.counter)
    left = box.get("ls", "-A", "/var/lib/palpate/incoming", f"/home/{hosts.USER}")
    assert ".palpate" not in left
    before = box.runs()
    assert box.does("deploy", bundle).stdout.strip().endswith("runs already")
    assert box.runs() == before


def test_a_bundle_with_an_unknown_key_is_refused(box: DeployedBox, sender: Sender, tmp_path: Path):
    """By the desktop if it has the signers, by the box always; the running program goes on."""
    bundle, sha = sender.made(99, deliveries.key(tmp_path))
    before = box.serves(), box.runs()
    done = box.does("deploy", bundle, "--signers", box.site.work / "signers", code=78)
    assert done.stdout == ""
    assert "by none of the signers" in box.does("deploy", bundle, code=1).stdout
    assert (box.serves(), box.runs()) == before
    assert sha not in box.listed()


@pytest.mark.parametrize(
    ("said", "after_s"),
    [(step, 0.0) for step in ("settings", "copying", "checking", "restarting")]
    + [("checking", 0.3), ("restarting", 0.5)],
)
def test_a_delivery_that_is_cut_leaves_old_or_new(
    box: DeployedBox, sender: Sender, said: str, after_s: float
):
    """Cut at any time: the old bundle or the new; a second delivery finishes."""
    (bundle, sha), before = sender.made(), box.serves()
    box.site.cut("deploy", *box.at, bundle, "--verbose", words=said, after_s=after_s)
    box.start_again()
    assert box.serves() in (before, sha[:8])
    box.does("deploy", bundle)
    assert box.serves() == sha[:8]


def test_without_a_skin_the_bundle_is_installed_and_ready_waits(box: DeployedBox, sender: Sender):
    """Reported well before the deadline, no failure of the bundle; then READY."""
    box.machine.put("/opt/palpate/cable.py", CABLE)
    box.service.configure(CABLED)
    bundle, sha = sender.made()
    try:
        said = box.does("deploy", bundle).stdout
        assert "on trial" in said
        assert "no skin 1209:7ac7" in said
        box.machine.put("/run/skin", "")
        box.service.until("ActiveState", "active")
        assert box.serves() == sha[:8]
    finally:
        box.service.configure(SIM)
        box.start_again()


def test_a_candidate_is_delivered_beside(box: DeployedBox, sender: Sender):
    """With --shadow the old bundle still answers."""
    (bundle, sha), before = sender.made(), box.serves()
    box.does("deploy", bundle, "--shadow")
    assert (box.listed()[sha], box.serves()) == ("candidate", before)


def test_boxes_that_fail_do_not_stop_the_others(
    site: hosts.Hosts, box: DeployedBox, sender: Sender, tmp_path: Path
):
    """No connection, no answer, a hang, no Palpate: each its reason, the good one READY."""
    with socket.create_server(("127.0.0.1", 0)) as dumb, stalling(box.host) as hangs:
        shared = {"ssh_user": hosts.USER, "ssh_key": str(site.work / ".ssh/id_ed25519")}
        there = {"refuses": 1, "dumb": dumb.getsockname()[1], "hangs": hangs}
        boxes = [(n, {"ssh_hostname": "127.0.0.1", "ssh_port": port}) for n, port in there.items()]
        named = zip(("good", "bare"), site.hosts, strict=True)
        boxes += [(name, {"ssh_hostname": one.address}) for name, one in named]
        (tmp_path / "fleet.py").write_text(f"boxes = ({boxes!r}, {shared!r})\n")
        fleet = ("--hosts", tmp_path / "fleet.py", sender.made()[0], "--limit", "40")
        done = site.desktop("deploy", *fleet)
    assert done.returncode == 1
    lines = dict(line.split(": ", 1) for line in done.stdout.splitlines() if ": " in line)
    assert "is READY" in lines["good"]
    assert lines["refuses"].startswith("FAILED: cannot be reached: Could not connect")
    assert lines["dumb"].startswith("FAILED: cannot be reached: SSH error")
    assert "no Palpate" in lines["bare"]
    assert lines["hangs"].startswith("FAILED: ")
    assert "no answer" in lines["hangs"] or "within 40 s" in lines["hangs"]
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


def test_a_user_who_needs_a_password_for_sudo_is_refused(box: DeployedBox, sender: Sender):
    """At once and with a reason, instead of a prompt that nobody answers."""
    box.machine.put("/etc/sudoers.d/user", f"{hosts.USER} ALL=(ALL) ALL\n")
    try:
        assert "sudo: a password" in box.does("deploy", sender.made()[0], code=1).stdout
    finally:
        box.machine.put("/etc/sudoers.d/user", f"{hosts.USER} ALL=(ALL) NOPASSWD: ALL\n")


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
    assert "package; give" in plain
    assert "log in as" in sudo
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
    for python, numpy, packages in (("3.11.2", "2.3.5", 25), ("3.13.5", "2.3.5", 24)):
        locked = f"release.locked(release.LOCK.read_text(), {python!r}, 'aarch64')"
        lock = run_here(f"import release; print({locked})")
        (line,) = re.findall(r"^numpy==(\S+) \\$", lock, re.MULTILINE)
        assert line.startswith(numpy)
        assert ";" not in lock
        assert lock.count("==") == packages
        assert lock.count("--hash=sha256:") > 100

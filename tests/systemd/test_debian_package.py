"""The Debian package on a bare host, from `apt install` to a box that is taught; and `make install`
with a host's name alone. One host, one test after another: each begins where the last has ended.

It takes minutes, so it runs only with PALPATE_SYSTEMD=1.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.factories.install_scripts import SCRIPTS, require_pyinfra
from tests.rig import emulated_machines
from tests.systemd import hosts
from tests.systemd.nspawn import PALPATE, SITE, WAIT_S

require_pyinfra()
APT = ("env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-y", "-q")
AS_BOX = ("setpriv", "--reuid=palpate", "--regid=palpate", "--init-groups", PALPATE)
APART = ("--set", "store.folder=/var/lib/palpate/simulated")
"""A folder of simulated sweeps, which must not teach the box itself."""
BACKUP = "/usr/local/bin/palpate-backup"
LONG_S = 900
"""Longest wait for an installation or a fit on a busy machine."""


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The wheels of palpate and palpate-train."""
    folder, source = (tmp_path_factory.mktemp(name) for name in ("wheels", "source"))
    return [*emulated_machines.wheels(folder, source)]


def packed(folder: Path, wheels: list[Path], *architectures: str) -> list[Path]:
    """The packages for these architectures."""
    command = [sys.executable, SCRIPTS / "debian.py", folder, "--wheels", *wheels]
    command += ["--architectures", *architectures]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return [Path(line) for line in done.stdout.split()]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hosts.Hosts]:
    """One bare host, and a desktop that may log in there."""
    if os.environ.get("PALPATE_SYSTEMD") != "1":
        pytest.skip("installs on real hosts take minutes; run python -m tests.campaigns systemd")
    with hosts.Hosts(1, tmp_path_factory.mktemp("hosts") / "work", "bare") as made:
        yield made


@pytest.fixture(scope="session")
def said(site: hosts.Hosts, wheels: list[Path], tmp_path_factory: pytest.TempPathFactory) -> str:
    """Installs the package with apt; the output of that."""
    packages = packed(tmp_path_factory.mktemp("deb"), wheels, "amd64")
    (package,) = [one for one in packages if ".deb12_" in one.name]
    (parcel,) = site.work.glob("host-*/parcel")
    shutil.copy(package, parcel / "palpate.deb")
    done = site.hosts[0].machine.run(
        *APT, "install", "--no-install-recommends", "/parcel/palpate.deb", limit_s=LONG_S
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def host(site: hosts.Hosts, said: str) -> hosts.Host:
    """The host that had the package."""
    return site.hosts[0]


def test_both_architectures_hold_the_same(wheels: list[Path], tmp_path: Path, said: str):
    """arm64 has its libraries for its Debian alone, otherwise the files of amd64."""
    found: dict[str, set[str]] = {"x86_64": set(), "aarch64": set()}
    packages = packed(tmp_path, wheels, "amd64", "arm64")
    kinds = [(machine, python) for machine in found for python in ("cp311", "cp313")]
    for package, (machine, python) in zip(packages, kinds, strict=True):
        folder = tmp_path / f"{machine}-{python}"
        subprocess.run(["dpkg-deb", "-R", package, folder], check=True, timeout=120)
        control = (folder / "DEBIAN/control").read_text()
        assert f"Architecture: {package.stem.rpartition('_')[2]}\n" in control
        assert f"python3 (>= 3.{python[3:]})" in control
        (archive,) = (folder / "usr/lib/palpate").iterdir()
        with tarfile.open(archive) as tar:
            members = tar.getnames()
        binary = [name for name in members if "linux" in name]
        assert binary
        assert all(machine in name for name in binary)
        assert any("onnxruntime-1" in name and python in name for name in binary)
        other = {"cp311": "cp313-cp313", "cp313": "cp311-cp311"}[python]
        assert not any(other in name for name in members)
        found[machine] |= {re.sub(r"-(cp3|py3).*", "", name) for name in members}
    assert found["x86_64"] == found["aarch64"]
    shared = {"share/palpate/palpate-teach.service", "share/palpate/skins/flexitac.toml"}
    assert shared <= found["aarch64"]


def test_apt_ends_with_a_ready_box(host: hosts.Host, said: str):
    """From a Debian without Python to an active service; at last `palpate status`."""
    assert re.search(r"(?m)^running for .*\(process \d+, palpate ", said)
    assert re.search(r"(?m)^model +default ", said)
    assert (host.service["ActiveState"], host.service["UnitFileState"]) == ("active", "enabled")
    name = host.machine.get("readlink", "/opt/palpate")
    assert name in host.machine.get("cat", f"/proc/{host.service['MainPID']}/maps")
    assert host.machine.get("stat", "-c", "%U %a", "/etc/palpate/enrolment/key") == "palpate 400"
    assert host.machine.run("systemd-analyze", "verify", "palpate-teach.service").stderr == ""
    assert host.machine.get("dpkg", "--verify", "palpate") == ""
    assert host.machine.get("/usr/local/bin/palpate", "--version").startswith("palpate ")


def test_the_same_package_again_changes_nothing(host: hosts.Host):
    """The release is the same, settings and keys stay, the service is ready again."""
    before = host.machine.get("readlink", "/opt/palpate")
    key = host.machine.get("sha256sum", "/etc/palpate/enrolment/key")
    host.machine.put(SITE, "# mine\n")
    again = host.machine.run(*APT, "install", "--reinstall", "/parcel/palpate.deb", limit_s=LONG_S)
    assert again.returncode == 0, again.stdout + again.stderr
    assert host.machine.get("readlink", "/opt/palpate") == before
    assert host.machine.get("sha256sum", "/etc/palpate/enrolment/key") == key
    assert host.machine.get("cat", SITE) == "# mine"
    assert host.service["ActiveState"] == "active"


def test_make_install_takes_over_the_release_of_the_package(
    site: hosts.Hosts, host: hosts.Host, wheels: list[Path]
):
    """Nothing is built; a signer is made."""
    pid = host.service["MainPID"]
    box, train = wheels
    at = ("--host", f"{hosts.USER}@{host.address}", "--wheel", box, "--teaching", train)
    done = site.desktop("install", *at)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith(" runs already\n")
    assert host.service["MainPID"] == pid
    key = site.work / ".config/palpate/signing-key"
    assert f"made {key}, with which you sign bundles" in done.stderr
    signers = host.machine.get("cat", "/etc/palpate/allowed_signers")
    assert signers.split()[1:] == key.with_suffix(".pub").read_text().split()[:2]
    again = site.desktop("install", *at)
    assert again.returncode == 0
    assert "made " not in again.stderr


def test_the_installed_box_is_taught(host: hosts.Host):
    """Sweeps of two materials become a bundle of the box's key."""
    host.machine.get("install", "-d", "-o", "palpate", "/var/lib/palpate/simulated")
    for material in ("wood", "metal"):
        words = ("--label", material, "--sim", f"skin:{material}", "--virtual", "--sweeps", "4")
        done = host.machine.run(*AS_BOX, "teach", *APART, *words, limit_s=LONG_S)
        assert done.returncode == 0, done.stdout + done.stderr
    done = host.machine.run(*AS_BOX, "teach", *APART, "--use", "--by", "anna", limit_s=LONG_S)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "with metal, wood" in done.stdout
    words = " ".join((*APART, "--sim", "skin"))
    host.machine.put(
        "/run/systemd/system/palpate-teach.service.d/test.conf",
        f"[Service]\nExecStart=\nExecStart={PALPATE} teach --web {words}\n",
    )
    host.machine.get("systemctl", "daemon-reload")
    host.machine.get("systemctl", "start", "palpate-teach")
    ask = "import urllib.request; print(urllib.request.urlopen('http://127.0.0.1:8138').status)"
    wait = f'for i in $(seq 60); do /opt/palpate/bin/python -c "{ask}" && exit; sleep 1; done'
    assert host.machine.get("sh", "-c", wait) == "200"
    assert host.service["ActiveState"] == "inactive"
    host.machine.get("systemctl", "stop", "palpate-teach")
    host.machine.get("rm", "-r", "/run/systemd/system/palpate-teach.service.d")
    host.service.until("ActiveState", "active")


def test_a_box_without_a_bundle_for_its_skin_starts_in_teach_mode(host: hosts.Host):
    """By itself, after its restart: the log and `palpate status` say so, and READY stays low."""
    host.machine.put(SITE, '[skin]\nprofile = "flexitac"\nport = "/dev/ttyUSB0"\n')
    host.machine.get("rm", "-r", "/run/systemd/system/palpate.service.d")
    host.machine.get("systemctl", "daemon-reload")
    host.machine.get("systemctl", "--no-block", "restart", "palpate")
    end_s = time.monotonic() + 2 * WAIT_S
    while not any("READY stays low" in one for one in host.service.log_lines()):
        assert time.monotonic() < end_s, host.service.journal()
        time.sleep(0.2)
    host.service.until("StatusText", r"skin (?!streaming).*")
    assert host.service["ActiveState"] == "activating"
    assert "nothing taught yet" in host.machine.run(PALPATE, "status").stdout  # 69: no skin
    host.machine.get("rm", SITE)
    host.machine.get("systemctl", "stop", "palpate")  # a start would wait for this one
    host.service.start()


def test_a_backup_comes_back_by_one_command(host: hosts.Host):
    """Over the running box, as root: later changes are undone, owners included."""
    host.machine.put(SITE, "# saved\n")
    owner = ("stat", "-c", "%U:%G %a", "/etc/palpate/enrolment/key", "/var/lib/palpate/bundles")
    before = host.machine.get(*owner)
    host.machine.get("sh", "-c", f"{BACKUP} save - > /root/box.tar")
    host.machine.put(SITE, "# changed\n")
    host.machine.get("rm", "-r", "/etc/palpate/enrolment", "/var/lib/palpate/bundles")
    done = host.machine.run(BACKUP, "restore", "/root/box.tar")
    assert done.returncode == 0, done.stderr
    assert host.machine.get("cat", SITE) == "# saved"
    assert host.machine.get(*owner) == before
    host.service.until("ActiveState", "active")


def test_a_removed_package_leaves_settings_and_sweeps(host: hosts.Host):
    """Program, units and links go; a purge takes the settings, and never the sweeps."""
    host.machine.get("mkdir", "-p", "/var/lib/palpate/sweeps")
    done = host.machine.run(*APT, "remove", "palpate", limit_s=LONG_S)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "/var/lib/palpate" in done.stdout
    assert host.machine.get("ls", "/opt") == ""
    for gone in ("/usr/local/bin/palpate", "/etc/systemd/system/palpate.service"):
        assert host.machine.run("test", "-L", gone).returncode
    assert host.machine.get("cat", SITE) == "# saved"
    assert host.machine.run(*APT, "purge", "palpate", limit_s=LONG_S).returncode == 0
    assert host.machine.run("test", "-e", "/etc/palpate").returncode
    assert host.machine.get("ls", "-d", "/var/lib/palpate/sweeps")

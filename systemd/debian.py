"""Packs Palpate as Debian packages, for boxes that no desktop with make reaches.

`python systemd/debian.py dist` writes a package for each architecture and Debian of PYTHONS. It
holds the archive that `make install` copies to a box; its scripts run the commands that
`make install` runs there. So a box is the same by either way, and either way can upgrade it. The
environment is built on the box because dpkg removes the files of an old package before it sets up
the new one: a release that fails its self-test must find the old release in place.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import install
import own_signer
from fleet import Failed
from install import LINK, LINKS, MACHINES, PACKAGES, PATHS, SKINS, TEACHING, WHEEL
from manual import write as write_manual
from palpate import __version__
from palpate.deployment.signature import own_key
from release import ROOT, ReleaseArchives

PYTHONS = {"12": "3.11.2", "13": "3.13.5"}
"""Python by the version of Debian, and so of the Raspberry Pi OS of the same name."""
ARCHIVES = "/usr/lib/palpate"
"""Folder of the archives on a box."""
UNITS = "palpate-teach.path palpate 'palpate@*' palpate-teach palpate-watch 'palpate-bridge@*'"
READY_S = 60
"""Longest wait for the service at the end of an installation, in seconds."""


START = (
    """\
# whether the service comes up: runs, or waits for its skin
start() {
  systemctl daemon-reload
  ! command -v udevadm > /dev/null || { udevadm control --reload && udevadm trigger; } || true
  systemctl reset-failed palpate 2> /dev/null || true
  systemctl --no-block restart palpate
  tries=0
  while [ $tries -lt """
    + str(READY_S)
    + """ ]; do
    sleep 1
    tries=$((tries + 1))
    state=$(systemctl show palpate --value -p ActiveState)
    text=$(systemctl show palpate --value -p StatusText)
    [ "$state" != active ] || return 0
    [ "$state" != failed ] && [ "$(systemctl show palpate --value -p NRestarts)" -lt 2 ] || return 1
    case $text in "skin "*) [ $tries -lt 10 ] || return 0 ;; esac
  done
  return 1
}
"""
)
"""A function of the shell: the service runs, or waits for its skin."""


def main() -> int:
    """Write the packages; the exit code."""
    parser = argparse.ArgumentParser(description="Packs Palpate as Debian packages.")
    parser.add_argument("out", type=Path, metavar="DIR", help="folder for the packages")
    parser.add_argument(
        "--wheels",
        type=Path,
        nargs="+",
        default=[WHEEL, TEACHING],
        metavar="FILE",
        help="of palpate and palpate-train (make deb builds them)",
    )
    parser.add_argument(
        "--architectures", nargs="+", choices=MACHINES, default=[*MACHINES], metavar="ARCH"
    )
    parser.add_argument("--key", type=Path, default=own_key(), metavar="FILE", help="signs them")
    args = parser.parse_args()
    own_signer.make_own(args.key)
    for file in args.wheels:
        if not file.is_file():
            sys.exit(f"palpate: no file {file}; check the path (make deb builds the wheels)")
    write_manual(ROOT / "build" / "manual.md")
    args.out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory() as folder:
            archives = ReleaseArchives(args.wheels, [*PATHS, SKINS], Path(folder), args.key)
            for architecture in args.architectures:
                for debian in PYTHONS:
                    print(packed(archives, architecture, debian, args.out), flush=True)
    except (Failed, OSError) as e:
        sys.exit(f"palpate: {e}")
    return 0


def packed(archives: ReleaseArchives, architecture: str, debian: str, out: Path) -> Path:
    """The package for an architecture and a version of Debian, written to the folder `out`. Raises
    Failed."""
    version = f"{package_version()}.deb{debian}"
    target, python = out / f"palpate_{version}_{architecture}.deb", PYTHONS[debian]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "DEBIAN").mkdir()
        (folder / ARCHIVES[1:]).mkdir(parents=True)
        release, archive = archives.of(MACHINES[architecture], python)
        os.link(archive, folder / ARCHIVES[1:] / f"{release}.tar")
        text = control(version, architecture, python, archive.stat().st_size)
        (folder / "DEBIAN/control").write_text(text)
        for script, text in scripts(release, python).items():
            (folder / "DEBIAN" / script).write_text(text)
            (folder / "DEBIAN" / script).chmod(0o755)
        for path in folder.rglob("*"):
            if path.parent.name != "DEBIAN":
                path.chmod(0o755 if path.is_dir() else 0o644)
        # wheels are compressed already
        command: list[str | Path] = [
            "dpkg-deb",
            "--root-owner-group",
            "-Znone",
            "--build",
            folder,
            target,
        ]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except FileNotFoundError as e:
            raise Failed("dpkg-deb is missing; build on a Debian, or apt-get install dpkg") from e
        except subprocess.CalledProcessError as e:
            raise Failed(f"{target} cannot be written: {e.stderr.strip()}") from e
    return target


def package_version() -> str:
    """The version, with the time of the commit, so that a later commit is an upgrade."""
    command = [
        "git",
        "-C",
        str(ROOT),
        "log",
        "-1",
        "--format=%cd",
        "--date=format-local:%Y%m%d.%H%M%S",
    ]
    zone = os.environ | {"TZ": "UTC"}
    done = subprocess.run(command, env=zone, capture_output=True, text=True, check=False)
    return f"{__version__}+{done.stdout.strip()}" if done.stdout.strip() else __version__


def _short(python: str) -> tuple[str, str]:
    """A version of Python without its last number, and the next: ("3.11", "3.12")."""
    major, minor, _ = python.split(".")
    return f"{major}.{minor}", f"{major}.{int(minor) + 1}"


def control(version: str, architecture: str, python: str, size: int) -> str:
    """The description of the package. size: of its files, in bytes."""
    least, beyond = _short(python)
    return f"""Package: palpate
Version: {version}
Architecture: {architecture}
Maintainer: The Palpate developers <palpate@localhost>
Installed-Size: {size // 1024}
Depends: python3 (>= {least}), python3 (<< {beyond}), {", ".join(PACKAGES)}, systemd
Section: science
Priority: optional
Description: names the material that a robot's tactile skin touches
 The program of the Palpate box with all its libraries, its service, board
 files and skin profiles. After the installation the service runs: it answers
 the robot, or can be taught if it has no bundle for its skin.
"""


def scripts(release: str, python: str) -> dict[str, str]:
    """The package's scripts by name. release: the name of the release. python: its Python."""
    own = " ".join(path for path in LINKS)
    return {
        "postinst": _postinst(f"palpate-{release}", _short(python)[0]),
        "prerm": f"""#!/bin/sh
[ "$1" != remove ] || [ ! -d /run/systemd/system ] || systemctl stop {UNITS} || true
""",
        "postrm": f"""#!/bin/sh
set -e
if [ "$1" = remove ]; then
  for one in {own}; do
    if [ -L "$one" ]; then rm -f "$one"; fi
  done
  rm -rf {LINK} {LINK}-* {LINK}.previous {LINK}.trial* {LINK}.rejected
  [ ! -d /run/systemd/system ] || systemctl daemon-reload
  echo "palpate: sweeps and bundles stay in /var/lib/palpate, settings in /etc/palpate"
elif [ "$1" = purge ]; then
  rm -rf /etc/palpate
  [ ! -d /var/lib/palpate ] || echo "palpate: sweeps and bundles stay in /var/lib/palpate"
fi
""",
    }


def _postinst(name: str, wanted: str) -> str:
    """The script that installs the release of this name, as `make install` does. wanted: its
    Python."""
    release = f"/opt/{name}"
    return f"""#!/bin/sh
set -e
[ "$1" = configure ] || exit 0
fail() {{ echo "palpate: $1" >&2; exit 1; }}
name={name}
python=$(python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')
[ "$python" = {wanted} ] || fail "python3 is $python; this package has libraries for {wanted}"
[ "$(stat -c %m /opt)" = / ] || fail "/opt is a separate file system; make it part of /"
[ ! -e {LINK} ] || [ -L {LINK} ] || fail "{LINK} is a folder, not a link; move it away"
echo "palpate: building {release}"
( {install.build(release)}
) < {ARCHIVES}/{name.removeprefix("palpate-")}.tar
( {install.prepare(release, "")}
)
{install.self_test(release)}
before=$(readlink {LINK} || true)
[ "$before" = "$name" ] || {install.swap(release)} || exit 1
if [ ! -d /run/systemd/system ]; then
  echo "palpate: installed; it starts with the system"
  exit 0
fi
{START}{_comes_up()}"""


def _comes_up() -> str:
    """The end of that script: the service starts, or the old release runs again."""
    return f"""if ! start; then
  journalctl -q -t palpate -n 5 -o cat >&2 || true
  old=$(readlink {LINK}.previous || true)
  if [ -n "$old" ] && [ "$old" != "$name" ]; then
    {install.swap("/opt/$old")}
    ! start || fail "the service did not come up with $name; $old runs again"
  fi
  [ "$(systemctl show palpate --value -p ExecMainStatus)" = 78 ] || \\
    fail "the service does not come up; journalctl -u palpate says why"
  echo "palpate: installed; it needs a setting in {install.SETTINGS}, see the line above"
  exit 0
fi
[ "$(readlink {LINK})" = "$name" ] || fail "$name failed its trial; palpate status says why"
{install.tidy()}
systemctl try-restart 'palpate@*' palpate-watch 'palpate-bridge@*' || true
if [ "$state" = active ]; then
  {LINK}/bin/palpate status || true
else
  echo "palpate: installed; it waits: $text"
fi
"""


if __name__ == "__main__":
    sys.exit(main())

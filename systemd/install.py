"""Installs or upgrades the runtime on bare Debian boxes. In: which boxes, this checkout. Out: a line for each box.

A release is one folder, /opt/palpate-<version>-<hash>: virtual environment, unit, users, rules, board files, manual. All
places outside lead into it through the link /opt/palpate, which is swapped by one rename when the folder is whole and
has passed its self-test. So after a cut at any moment a box starts with the old runtime and the old unit, or the new
ones; run the command again to finish. The boxes need no internet, but for packages of Debian that are missing.
"""

from __future__ import annotations

import shlex
import sys
import tempfile
from pathlib import Path

from fleet import Box, Failed, each, options
from parcel import ROOT, Parcels

from appliance import __version__

WHEEL = ROOT / "dist" / f"palpate-{__version__}-py3-none-any.whl"
PACKAGES = ("python3-venv", "libusb-1.0-0", "openssh-client")
"""Debian's: a virtual environment, the skin on USB, signatures (ssh-keygen)."""
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""Debian's name of an architecture, and that of Python's wheels."""
HERE = "/opt/palpate"
PLACES = {
    "systemd/palpate.service": "/etc/systemd/system/palpate.service",
    "systemd/palpate.sysusers": "/usr/lib/sysusers.d/palpate.conf",
    "systemd/palpate.tmpfiles": "/usr/lib/tmpfiles.d/palpate.conf",
    "firmware_config/70-palpate.rules": "/etc/udev/rules.d/70-palpate.rules",
    **{
        f"firmware_config/{f.name}": f"/etc/palpate/{f.name}" for f in sorted((ROOT / "firmware_config").glob("*.toml"))
    },
    "docs/manual.md": "/usr/share/doc/palpate/manual.md",
    "docs/manual": "/usr/share/doc/palpate/manual",
    "docs/alignment/page.png": "/usr/share/doc/palpate/alignment/page.png",
    "firmware_config/PROTOCOL.md": "/usr/share/doc/palpate/PROTOCOL.md",
}
"""Files of this checkout, and where a box looks for them."""
LINKS = {place: f"{HERE}/share/palpate/{Path(name).name}" for name, place in PLACES.items()} | {
    "/etc/systemd/system/multi-user.target.wants/palpate.service": "../palpate.service",
    "/usr/local/bin/palpate": f"{HERE}/bin/palpate",
}
"""What leads from these places into the release."""
PIP = "-m pip --disable-pip-version-check -q install --no-cache-dir --no-index --root-user-action=ignore"
SELF_TEST = """
import sys; from pathlib import Path; from appliance.bundle import bundle
from appliance.cli.commands import load_bundle; from appliance.core import clock, config
from appliance.inference import classifier
settings = config.load(None, folder=Path(sys.argv[1]))
for held in (bundle.load(bundle.DEFAULT), load_bundle(settings)):
    classifier.Classifier(held, clock.SystemClock()).self_test()
"""
"""The settings are understood, and the bundle that is packaged and the one in use do what they should."""
PACKAGES_S = BUILD_S = 600
"""For packages, and for the environment, on a slow card."""
READY_S, STARTS = 40, 2
"""When a release counts as one that does not come up."""
LIMIT_S = 1800
"""For all of one box."""


def main(argv: list[str] | None = None) -> int:
    """Install on all boxes; the exit code."""
    parser = options("Installs or upgrades the runtime on bare Debian boxes.", LIMIT_S)
    parser.add_argument("--board", default="", help="board file for a box that has no settings yet: rpi4, rpi5")
    parser.add_argument("--signers", type=Path, metavar="FILE", help="allowed_signers: whose bundles the box takes")
    parser.add_argument("--wheel", type=Path, default=WHEEL, help="of this checkout (made by make wheel)")
    args = parser.parse_args(argv)
    for file in (args.wheel, *([args.signers] if args.signers else [])):
        if not file.is_file():
            sys.exit(f"palpate: no file {file}; check the path (make wheel makes the wheel)")
    signers = args.signers.read_text() if args.signers else ""
    with tempfile.TemporaryDirectory() as folder:
        parcels = Parcels(args.wheel, [*PLACES], Path(folder))
        return each(args, lambda box: install(box, parcels, box.data("board", args.board), signers))


def install(box: Box, parcels: Parcels, board: str, signers: str) -> str:
    """Bring one box to this release, whatever it has now; its line."""
    machine = survey(box)
    packages(box)
    python = box.run("asking for Python", "python3 -c 'import platform; print(platform.python_version())'")
    if tuple(map(int, python.split(".")[:2])) < (3, 11):
        raise Failed(f"its Python is {python}; Palpate needs 3.11 or later, which Debian 12 has")
    name, parcel = parcels.of(machine, python)
    release = f"{HERE}-{name}"
    if not box.run("looking for the release", f"cat {release}/stamp 2>/dev/null || true"):
        box.say(f"copying {name}, {parcel.stat().st_size / 1e6:.0f} MB")
        box.put(parcel, f".palpate-{name}.tar")
        box.say("building its environment")
        box.run("building the environment", build(release), user="root", stdin=f".palpate-{name}.tar", limit_s=BUILD_S)
        box.run("tidying up", f"rm -f .palpate-{name}.tar")
    kept = box.run("users, folders and settings", prepare(release, board, signers), user="root")
    if kept:
        box.say(f"{' '.join(kept.split())} stays as it is there: a file, not the link to the release's")
    box.run("self-test", self_test(release), user="root", limit_s=120)
    return switch(box, name, release)


def survey(box: Box) -> str:
    """Python's name of the box's architecture. Raises Failed where Palpate does not run on such a box."""
    said = box.run("looking at its system", '. /etc/os-release; echo "$PRETTY_NAME"; dpkg --print-architecture || true')
    system, _, arch = said.partition("\n")
    if arch not in MACHINES:
        raise Failed(f"its system is {system}, {arch or 'not Debian'}; Palpate needs Debian 12 for arm64 or amd64")
    # systemd reads units before it mounts anything, and the unit lies in the release
    if box.run("looking at /opt", "stat -c %m /opt") != "/":
        raise Failed("/opt is a file system of its own there; it must be part of the root file system")
    if box.run(f"looking at {HERE}", f"test -e {HERE} && test ! -L {HERE} && echo folder || true"):
        raise Failed(f"{HERE} is a folder there, not the link that this command swaps; move it away first")
    return MACHINES[arch]


def packages(box: Box) -> None:
    """Get what is missing of Debian's packages."""
    status = "dpkg-query -W -f '${db:Status-Status} ${binary:Package}\\n' " + " ".join(PACKAGES)
    said = box.run("looking for packages", f"{status} 2>/dev/null || true")
    there = {line.split()[1].split(":")[0] for line in said.splitlines() if line.startswith("installed ")}
    missing = " ".join(name for name in PACKAGES if name not in there)
    if not missing:
        return
    box.say(f"installing {missing}")
    get = f"DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=120 install --no-install-recommends {missing}"
    try:
        box.run("apt-get", f"{get} || {{ apt-get update -q && {get}; }}", user="root", limit_s=PACKAGES_S)
    except Failed as e:
        raise Failed(
            f"{missing} cannot be installed: {e}; give the box a way to Debian's mirrors, or install it there"
        ) from e


def build(release: str) -> str:
    """The commands that make a release of the parcel on standard input: whole, on the disk, then stamped.

    Those of an install whose desktop died may be at it still: they are waited for.
    """
    return f"""set -e; umask 022
exec 9> /run/palpate-install.lock; flock -w {BUILD_S} 9; ! [ -e {release}/stamp ] || exit 0
rm -rf {release}; mkdir {release}; tar -x --no-same-owner -C {release}
python3 -m venv {release}
{release}/bin/python {PIP} --find-links {release}/wheels --require-hashes -r {release}/wheels/requirements.lock
{release}/bin/python {PIP} --no-deps {release}/wheels/palpate-*.whl
rm -r {release}/wheels
sync -f {release}
echo {Path(release).name} > {release}/stamp
sync -f {release}"""


def prepare(release: str, board: str, signers: str) -> str:
    """The commands that make what the new release needs outside and what does not harm the old one."""
    share = f"{release}/share/palpate"
    lines = [
        "set -e; umask 022",
        f"systemd-sysusers {share}/palpate.sysusers",
        f"systemd-tmpfiles --create {share}/palpate.tmpfiles",
    ]
    if signers:
        file, text = "/etc/palpate/allowed_signers", shlex.quote(signers)
        lines += [
            f'if [ ! -e {file} ]; then {_put(file, text)}; elif [ "$(cat {file}; echo .)" != {text}. ]; then'
            f" echo '{file} is another one there, and stays; change it on the box' >&2; exit 1; fi"
        ]
    if board:
        file = "/etc/palpate/palpate.toml"
        text = shlex.quote(f'board = "{board}"\n')
        lines += [f"if [ ! -e {file} ]; then {_put(file, text)}; fi"]
    for place, target in LINKS.items():
        settings = place.startswith("/etc/palpate/")
        own = f"echo {place}" if settings else f"echo '{place} is a file there, not a link; move it away' >&2; exit 1"
        lines += [
            f"mkdir -p {Path(place).parent}",
            f"if [ -e {place} ] && [ ! -L {place} ]; then {own}; else ln -sfn {target} {place}; fi",
        ]
    return "\n".join([*lines, "sync -f /etc; sync -f /usr"])


def _put(file: str, text: str) -> str:
    return f"printf %s {text} > {file}.new && sync -f {file}.new && mv {file}.new {file}"


def self_test(release: str) -> str:
    """The command that tries the new runtime, as the service's user, with the settings and bundles of the box."""
    as_it = "setpriv --reuid=palpate --regid=palpate --init-groups"
    return f"{as_it} {release}/bin/python -I -c {shlex.quote(SELF_TEST)} {release}/share/palpate"


def switch(box: Box, name: str, release: str) -> str:
    """Swap the link and start the service from it, where that is not so already; the box's line."""
    before = box.run("looking for the old release", f"readlink {HERE} || true")
    runs = f"""pid=$(systemctl show palpate -p MainPID --value)
[ "$pid" != 0 ] && grep -q {release}/ /proc/$pid/maps && echo runs || true"""
    if before == Path(release).name and box.run("looking at the process", runs, user="root"):
        return f"{name} runs already"
    if before != Path(release).name:
        box.run("swapping the link", swap(release, before), user="root")
    try:
        ready = _start(box)
    except Failed as e:
        raise Failed(f"{e}{_back(box, release)}") from e
    keep = f"$(readlink -e {HERE}) $(readlink -e {HERE}.previous || true)"
    tidy = f'for one in {HERE}-*; do case " {keep} " in *" $one "*) ;; *) rm -rf "$one";; esac; done'
    box.run("removing older releases", tidy, user="root", limit_s=120)
    if not ready:
        return f"{name} installed; it waits: {box.told['waits']}"
    lost = f", {box.told['lost_s']} s without classifying" if "lost_s" in box.told else ""
    return f"{name} is READY {box.told['ready_s']} s after the command{lost}"


def _back(box: Box, release: str) -> str:
    """Have the release before run again, where there is one; how the sentence ends that says why."""
    before = box.run("looking for the old release", f"readlink {HERE}.previous || true")
    if before in ("", Path(release).name):
        return ""
    box.run("swapping back", swap(f"/opt/{before}", Path(release).name), user="root")
    try:
        _start(box)
    except Failed as e:
        return f"; it was swapped back, but {before}: {e}"
    return f"; so {before} runs again"


def swap(release: str, before: str) -> str:
    """The commands that make the link lead to a release, and keep where it led before."""
    previous = f"ln -sfn {before} {HERE}.previous" if before else "true"
    return f"""set -e; {previous}
ln -sfn {Path(release).name} {HERE}.new; sync -f /opt
mv -T {HERE}.new {HERE}; sync -f /opt"""


def _start(box: Box) -> bool:
    """Have systemd and udev read what the link leads to now, and start the service; see Box.restart."""
    udev = "udevadm control --reload && udevadm trigger"
    box.run(
        "reading the unit", f"systemctl daemon-reload; ! command -v udevadm > /dev/null || {{ {udev}; }}", user="root"
    )
    return box.restart(READY_S, STARTS)


if __name__ == "__main__":
    sys.exit(main())

"""Installs or upgrades the runtime on bare Debian boxes, and prints a line for each box.

A release is one folder, /opt/palpate-<version>-<hash>: virtual environment, unit, users, rules,
board files, manual. All paths outside lead into it through the link /opt/palpate, which is swapped
by one rename when the folder is complete and has passed its self-test. So after an interruption at
any moment a box starts with the old runtime and the old unit, or with the new runtime and unit; run
the command again to finish. The boxes need internet only for missing Debian packages.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from pathlib import Path

import own_signer
from enrolment_key import make as make_enrolment_key
from fleet import Failed, FleetBox, each, options, remedy
from manual import write as write_manual
from page_secrets import make as make_page_secrets
from palpate import __version__
from palpate.core.settings_files import boards
from palpate.deployment.signature import own_key
from release import NAMESPACE, ROOT, SUMS, ReleaseArchives

WHEEL = ROOT / "dist" / f"palpate-{__version__}-py3-none-any.whl"
TEACHING = ROOT / "dist" / "palpate_train-0.1.0-py3-none-any.whl"
"""The program that learns; the box gets it without its dependencies, see palpate[teach]."""
PACKAGES = ("python3-venv", "libusb-1.0-0", "openssh-client", "openssl")
"""Debian packages: for a virtual environment, the skin on USB, signatures (ssh-keygen), the page's
certificate."""
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""Debian's name of an architecture, and its name in Python's wheels."""
LINK = "/opt/palpate"
"""The link to the release in use."""
PATHS = {
    "systemd/palpate.service": "/etc/systemd/system/palpate.service",
    "systemd/palpate@.service": "/etc/systemd/system/palpate@.service",
    "systemd/palpate-watch.service": "/etc/systemd/system/palpate-watch.service",
    "systemd/palpate-teach.path": "/etc/systemd/system/palpate-teach.path",
    "systemd/palpate-teach.service": "/etc/systemd/system/palpate-teach.service",
    "systemd/palpate-bridge@.service": "/etc/systemd/system/palpate-bridge@.service",
    "systemd/palpate-memory.conf": (
        "/etc/systemd/system/palpate-bridge@memory.service.d/palpate-memory.conf"
    ),
    "systemd/palpate-opcua.conf": (
        "/etc/systemd/system/palpate-bridge@opcua.service.d/palpate-opcua.conf"
    ),
    "systemd/palpate.sysusers": "/usr/lib/sysusers.d/palpate.conf",
    "systemd/palpate.tmpfiles": "/usr/lib/tmpfiles.d/palpate.conf",
    "firmware_config/70-palpate.rules": "/etc/udev/rules.d/70-palpate.rules",
    **{
        f"firmware_config/{f.name}": f"/etc/palpate/{f.name}"
        for f in sorted((ROOT / "firmware_config").glob("*.toml"))
    },
    "build/manual.md": "/usr/share/doc/palpate/manual.md",
    "firmware_config/PROTOCOL.md": "/usr/share/doc/palpate/PROTOCOL.md",
}
"""Files of this checkout, and their paths on a box."""
SKINS = "firmware_config/skins"
"""The delivered skin profiles. Each has its own link, since the folder may contain others."""
LINKS = {path: f"{LINK}/share/palpate/{Path(name).name}" for name, path in PATHS.items()} | {
    **{
        f"/etc/palpate/skins/{f.name}": f"{LINK}/share/palpate/skins/{f.name}"
        for f in (ROOT / SKINS).glob("*.toml")
    },
    "/etc/systemd/system/multi-user.target.wants/palpate.service": "../palpate.service",
    "/usr/local/bin/palpate": f"{LINK}/bin/palpate",
    "/usr/local/bin/palpate-backup": f"{LINK}/bin/palpate-backup",
}
"""Symlinks on a box, and their targets."""
PIP = (
    "-m pip --disable-pip-version-check -q install --no-cache-dir --no-index "
    "--root-user-action=ignore"
)
SELF_TEST = """
import sys; from pathlib import Path; from palpate.bundle import bundle
from palpate.cli.common import load_bundle; from palpate.core import clock, config, errors
from palpate.inference import classifier; from palpate.runtime import replay
try:
    settings = config.load(None, folder=Path(sys.argv[1]))
    for one in (bundle.load(bundle.DEFAULT), load_bundle(settings)):
        classifier.Classifier(one, clock.SystemClock()).self_test()
    kept = settings.kept("black-box")
    count, changed = replay.changed(kept, settings, one)
except errors.ApplianceError as e:
    sys.exit(str(e))
if changed:
    sys.exit(f"{len(changed)} of {count} kept sweeps are answered otherwise ({changed[-1]}); if "
             f"that is wanted, move them away from {kept}")
"""
"""Program that a new release must run without an error: reads the settings, runs the golden sweeps
of the packaged bundle and of the bundle in use, and answers the kept sweeps again."""
PACKAGES_S = BUILD_S = 600
"""Time limits for installing packages and for building the environment, on a slow card."""
SETUP_S = 120
"""Time limit for making keys and certificates and flushing them to the disk, and for the self-test,
on a slow computer."""
READY_S, STARTS = 40, 2
"""A release has failed if it is not READY after so many seconds, or has ended so often."""
LIMIT_S = 1800
"""Time limit for each box."""
SETTINGS, SIGNERS = "/etc/palpate/palpate.toml", "/etc/palpate/allowed_signers"
MODEL = "/proc/device-tree/model"
"""The board's name, where its firmware tells one."""


def main(argv: list[str] | None = None) -> int:
    """Install on all boxes; the exit code."""
    args = _parser().parse_args(argv)
    # make install builds both wheels
    wheels = [
        args.wheel,
        *([args.teaching] if args.teaching.is_file() and not args.no_teach else []),
    ]
    for file in (*wheels, *([args.signers] if args.signers else [])):
        if not file.is_file():
            sys.exit(f"palpate: no file {file}; check the path (make install builds the wheel)")
    try:
        known_board(args.board)
    except Failed as e:
        sys.exit(f"palpate: {e}")
    signers = args.signers.read_text() if args.signers else ""
    asks = bool(args.host) and sys.stdin.isatty()
    own_signer.make_own(args.key)
    write_manual(ROOT / "build" / "manual.md")

    def one(box: FleetBox) -> str:
        board = known_board(box.data("board", args.board)) or (asked_board(box) if asks else "")
        return install(box, archives, board, signers)

    with tempfile.TemporaryDirectory() as folder:
        archives = ReleaseArchives(wheels, [*PATHS, SKINS], Path(folder), args.key)
        return each(args, one)


def _parser() -> argparse.ArgumentParser:
    parser = options("Installs or upgrades the runtime on bare Debian boxes.", LIMIT_S)
    parser.add_argument(
        "--board", default="", help="board file for a box that has no settings yet: rpi4, rpi5"
    )
    parser.add_argument(
        "--signers",
        type=Path,
        metavar="FILE",
        help="allowed_signers: the signers whose bundles the box accepts",
    )
    parser.add_argument(
        "--key",
        type=Path,
        default=own_key(),
        metavar="FILE",
        help="private key that signs the release; the boxes check it by their signers",
    )
    parser.add_argument(
        "--wheel", type=Path, default=WHEEL, help="of this checkout (make install builds it)"
    )
    parser.add_argument(
        "--teaching", type=Path, default=TEACHING, help="of palpate-train (make install builds it)"
    )
    parser.add_argument(
        "--no-teach",
        action="store_true",
        help="without the program and libraries of palpate teach (make install TEACH=0)",
    )
    return parser


def known_board(board: str) -> str:
    """`board`, "" for none. Raises Failed if no board file of this checkout has that name."""
    known = boards(ROOT / "firmware_config")
    if board and board not in known:
        raise Failed(
            f"BOARD={board} has no file firmware_config/board-{board}.toml; boards there: "
            f"{', '.join(known)}"
        )
    return board


def asked_board(box: FleetBox) -> str:
    """The board whose pins a person chooses, "" for none. Nothing is asked if the box has a board
    already or tells its own."""
    found = box.run(
        "looking for its board", f"grep '^board *=' {SETTINGS} 2> /dev/null || {own_board()}"
    )
    known = boards(ROOT / "firmware_config")
    if found and (found.startswith("board") or found in known):
        return ""
    question = f"{box.name}: the pins of which board? {', '.join(known)}, or Enter for none: "
    while (board := input(question).strip()) and board not in known:
        print(f"there is no board {board!r}")
    return board


def own_board(model: str = MODEL) -> str:
    """The command that prints the name of the box's board, such as rpi5; nothing for another
    computer than a Raspberry Pi. model: the file with its name."""
    pattern = r"s/^Raspberry Pi \(Compute Module \)\{0,1\}\([0-9]\{1,\}\).*/rpi\2/p"
    return f"sed -n '{pattern}' {model} 2> /dev/null || true"


def install(box: FleetBox, archives: ReleaseArchives, board: str, signers: str) -> str:
    """Install this release on one box, whatever it has now; the line for this box."""
    machine = survey(box)
    packages(box)
    python = box.run(
        "asking for Python", "python3 -c 'import platform; print(platform.python_version())'"
    )
    if tuple(map(int, python.split(".")[:2])) < (3, 11):
        raise Failed(f"its Python is {python}; Palpate needs 3.11 or later, which Debian 12 has")
    name, archive = archives.of(machine, python)
    release = f"{LINK}-{name}"
    if not signers and not box.run("looking for signers", f"cat {SIGNERS} 2> /dev/null || true"):
        signers = own_signer.line(box.report)
    if signers:
        box.run("signers", put_signers(signers), user="root")
    if not box.run("looking for the release", f"cat {release}/stamp 2>/dev/null || true"):
        box.report(f"copying {name}, {archive.stat().st_size / 1e6:.0f} MB")
        box.put(archive, f".palpate-{name}.tar")
        box.report("building its environment")
        box.run(
            "building the environment",
            build(release),
            user="root",
            stdin=f".palpate-{name}.tar",
            limit_s=BUILD_S,
        )
    # also of an install that was interrupted after it had built
    box.run("tidying up", "rm -f .palpate-*.tar")
    setup = prepare(release, board)
    said = box.run("users, folders and settings", setup, user="root", limit_s=SETUP_S).splitlines()
    for line in said:
        box.report(line)
    box.run("self-test", self_test(release), user="root", limit_s=SETUP_S)
    return switch(box, name, release, restart=any(line.startswith("board = ") for line in said))


def survey(box: FleetBox) -> str:
    """The box's architecture, as in names of wheels. Raises Failed if Palpate does not run on such
    a box."""
    output = box.run(
        "looking at its system",
        '. /etc/os-release; echo "$PRETTY_NAME"; dpkg --print-architecture || true',
    )
    system, _, arch = output.partition("\n")
    if arch not in MACHINES:
        raise Failed(
            f"its system is {system}, {arch or 'not Debian'}; Palpate needs Debian 12 for arm64 "
            "or amd64"
        )
    # systemd reads units before it mounts anything, and the unit is in the release
    if box.run("looking at /opt", "stat -c %m /opt") != "/":
        raise Failed(
            "/opt is a separate file system there; it must be part of the root file system"
        )
    if box.run(f"looking at {LINK}", f"test -e {LINK} && test ! -L {LINK} && echo folder || true"):
        raise Failed(
            f"{LINK} is a folder there, not the link that this command swaps; move it away first"
        )
    return MACHINES[arch]


def packages(box: FleetBox) -> None:
    """Install missing Debian packages. Raises Failed if they cannot be installed."""
    status = "dpkg-query -W -f '${db:Status-Status} ${binary:Package}\\n' " + " ".join(PACKAGES)
    output = box.run("looking for packages", f"{status} 2>/dev/null || true")
    present = {
        line.split()[1].split(":")[0]
        for line in output.splitlines()
        if line.startswith("installed ")
    }
    missing = " ".join(name for name in PACKAGES if name not in present)
    if not missing:
        return
    box.report(f"installing {missing}")
    get = (
        "DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=120 install "
        f"--no-install-recommends {missing}"
    )
    try:
        box.run(
            "apt-get",
            f"{get} || {{ apt-get update -q && {get}; }}",
            user="root",
            limit_s=PACKAGES_S,
        )
    except Failed as e:
        mirrors = (
            ""
            if remedy(str(e))
            else "; give the box a way to Debian's mirrors, or install it there"
        )
        raise Failed(f"{missing} cannot be installed: {e}{mirrors}") from e


def build(release: str) -> str:
    """Commands that build a release from the archive on standard input, write it to the disk, and
    stamp it as complete.

    The commands of an earlier install, whose desktop died, may still run, so these wait for a lock.
    """
    return f"""set -e; umask 022
exec 9> /run/palpate-install.lock; flock -w {BUILD_S} 9; ! [ -e {release}/stamp ] || exit 0
rm -rf {release}; mkdir {release}; tar -x --no-same-owner -C {release}
{check_signature(release)}
python3 -m venv {release}
{release}/bin/python {PIP} --find-links {release}/wheels --require-hashes \\
  -r {release}/wheels/requirements.lock
{release}/bin/python {PIP} --no-deps {release}/wheels/palpate-*.whl
for train in {release}/wheels/palpate_train-*.whl; do
  ! [ -e "$train" ] || {release}/bin/python {PIP} --no-deps "$train"
done
rm -r {release}/wheels
sync -f {release}
echo {Path(release).name} > {release}/stamp
sync -f {release}"""


def check_signature(release: str, signers: str = SIGNERS) -> str:
    """Commands that end the shell with an error unless a signer of the box has signed all files of
    the unpacked archive; any line of the key may allow it. A box without signers, on which a Debian
    package is installed for the first time, trusts it as dpkg does."""
    sums = f"{release}/{SUMS}"
    verify = f"ssh-keygen -Y verify -f {signers} -n {NAMESPACE} -s {sums}.sig"
    return f"""if [ -s {signers} ]; then
  by=$(awk '{{print $1}}' {signers} | while read -r name; do
    {verify} -I "$name" < {sums} > /dev/null 2>&1 && echo "$name"; done) || true
  [ -n "$by" ] \
    || {{ echo 'nobody in {signers} has signed the release; use a key from there: KEY=FILE' >&2
      exit 1; }}
  (cd {release} && sha256sum --status --strict -c {SUMS} \
    && [ -z "$(find . ! -type f ! -type d)" ] \
    && [ "$(find . -type f | wc -l)" = $(($(wc -l < {SUMS}) + 2)) ]) \
    || {{ echo 'the release differs from what was signed; install it again' >&2; exit 1; }}
else
  echo 'no signers in {signers}: the signature of the release is not checked' >&2
fi"""


def put_signers(signers: str, file: str = SIGNERS) -> str:
    """Commands that write the file of signers if there is none; another one there is an error."""
    text = shlex.quote(signers)
    return f"""set -e; umask 022; mkdir -p {Path(file).parent}
if [ ! -e {file} ]; then {_put(file, text)}
elif [ "$(cat {file}; echo .)" != {text}. ]; then
  echo '{file} differs from this file there, and stays; change it on the box' >&2; exit 1
fi"""


def _set_board(board: str, share: str) -> str:
    """Write the board into the site file; all other settings stay. Without a name, a box that has
    no board gets its own, if `share` has a file for it."""
    return f"""board={shlex.quote(board)}
if [ -z "$board" ] && ! grep -q '^board *=' {SETTINGS} 2> /dev/null; then
  board=$({own_board()}); [ -e "{share}/board-$board.toml" ] || board=
fi
line="board = \\"$board\\""
if [ -n "$board" ] && ! grep -qxF "$line" {SETTINGS} 2> /dev/null; then
  {{ echo "$line"; sed '/^board *=/d' {SETTINGS} 2> /dev/null || true; }} > {SETTINGS}.new
  sync -f {SETTINGS}.new && mv {SETTINGS}.new {SETTINGS} && echo "$line stands in {SETTINGS} now"
fi"""


def prepare(release: str, board: str) -> str:
    """Commands that set up users, folders, settings and links outside of the release, and print a
    line for each file that was there and for a changed board. The old release can run with them,
    too."""
    share = f"{release}/share/palpate"
    lines = [
        "set -e; umask 022",
        f"systemd-sysusers {share}/palpate.sysusers",
        f"systemd-tmpfiles --create {share}/palpate.tmpfiles",
        make_page_secrets(),
        make_enrolment_key(),
    ]
    lines.append(_set_board(board, share))
    for path, target in LINKS.items():
        settings = path.startswith("/etc/palpate/")
        own = (
            f"echo '{path} stays as it is there: a file, not the link'"
            if settings
            else f"echo '{path} is a file there, not a link; move it away' >&2; exit 1"
        )
        lines += [
            f"mkdir -p {Path(path).parent}",
            f"if [ -e {path} ] && [ ! -L {path} ]; then {own}; else ln -sfn {target} {path}; fi",
        ]
    return "\n".join([*lines, "sync -f /etc; sync -f /usr"])


def _put(file: str, text: str) -> str:
    return f"printf %s {text} > {file}.new && sync -f {file}.new && mv {file}.new {file}"


def self_test(release: str) -> str:
    """The command that runs SELF_TEST in the new runtime as the service's user, with the settings
    and bundles of the box."""
    as_user = "setpriv --reuid=palpate --regid=palpate --init-groups"
    return f"{as_user} {release}/bin/python -I -c {shlex.quote(SELF_TEST)} {release}/share/palpate"


def switch(box: FleetBox, name: str, release: str, *, restart: bool) -> str:
    """Swap the link and start the service from it, unless that is done already; the line for this
    box.

    restart: start it even if this release runs, since its settings have changed.
    """
    before = box.run("looking for the old release", f"readlink {LINK} || true")
    runs = f"""pid=$(systemctl show palpate -p MainPID --value)
[ "$pid" != 0 ] && grep -q {release}/ /proc/$pid/maps && echo runs || true"""
    if (
        not restart
        and before == Path(release).name
        and box.run("looking at the process", runs, user="root")
    ):
        return f"{name} runs already"
    if before != Path(release).name:
        box.run("swapping the link", swap(release), user="root")
    try:
        ready = _start(box)
    except Failed as e:
        raise Failed(f"{e}{_swap_back(box, release)}") from e
    if (now := box.run("asking what runs", f"readlink {LINK}")) != Path(release).name:
        raise Failed(f"{name} failed its trial, so {now} runs again; palpate status there says why")
    # until then they belong to the earlier release; disabled units stay off
    box.run(
        "restarting page and bridges",
        "systemctl try-restart 'palpate@*' palpate-watch 'palpate-bridge@*'",
        user="root",
    )
    box.run("removing older releases", tidy(), user="root", limit_s=120)
    if not ready:
        return f"{name} installed; it waits: {box.result['waits']}"
    lost = f", {box.result['lost_s']} s without classifying" if "lost_s" in box.result else ""
    return f"{name} is READY {box.result['ready_s']} s after the command{lost}"


def tidy() -> str:
    """The command that removes all releases but the present and the previous one."""
    keep = f"$(readlink -e {LINK}) $(readlink -e {LINK}.previous || true)"
    return (
        f'for one in {LINK}-*; do case " {keep} " in *" $one "*) ;; *) rm -rf "$one";; esac; done'
    )


def _swap_back(box: FleetBox, release: str) -> str:
    """Let the previous release run again, if there is one; text to append to the reason."""
    before = box.run("looking for the old release", f"readlink {LINK}.previous || true")
    if before in ("", Path(release).name):
        return ""
    box.run("swapping back", swap(f"/opt/{before}"), user="root")
    try:
        _start(box)
    except Failed as e:
        return f"; it was swapped back, but {before}: {e}"
    return f"; so {before} runs again"


def swap(release: str) -> str:
    """The command that makes a release current, on trial if there was another before. It fails for
    a release that was sent back."""
    name = f'"$(basename {release})"'
    return f"{release}/bin/python -I -m palpate.deployment.releases activate {name}"


def _start(box: FleetBox) -> bool:
    """Let systemd and udev read the files behind the link, and start the service; see
    FleetBox.restart."""
    udev = "udevadm control --reload && udevadm trigger"
    box.run(
        "reading the unit",
        f"systemctl daemon-reload; ! command -v udevadm > /dev/null || {{ {udev}; }}",
        user="root",
    )
    return box.restart(READY_S, STARTS)


if __name__ == "__main__":
    sys.exit(main())

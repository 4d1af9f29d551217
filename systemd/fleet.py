"""Works on many boxes at once, over ssh. In: one USER@HOST or an inventory, and the work for a box.
Out: a line for each box.

pyinfra provides inventory, connections and commands. Its operations are not used: they wait for the
slowest box after each step, and have no deadline for a box that hangs while files are copied to it.
Here the boxes are independent, and each ends by itself, by a failure or by its deadline.
"""

# ruff: noqa: E402

from gevent import monkey

monkey.patch_all()  # before all other imports: pyinfra's connections are greenlets of one thread

import argparse
import json
import logging
import re
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, TextIO

import gevent
from paramiko import SSHException
from pyinfra.api import Config, Host, Inventory, State, StringCommand
from pyinfra.api.exceptions import ConnectError, PyinfraError
from pyinfra.connectors import util
from pyinfra.context import ctx_state
from pyinfra_cli.inventory import make_inventory_from_files

BEGAN_S = time.monotonic()
"""When the command began, after the start of Python."""
PALPATE = "/opt/palpate/bin/palpate"
NAME = re.compile(
    r"(?:(?P<ssh_user>[^@]+)@)?(?P<ssh_hostname>[^@:\[\]]+|\[[^\]]+\])(?::(?P<ssh_port>\d+))?"
)
"""USER@HOST:PORT; user and port may be missing, an IPv6 address stands in brackets."""
SHORT_S = 60
"""Longest wait for a command that should take a second; a slow board that classifies takes much
longer."""
SKIN_S = 10
"""How long to wait for a service without other trouble to find its skin."""
PROPERTIES = (
    "ActiveState",
    "InvocationID",
    "MainPID",
    "NRestarts",
    "StatusText",
    "ActiveEnterTimestampMonotonic",
    "ActiveExitTimestampMonotonic",
)
"""Properties of the service that systemd is asked for."""


REMEDIES = (
    ("No space left on device", "free some room there (df -h; journalctl --vacuum-size=50M)"),
    (
        "sudo: a password is required",
        "let the user in without: USER ALL=(ALL) NOPASSWD: ALL in /etc/sudoers.d/palpate",
    ),
    ("sudo: command not found", "log in as root, or install sudo there"),
    ("sudo: not found", "log in as root, or install sudo there"),
    (
        "not in the sudoers file",
        "let the user in: USER ALL=(ALL) NOPASSWD: ALL in /etc/sudoers.d/palpate",
    ),
    ("Authentication", "let your key in: ssh-copy-id USER@HOST"),
    ("host key", "if the box was set up anew, forget its old key: ssh-keygen -R HOST"),
    ("Could not resolve", "check the name, or use the address"),
    ("Could not connect", "check the address, and that the box is on: ssh USER@HOST must get in"),
    ("SSH", "what answers there is no ssh, or too busy for it: ssh USER@HOST must get in"),
)
"""Words in what a box or the way to it says, and what to do then; the first that fits."""


class Failed(Exception):
    """The work cannot be done on this box; the message says why and what to try."""


class FleetBox:
    """One box and the connection to it. `result`: figures that are written beside its line.
    verbose: prints each step."""

    def __init__(self, host: Host, verbose: bool) -> None:
        self._host, self._verbose = host, verbose
        self.name: str = host.name
        self.result: dict[str, Any] = {}

    def data(self, name: str, default: Any = None) -> Any:
        """A value that the inventory has for this box, or the default."""
        return self._host.data.dict().get(name, default)

    def report(self, text: str) -> None:
        """Print progress for the person who waits."""
        print(f"{self.name}: {text}", file=sys.stderr, flush=True)

    def run(
        self, what: str, command: str, *, user: str = "", stdin: str = "", limit_s: float = SHORT_S
    ) -> str:
        """Output of a command that the shell of the login user, or of `user`, runs; stdin: a file
        in the login user's home.

        Raises Failed, with `what` and the last line of the output, where the command fails or takes
        longer than limit_s.
        """
        if self._verbose:
            self.report(what)
        if user:
            command = f"sudo -n -H -u {user} -- sh -c {shlex.quote(command)}"
        if stdin:
            command += f" < {shlex.quote(stdin)}"
        try:
            done, output = self._host.run_shell_command(StringCommand(command), _timeout=limit_s)
        except TimeoutError as e:
            raise Failed(
                f"{what}: no answer within {limit_s:.0f} s; look whether the box is well"
            ) from e
        if not done:
            lines = [line for line in (output.stderr or output.stdout).splitlines() if line.strip()]
            # what it stumbled over may stand before what it made of that
            line = next(
                (line for line in lines if remedy(line)), lines[-1] if lines else "no reason given"
            )
            raise Failed(with_remedy(f"{what}: {line.removeprefix('palpate: ')}"))
        return str(output.stdout).strip()

    def put(self, content: Path | IO[bytes], name: str) -> None:
        """Copy a file into the home of the login user. Raises Failed."""
        try:
            self._host.put_file(str(content) if isinstance(content, Path) else content, name)
        except OSError as e:  # over SFTP a full disk is no more than "Failure"
            raise Failed(
                f"copying {name}: {e}; see whether its disk is full (df -h) and try again"
            ) from e

    def service(self) -> dict[str, str]:
        """Properties of the service, from systemd; `Now`: seconds since the box was switched on."""
        ask = f"systemctl show palpate -p {','.join(PROPERTIES)}; sed 's/^/Now=/; s/ .*//' /proc/uptime"
        output = self.run("asking for the service", ask, user="root")
        return dict(line.partition("=")[::2] for line in output.splitlines())

    def restart(self, limit_s: float, starts: int) -> bool:
        """Restart the service. True where it is READY, False where it only waits for its skin.

        `result` gets ready_s, seconds from the begin of this command to READY, and lost_s, seconds
        without classifying by the clock of the box. Raises Failed where it is neither within
        limit_s, or has failed `starts` times. That limit is by the clock of the box, too: a slow
        way to it, or an emulator that is short of time, costs nothing.
        """
        before, waits_s = self.service(), 0.0
        # reset-failed sets the count of restarts back to 0
        again = "systemctl reset-failed palpate; systemctl --no-block restart palpate"
        self.run("restarting the service", again, user="root")
        end_s = float(before["Now"]) + limit_s
        while True:
            now = self.service()
            now_s = float(now["Now"])
            begun = now["InvocationID"] != before["InvocationID"]
            if begun and now["ActiveState"] == "active":
                break
            if begun and now["StatusText"].startswith("skin "):  # past its self-test
                waits_s = waits_s or now_s
                if now_s > waits_s + SKIN_S:
                    self.result["waits"] = now["StatusText"]
                    return False
            failed = begun and (now["ActiveState"] == "failed" or int(now["NRestarts"]) >= starts)
            if failed or now_s > end_s:
                raise Failed(f"the service does not come up: {self._last_line(now)}")
            time.sleep(0.2)
        self.result["ready_s"] = round(time.monotonic() - BEGAN_S, 2)
        if before["ActiveState"] == "active":
            away_us = int(now["ActiveEnterTimestampMonotonic"]) - int(
                now["ActiveExitTimestampMonotonic"]
            )
            self.result["lost_s"] = round(away_us / 1e6, 2)
        return True

    def _last_line(self, service: dict[str, str]) -> str:
        """Last line of the service's journal, with its state."""
        # -t palpate: leaves out the program that lowers the outputs afterwards
        command = "journalctl -q -t palpate _SYSTEMD_UNIT=palpate.service -n 20 -o cat"
        lines = self.run("reading the journal", command, user="root").splitlines()
        own = [line for line in lines if not line.startswith("sweep ")] or [
            "its journal has no reason"
        ]
        return f"{own[-1]} ({service['ActiveState']}, {service['NRestarts']} restarts)"


def remedy(text: str) -> str:
    """What to do about what a box or the way to it said, "" where that is not known."""
    return next((do for words, do in REMEDIES if words in text), "")


def with_remedy(text: str) -> str:
    """`text`, and after it what to do, where that is known."""
    return "; ".join(filter(None, (text, remedy(text))))


def options(about: str, limit_s: int) -> argparse.ArgumentParser:
    """A parser with the options that say which boxes, and how long the work on one may take."""
    parser = argparse.ArgumentParser(description=about)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--host", metavar="USER@HOST[:PORT]", help="one box")
    which.add_argument(
        "--hosts",
        type=Path,
        metavar="FILE",
        help="many: an inventory (inventory.example.py shows one)",
    )
    parser.add_argument(
        "--limit",
        type=int,
        default=limit_s,
        metavar="SECONDS",
        help=f"for all of one box (default {limit_s})",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="print each step")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write what became of each box to FILE"
    )
    return parser


def each(args: argparse.Namespace, work: Callable[[FleetBox], str]) -> int:
    """Do `work` on all boxes at once, and print for each the line that it returns, or why it
    failed.

    args: of a parser from `options`. Returns the exit code: 1 where any box failed.
    """
    inventory = _inventory(args)
    try:
        state = State(inventory, Config())
    except PyinfraError as e:
        sys.exit(f"palpate: {args.hosts or args.host}: {e}")
    why: dict[str, str] = {}
    results: dict[str, dict[str, Any]] = {}

    def one(host: Host) -> None:
        box = FleetBox(host, args.verbose)
        try:
            with gevent.Timeout(
                args.limit
            ):  # a BaseException, so no code in between catches and retries it
                host.connect(show_errors=False, raise_exceptions=True)
                line = work(box)
            results[box.name] = box.result
            print(f"{box.name}: {line}", flush=True)
        except gevent.Timeout:
            why[box.name] = (
                f"not done within {args.limit} s and given up; look whether the box is well, then try again"
            )
        except ConnectError as e:
            why[box.name] = with_remedy(f"cannot be reached: {e}")
        except (Failed, OSError, EOFError, SSHException, PyinfraError) as e:
            why[box.name] = str(e) or type(e).__name__

    try:
        gevent.joinall([state.pool.spawn(one, host) for host in inventory], raise_error=True)
    except KeyboardInterrupt:
        sys.exit(
            "palpate: interrupted; each box is as it was or as it should be, run it again to finish"
        )
    for name, reason in why.items():
        print(f"{name}: FAILED: {reason}", flush=True)
    if len(inventory) > 1:
        print(f"{len(inventory) - len(why)} of {len(inventory)} boxes done")
    if args.json:
        args.json.write_text(
            json.dumps({"began_s": BEGAN_S, "boxes": results, "failed": why}, indent=1) + "\n"
        )
    return 1 if why else 0


def _inventory(args: argparse.Namespace) -> Inventory:
    """The boxes that the options name; ends the program where these are not understood."""
    # errors are printed with each box's line; pyinfra's warnings are about host keys that ssh does
    # not know
    logging.getLogger("paramiko").setLevel(logging.CRITICAL)
    logging.getLogger("pyinfra").addFilter(lambda record: record.levelno == logging.WARNING)
    util.getpass = _no_password
    if args.host:
        found = NAME.fullmatch(args.host)
        if not found:
            sys.exit(f"palpate: HOST={args.host} is not understood; use user@box or user@box:2222")
        data: dict[str, Any] = {
            key: value.strip("[]") for key, value in found.groupdict().items() if value
        }
        if "ssh_port" in data:
            data["ssh_port"] = int(data["ssh_port"])
        return Inventory(([(args.host, data)], {}))
    if not args.hosts.is_file():
        sys.exit(f"palpate: no inventory {args.hosts}; systemd/inventory.example.py shows one")
    with ctx_state.use(State()):  # it records there which file it reads
        inventory: Inventory = make_inventory_from_files(str(args.hosts))
    if not len(inventory):
        sys.exit(f"palpate: {args.hosts} names no box; systemd/inventory.example.py shows how")
    return inventory


def _no_password(prompt: str = "", stream: TextIO | None = None) -> str:
    """Replaces pyinfra's password prompt, which would stop all boxes until somebody types. Raises
    Failed."""
    raise Failed(with_remedy("sudo: a password is required"))

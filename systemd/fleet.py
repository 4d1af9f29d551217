"""Works on many boxes at once over ssh, and prints a line for each box.

pyinfra provides inventory, connections and commands. Its operations are not used: they wait for the
slowest box after each step, and have no deadline for a box that hangs while files are copied to it.
Here the boxes are independent; a box that fails or exceeds its deadline does not delay the others.
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
"""Start of the command, monotonic seconds."""
PALPATE = "/opt/palpate/bin/palpate"
NAME = re.compile(
    r"(?:(?P<ssh_user>[^@]+)@)?(?P<ssh_hostname>[^@:\[\]]+|\[[^\]]+\])(?::(?P<ssh_port>\d+))?"
)
"""USER@HOST:PORT; user and port may be missing, an IPv6 address stands in brackets."""
SHORT_S = 60
"""Longest wait for a command that usually takes a second. A slow board takes much longer while it
classifies."""
UNTAUGHT = "nothing taught yet"
"""In the state of a box without a bundle for its skin. The address of its page follows."""
SKIN_S = 10
"""Longest wait for the skin of a service that has passed its self-test."""
STRICT = "ssh_strict_host_key_checking"
"""pyinfra's name for the treatment of unknown host keys, by default "accept-new"."""
PROPERTIES = (
    "ActiveState",
    "InvocationID",
    "MainPID",
    "NRestarts",
    "StatusText",
    "ActiveEnterTimestampMonotonic",
    "ActiveExitTimestampMonotonic",
)
"""Properties of the service that are read from systemd."""

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
    (
        "found in known_hosts",
        "log in once with ssh, and compare its key with ssh-keygen -lf on the box",
    ),
    ("host key", "if the box was set up anew, forget its old key: ssh-keygen -R HOST"),
    ("Could not resolve", "check the name, or use the address"),
    ("Could not connect", "check the address, and that the box is on: ssh USER@HOST must get in"),
    ("SSH", "the server there does not speak ssh or is too busy: ssh USER@HOST must get in"),
)
"""A part of an error message, and its remedy; the first match counts."""


class Failed(Exception):
    """The work failed on this box; the message gives the reason and the remedy."""


class FleetBox:
    """One box and the connection to it. result: figures for the JSON report. verbose: print each
    step."""

    def __init__(self, host: Host, verbose: bool) -> None:
        self._host, self._verbose = host, verbose
        self.name: str = host.name
        self.result: dict[str, Any] = {}

    def connect(self) -> None:
        """Open the connection. Raises ConnectError."""
        self._host.connect(show_errors=False, raise_exceptions=True)

    def data(self, name: str, default: Any = None) -> Any:
        """A value of this box in the inventory, or the default."""
        return self._host.data.dict().get(name, default)

    def report(self, text: str) -> None:
        """Print progress."""
        print(f"{self.name}: {text}", file=sys.stderr, flush=True)

    def run(
        self, what: str, command: str, *, user: str = "", stdin: str = "", limit_s: float = SHORT_S
    ) -> str:
        """Output of a shell command, run as the login user or as `user`. stdin: a file in the login
        user's home.

        Raises Failed if the command fails or takes longer than limit_s. The message begins with
        `what` and ends with a line of the output.
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
            raise Failed(f"{what}: no answer within {limit_s:.0f} s; check the box") from e
        if not done:
            lines = [line for line in (output.stderr or output.stdout).splitlines() if line.strip()]
            # the cause may stand before the last line
            line = next(
                (line for line in lines if remedy(line)), lines[-1] if lines else "no reason given"
            )
            raise Failed(with_remedy(f"{what}: {line.removeprefix('palpate: ')}"))
        return str(output.stdout).strip()

    def put(self, content: Path | IO[bytes], name: str) -> None:
        """Copy a file into the home of the login user. Raises Failed."""
        try:
            self._host.put_file(str(content) if isinstance(content, Path) else content, name)
        except OSError as e:  # SFTP reports a full disk just as "Failure"
            raise Failed(
                f"copying {name}: {e}; check whether its disk is full (df -h) and try again"
            ) from e

    def service(self) -> dict[str, str]:
        """Properties of the service, from systemd. `Now`: seconds since the box was switched on."""
        ask = (
            f"systemctl show palpate -p {','.join(PROPERTIES)}; sed 's/^/Now=/; "
            "s/ .*//' /proc/uptime"
        )
        output = self.run("asking for the service", ask, user="root")
        return dict(line.partition("=")[::2] for line in output.splitlines())

    def restart(self, limit_s: float, starts: int) -> bool:
        """Restart the service. True if it is READY, False if it waits for its skin or is untaught.

        `result` gets ready_s, seconds from the start of this command to READY, and lost_s, seconds
        without classification. Raises Failed if the service is in neither state within limit_s, or
        has failed `starts` times. Limit and lost_s are by the clock of the box, so a slow network
        or emulator does not count.
        """
        before = self.service()
        # reset-failed sets the count of restarts back to 0
        again = "systemctl reset-failed palpate; systemctl --no-block restart palpate"
        self.run("restarting the service", again, user="root")
        now = self._restarted(before, limit_s, starts)
        if now["ActiveState"] != "active" or UNTAUGHT in now["StatusText"]:
            self.result["waits"] = now["StatusText"]
            return False
        self.result["ready_s"] = round(time.monotonic() - BEGAN_S, 2)
        if before["ActiveState"] == "active":
            away_us = int(now["ActiveEnterTimestampMonotonic"]) - int(
                now["ActiveExitTimestampMonotonic"]
            )
            self.result["lost_s"] = round(away_us / 1e6, 2)
        return True

    def _restarted(self, before: dict[str, str], limit_s: float, starts: int) -> dict[str, str]:
        """Wait for the service: its properties once it is active, or has waited SKIN_S for its
        skin. before: its properties before the restart. Raises Failed."""
        end_s, waits_s = float(before["Now"]) + limit_s, 0.0
        while True:
            now = self.service()
            now_s = float(now["Now"])
            begun = now["InvocationID"] != before["InvocationID"]
            if begun and now["ActiveState"] == "active":
                return now
            if begun and now["StatusText"].startswith("skin "):  # it has passed its self-test
                waits_s = waits_s or now_s
                if now_s > waits_s + SKIN_S:
                    return now
            failed = begun and (now["ActiveState"] == "failed" or int(now["NRestarts"]) >= starts)
            if failed or now_s > end_s:
                raise Failed(f"the service does not come up: {self._last_line(now)}")
            time.sleep(0.2)

    def _last_line(self, service: dict[str, str]) -> str:
        """Last line of the service's journal, with its state."""
        # -t palpate leaves out the program that lowers the outputs afterwards
        command = "journalctl -q -t palpate _SYSTEMD_UNIT=palpate.service -n 20 -o cat"
        lines = self.run("reading the journal", command, user="root").splitlines()
        own = [line for line in lines if not line.startswith("sweep ")] or [
            "its journal has no reason"
        ]
        return f"{own[-1]} ({service['ActiveState']}, {service['NRestarts']} restarts)"


def remedy(text: str) -> str:
    """The remedy for an error message, "" if none is known."""
    return next((do for words, do in REMEDIES if words in text), "")


def with_remedy(text: str) -> str:
    """An error message, followed by its remedy if one is known."""
    return "; ".join(filter(None, (text, remedy(text))))


def options(about: str, limit_s: int) -> argparse.ArgumentParser:
    """A parser with the options for the boxes and the time limit."""
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
        help=f"time limit for each box (default {limit_s})",
    )
    parser.add_argument(
        "--known-hosts-only",
        action="store_true",
        help="refuse a box whose key is not in known_hosts; else it is stored at the first contact",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="print each step")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the result of each box to FILE"
    )
    return parser


def each(args: argparse.Namespace, work: Callable[[FleetBox], str]) -> int:
    """Do `work` on all boxes at once. Prints for each box the line that `work` returns, or the
    reason of its failure.

    args: of a parser from `options`. Returns the exit code: 1 if any box failed.
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
        failure = _attempt(box, work, args.limit)
        if failure:
            why[box.name] = failure
        else:
            results[box.name] = box.result

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


def _attempt(box: FleetBox, work: Callable[[FleetBox], str], limit_s: int) -> str:
    """Do `work` on one box and print its line; the reason of a failure, else ""."""
    try:
        # Timeout is a BaseException, so no code in between catches it and retries
        with gevent.Timeout(limit_s):
            box.connect()
            line = work(box)
    except gevent.Timeout:
        return f"not done within {limit_s} s and given up; check the box, then try again"
    except ConnectError as e:
        return with_remedy(f"cannot be reached: {e}")
    except (Failed, OSError, EOFError, SSHException, PyinfraError) as e:
        return str(e) or type(e).__name__
    except Exception as e:  # an answer that nobody thought of must not end the work on other boxes
        return f"{type(e).__name__}: {e}"
    print(f"{box.name}: {line}", flush=True)
    return ""


def _inventory(args: argparse.Namespace) -> Inventory:
    """The boxes of the options. Ends the program if the options are wrong."""
    # errors are printed with each box's line; pyinfra's warnings are about unknown host keys
    logging.getLogger("paramiko").setLevel(logging.CRITICAL)
    logging.getLogger("pyinfra").addFilter(lambda record: record.levelno == logging.WARNING)
    util.getpass = _no_password
    strict = {STRICT: "yes"} if args.known_hosts_only else {}
    if args.host:
        found = NAME.fullmatch(args.host)
        if not found:
            sys.exit(f"palpate: HOST={args.host} is not understood; use user@box or user@box:2222")
        data: dict[str, Any] = {
            key: value.strip("[]") for key, value in found.groupdict().items() if value
        }
        if "ssh_port" in data:
            data["ssh_port"] = int(data["ssh_port"])
        return Inventory(([(args.host, data)], {}), override_data=strict)
    if not args.hosts.is_file():
        sys.exit(f"palpate: no inventory {args.hosts}; systemd/inventory.example.py shows one")
    with ctx_state.use(State()):  # the reader notes its file there
        inventory: Inventory = make_inventory_from_files(str(args.hosts), override_data=strict)
    if not len(inventory):
        sys.exit(f"palpate: {args.hosts} names no box; systemd/inventory.example.py shows how")
    return inventory


def _no_password(prompt: str = "", stream: TextIO | None = None) -> str:
    """Replaces pyinfra's password prompt, which would block the work on all boxes. Raises
    Failed."""
    raise Failed(with_remedy("sudo: a password is required"))

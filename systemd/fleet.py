"""The way to the boxes, by pyinfra. In: one USER@HOST or an inventory, and what is to be done on each box. Out: a line each.

Inventory, connections and commands are pyinfra's; its operations are not used: they wait for the slowest box after each
step, and have no deadline where a box hangs while it is copied to. Here boxes are worked on side by side, each until its
own end, failure or deadline.
"""

# ruff: noqa: E402

from gevent import monkey

monkey.patch_all()  # before all else: pyinfra's connections take turns in one thread

import argparse
import json
import logging
import re
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import gevent
from paramiko import SSHException
from pyinfra.api import Config, Host, Inventory, State, StringCommand
from pyinfra.api.exceptions import ConnectError, PyinfraError
from pyinfra.connectors import util
from pyinfra.context import ctx_state
from pyinfra_cli.inventory import make_inventory_from_files

BEGAN_S = time.monotonic()
"""When the command began, but for Python's own start."""
PALPATE = "/opt/palpate/bin/palpate"
NAME = re.compile(r"(?:(?P<ssh_user>[^@]+)@)?(?P<ssh_hostname>[^@:\[\]]+|\[[^\]]+\])(?::(?P<ssh_port>\d+))?")
"""USER@HOST:PORT; user and port may be missing, an IPv6 address stands in brackets."""
SHORT_S = 30
"""Longest wait for a command that should take a second."""
SKIN_S = 10
"""How long a service that works is given to find its skin."""
SHOWN = (
    "ActiveState", "InvocationID", "MainPID", "NRestarts", "StatusText",
    "ActiveEnterTimestampMonotonic", "ActiveExitTimestampMonotonic",
)  # fmt: skip


class Failed(Exception):
    """The work cannot be done on this box; the message says why and what to try."""


class Box:
    """One box, while it is worked on. `told` is what the outcome is, beside its line. verbose: tells each step."""

    def __init__(self, host: Host, verbose: bool) -> None:
        self._host, self._verbose = host, verbose
        self.name: str = host.name
        self.told: dict[str, Any] = {}

    def data(self, name: str, default: Any = None) -> Any:
        """What the inventory says of this box, or the default."""
        return self._host.data.dict().get(name, default)

    def say(self, text: str) -> None:
        """Tell the person who waits."""
        print(f"{self.name}: {text}", file=sys.stderr, flush=True)

    def run(self, what: str, command: str, *, user: str = "", stdin: str = "", limit_s: float = SHORT_S) -> str:
        """What a command prints, run by the shell of the login user or of `user`, with a file of the login user's home
        as its input. Raises Failed, with `what` and the last line that it said, where it does not succeed in time.
        """
        if self._verbose:
            self.say(what)
        if user:
            command = f"sudo -n -H -u {user} -- sh -c {shlex.quote(command)}"
        if stdin:
            command += f" < {shlex.quote(stdin)}"
        try:
            done, said = self._host.run_shell_command(StringCommand(command), _timeout=limit_s)
        except TimeoutError as e:
            raise Failed(f"{what}: no answer within {limit_s:.0f} s; look whether the box is well") from e
        if not done:
            lines = [line for line in (said.stderr or said.stdout).splitlines() if line.strip()] or ["no reason given"]
            raise Failed(f"{what}: {lines[-1].removeprefix('palpate: ')}")
        return said.stdout.strip()

    def put(self, content: Path | IO[bytes], name: str) -> None:
        """Copy a file into the home of the login user."""
        self._host.put_file(str(content) if isinstance(content, Path) else content, name)

    def service(self) -> dict[str, str]:
        """What systemd knows of the service."""
        said = self.run("asking for the service", f"systemctl show palpate -p {','.join(SHOWN)}", user="root")
        return dict(line.partition("=")[::2] for line in said.splitlines())

    def restart(self, limit_s: float, starts: int) -> bool:
        """Start the service again; whether it is READY, False where it only waits for its skin.

        `told` gets the seconds from the command to READY, as seen from here, and those without classifying, as the box's
        systemd measured them. Raises Failed where it is neither within the limit, or fails for the `starts`-th time.
        """
        before, waits_s = self.service(), 0.0
        # the reset is that of the count of restarts
        again = "systemctl reset-failed palpate; systemctl --no-block restart palpate"
        self.run("restarting the service", again, user="root")
        end_s = time.monotonic() + limit_s
        while True:
            now = self.service()
            begun = now["InvocationID"] != before["InvocationID"]
            if begun and now["ActiveState"] == "active":
                break
            if begun and now["StatusText"].startswith("skin "):  # past its self-test
                waits_s = waits_s or time.monotonic()
                if time.monotonic() > waits_s + SKIN_S:
                    self.told["waits"] = now["StatusText"]
                    return False
            failed = begun and (now["ActiveState"] == "failed" or int(now["NRestarts"]) >= starts)
            if failed or time.monotonic() > end_s:
                raise Failed(f"the service does not come up: {self._last_words(now)}")
            time.sleep(0.2)
        self.told["ready_s"] = round(time.monotonic() - BEGAN_S, 2)
        if before["ActiveState"] == "active":
            away_us = int(now["ActiveEnterTimestampMonotonic"]) - int(now["ActiveExitTimestampMonotonic"])
            self.told["lost_s"] = round(away_us / 1e6, 2)
        return True

    def _last_words(self, service: dict[str, str]) -> str:
        # -t: not what lowers the lines after it
        command = "journalctl -q -t palpate _SYSTEMD_UNIT=palpate.service -n 20 -o cat"
        said = self.run("reading the journal", command, user="root").splitlines()
        own = [line for line in said if not line.startswith("sweep ")] or ["no word in its journal"]
        return f"{own[-1]} ({service['ActiveState']}, {service['NRestarts']} restarts)"


def options(about: str, limit_s: int) -> argparse.ArgumentParser:
    """A parser with the options that say which boxes, and how long the work on one may take."""
    parser = argparse.ArgumentParser(description=about)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--host", metavar="USER@HOST[:PORT]", help="one box")
    which.add_argument("--hosts", type=Path, metavar="FILE", help="many: an inventory (inventory.example.py shows one)")
    parser.add_argument(
        "--limit", type=int, default=limit_s, metavar="SECONDS", help=f"for all of one box (default {limit_s})"
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="tell each step")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what became of each box to FILE")
    return parser


def each(args: argparse.Namespace, work: Callable[[Box], str]) -> int:
    """Do `work` on all boxes side by side and print the line that it gives, or why it failed, for each.

    args: of a parser that `options` made. Gives the exit code: 1 where any box failed.
    """
    inventory = _inventory(args)
    try:
        state = State(inventory, Config())
    except PyinfraError as e:
        sys.exit(f"palpate: {args.hosts or args.host}: {e}")
    why: dict[str, str] = {}
    told: dict[str, dict[str, Any]] = {}

    def one(host: Host) -> None:
        box = Box(host, args.verbose)
        try:
            with gevent.Timeout(args.limit):  # no Exception: nothing on the way takes it for one that it may try again
                host.connect(show_errors=False, raise_exceptions=True)
                line = work(box)
            told[box.name] = box.told
            print(f"{box.name}: {line}", flush=True)
        except gevent.Timeout:
            why[box.name] = f"not done within {args.limit} s and given up; look whether the box is well, then try again"
        except ConnectError as e:
            why[box.name] = f"cannot be reached: {e}"
        except (Failed, OSError, EOFError, SSHException, PyinfraError) as e:
            why[box.name] = str(e) or type(e).__name__

    try:
        gevent.joinall([state.pool.spawn(one, host) for host in inventory], raise_error=True)
    except KeyboardInterrupt:
        sys.exit("palpate: interrupted; each box is as it was or as it should be, run it again to finish")
    for name, reason in why.items():
        print(f"{name}: FAILED: {reason}", flush=True)
    if len(inventory) > 1:
        print(f"{len(inventory) - len(why)} of {len(inventory)} boxes done")
    if args.json:
        args.json.write_text(json.dumps({"began_s": BEGAN_S, "boxes": told, "failed": why}, indent=1) + "\n")
    return 1 if why else 0


def _inventory(args: argparse.Namespace) -> Inventory:
    # Errors stand in each box's line; pyinfra's warnings are of host keys that ssh did not know.
    logging.getLogger("paramiko").setLevel(logging.CRITICAL)
    logging.getLogger("pyinfra").addFilter(lambda record: record.levelno == logging.WARNING)
    util.getpass = _no_password
    if args.host:
        found = NAME.fullmatch(args.host)
        if not found:
            sys.exit(f"palpate: HOST={args.host} is not understood; use user@box or user@box:2222")
        data: dict[str, Any] = {key: value.strip("[]") for key, value in found.groupdict().items() if value}
        if "ssh_port" in data:
            data["ssh_port"] = int(data["ssh_port"])
        return Inventory(([(args.host, data)], {}))
    if not args.hosts.is_file():
        sys.exit(f"palpate: no inventory {args.hosts}; systemd/inventory.example.py shows one")
    with ctx_state.use(State()):  # where it notes which file it reads
        inventory = make_inventory_from_files(str(args.hosts))
    if not len(inventory):
        sys.exit(f"palpate: {args.hosts} names no box; systemd/inventory.example.py shows how")
    return inventory


def _no_password(prompt: str) -> str:
    """In place of pyinfra's prompt, which would hold up all boxes until somebody types."""
    raise Failed(
        "sudo wants a password there; let the user in without: USER ALL=(ALL) NOPASSWD: ALL in /etc/sudoers.d/palpate"
    )

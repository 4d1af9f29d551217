"""Cuts the power of a host at random instants of an installation: `python -m tests.campaigns
install-cuts` (as root).

A host in a container runs an installed box on the simulated skin. The desktop upgrades it
(`install`, `apt`), or delivers a bundle (`deploy`), or it makes a bundle of its own sweeps
(`taught`). At random instants the whole host stands still, and its files are copied: what the disk
would hold if its power failed then. Each copy boots as another host, without the desktop. Within
LATEST_S of the boot it must answer its first sweep, as it does without a cut, and no release may be
sent back. Data that killed processes have written stay; `tests.cuts` also cuts with lost writes.
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from statistics import median

from tests.cuts.scene import stage
from tests.factories import deliveries
from tests.factories.paths import ROOT
from tests.rig import emulated_machines
from tests.rig.emulated_machines import run
from tests.systemd import hosts, nspawn

LATEST_S = 30.0
"""Longest time from the boot to the first answer."""
LONGEST_S = 900.0
"""Longest wait for a command that nothing cuts, and for an answer, on a busy machine."""
DROP_IN = "/etc/systemd/system/palpate.service.d/test.conf"
LINKS = "/opt/palpate", "/var/lib/palpate/current"
"""They lead to the release and to the bundle."""
APT = "DEBIAN_FRONTEND=noninteractive apt-get -y -q install --reinstall /parcel/palpate.deb"
TEACH = "/opt/palpate/bin/palpate teach"
UNIT = ("systemd-run", "--quiet", "--pipe", "--wait", "sh", "-c")
"""Starts a command as a unit of the host, so that it stands still with the host."""
AS_BOX = ("setpriv", "--reuid=palpate", "--regid=palpate", "--init-groups", "sh", "-c")
TAUGHT = {"wood": 4, "metal": 4, "foam": 4}
"""Sweeps of each material that the box is taught from."""
APART = "/var/lib/palpate/simulated"
"""A folder of simulated sweeps, which must not teach a box."""
PER_RUN, AT_ONCE = 40, 8
"""Cuts of one run of a command, and hosts that boot at a time: most of the time they wait for the
skin to be touched."""
ANSWER = re.compile(r"(sweep \d+: (?!no answer, gap)[^(]*).*")
"""A line of the journal, with the answer but without the time that it took. A busy machine loses
frames of the simulated skin; such a sweep says nothing."""
ANSWERED = re.compile(r"sweep (\d+): ([^;]+)")


@dataclass(frozen=True, slots=True)
class InstallCut:
    """One cut. at_s, of_s: the instant, and the time of the whole command. ready_s, answer_s: from
    the boot to READY and to the first answer. new: whether the new release or bundle runs. wrong:
    the findings, "" for none."""

    command: str
    at_s: float
    of_s: float
    ready_s: float
    answer_s: float
    answer: str
    new: bool
    wrong: str = ""


@dataclass(frozen=True, slots=True)
class CutFolder:
    """A copy of a host's changes at an instant. ended: the command had ended. before: the release
    and the bundle that ran before it."""

    folder: Path
    at_s: float
    ended: bool
    before: str


@contextmanager
def layer(work: Path, *lower: Path) -> Iterator[Path]:
    """A root whose changes go to the folder `work`/upper, above other folders."""
    for name in ("upper", "inner", "root"):
        (work / name).mkdir(parents=True)
    where = f"upperdir={work / 'upper'},workdir={work / 'inner'}"
    below = ":".join(map(str, lower))
    run("mount", "-t", "overlay", "overlay", "-o", f"lowerdir={below},{where}", work / "root")
    try:
        yield work / "root"
    finally:
        run("umount", "--lazy", work / "root")


class CutHost:
    """A host with the box installed, as a folder of files that each cut begins with. work: an empty
    folder in memory."""

    def __init__(self, work: Path) -> None:
        self.work, self.key = work, hosts.key_of(work / "home")
        self.signer = deliveries.key(work / "keys")
        (work / "signers").write_text(deliveries.line(self.signer))
        self._below, self._numbers, self._counters = [hosts.set_up() / "ready"], count(), count(1)
        self._names = count(1)
        (work / "source").mkdir()
        self.wheel, train = emulated_machines.wheels(work, work / "source")
        with self._booted() as (host, upper):
            host.machine.put(DROP_IN, f"[Service]\n{nspawn.SIM}\n")
            begun = self._desktop("install", host, self.wheel, "--teaching", train)
            done = begun.communicate(timeout=LONGEST_S)
            host.service.until("ActiveState", "active")
            assert "READY" in str(done), done
            host.machine.get("install", "-d", "-o", "palpate", APART)
            for material, number in TAUGHT.items():
                words = f"--label {material} --sim skin:{material} --virtual --sweeps {number}"
                host.machine.get(*AS_BOX, f"{TEACH} --set store.folder={APART} {words}")
            host.machine.get("mv", f"{APART}/sweeps", "/var/lib/palpate/")
        self._below.insert(0, upper)

    @contextmanager
    def _booted(self) -> Iterator[tuple[hosts.Host, Path]]:
        """A host on a layer of its own, and the folder with its changes."""
        work = self.work / f"layer-{next(self._numbers)}"
        with layer(work, *self._below) as root:
            number = 1 + next(hosts._NUMBERS) % 240
            with closing(hosts.Host(root, number, work / "host", self.key, volatile=False)) as host:
                yield host, work / "upper"

    def _desktop(self, command: str, host: hosts.Host, *more: str | Path) -> subprocess.Popen[str]:
        """Starts systemd/COMMAND.py for a host."""
        words: list[str | Path] = ["--host", f"{hosts.USER}@{host.address}"]
        if command == "install":
            words += ["--signers", self.work / "signers", "--key", self.signer, "--wheel"]
        return subprocess.Popen(
            [sys.executable, ROOT / "systemd" / f"{command}.py", *map(str, (*words, *more))],
            env={**os.environ, "HOME": str(self.work / "home")},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def begun(self, command: str, host: hosts.Host) -> subprocess.Popen[str]:
        """Starts a command that changes the host."""
        if command == "deploy":
            counter = next(self._counters)
            held = deliveries.files(counter, self.signer)
            made = deliveries.put(self.work / f"bundle-{counter}", held)
            return self._desktop("deploy", host, made, "--signers", self.work / "signers")
        if command == "taught":
            return host.machine.begin(*UNIT, f"exec {' '.join(AS_BOX)} '{TEACH} --use --by anna'")
        folder = self.work / f"wheel-{next(self._names)}"
        folder.mkdir()
        new = hosts.changed_wheel(self.wheel, folder, "palpate/more.py", f"# {folder.name}\n")
        if command == "install":
            return self._desktop("install", host, new, "--no-teach")
        words = ("--wheels", new, "--key", self.signer, "--architectures", "amd64")
        run(sys.executable, ROOT / "systemd" / "debian.py", folder, *words)
        (package,) = folder.glob("*.deb12_*.deb")
        shutil.copy(package, host.machine.parcel / "palpate.deb")
        return host.machine.begin(*UNIT, APT)

    def cut(self, command: str, of_s: float, shares: Sequence[float]) -> Iterator[CutFolder]:
        """Run a command. Copy the host after each of these shares of `of_s` seconds, and at the
        end."""
        with self._booted() as (host, upper):
            host.service.until("ActiveState", "active")
            before = host.machine.run("readlink", *LINKS).stdout
            process, begin = self.begun(command, host), time.monotonic()
            instants = [*sorted(share * of_s for share in shares), LONGEST_S]
            while instants:
                try:
                    left_s = begin + instants.pop(0) - time.monotonic()
                    said, _ = process.communicate(timeout=max(0.0, left_s))
                    assert process.returncode == 0, said
                    instants = []
                except subprocess.TimeoutExpired:
                    assert instants, command
                at_s, copy = time.monotonic() - begin, self.work / f"cut-{next(self._numbers)}"
                with host.machine.still():
                    run("cp", "-a", upper, copy)
                begin = time.monotonic() - at_s
                yield CutFolder(copy, at_s, not instants, before)

    def again(self, command: str, of_s: float, found: CutFolder, answers: int = 1) -> InstallCut:
        """Boot a host that was cut, once, until it has given some answers."""
        work = self.work / f"layer-{next(self._numbers)}"
        with layer(work, found.folder, *self._below) as root:
            (work / "parcel").mkdir()
            begin = time.monotonic()
            with nspawn.Machine(
                root, work / "parcel", work / "again.log", volatile=False
            ) as machine:
                service = nspawn.Service(machine)
                service.until("ActiveState", "active")
                ready_s = int(service["ActiveEnterTimestampMonotonic"]) / 1e6 - begin
                answer, answered_s = _answers(machine, answers)
                answer_s = answered_s - begin
                new = machine.run("readlink", *LINKS).stdout != found.before
                rejected = machine.run("cat", "/opt/palpate.rejected").stdout
        for folder in (work, found.folder):
            shutil.rmtree(folder, ignore_errors=True)
        wrong = [f"sent back: {rejected}"] * bool(rejected)
        wrong += [f"answered after {answer_s:.1f} s"] * (answer_s > LATEST_S)
        at_s, of_s, ready_s, answer_s = (round(s, 2) for s in (found.at_s, of_s, ready_s, answer_s))
        text = "; ".join(wrong)
        return InstallCut(command, at_s, of_s, ready_s, answer_s, answer, new, text)


def _answers(machine: nspawn.Machine, count: int) -> tuple[str, float]:
    """The first answers in the journal, and the time of the first in s. Raises AssertionError."""
    end_s = time.monotonic() + LONGEST_S
    journal = ("journalctl", "-q", "-b", "-u", "palpate", "-o", "json")
    while time.monotonic() < end_s:
        lines = [json.loads(line) for line in machine.get(*journal).splitlines()]
        found = [(line, it) for line in lines if (it := ANSWER.fullmatch(str(line["MESSAGE"])))]
        if len(found) >= count:
            texts = [it[1].strip() for _, it in found[:count]]
            return "; ".join(texts), int(found[0][0]["__MONOTONIC_TIMESTAMP"]) / 1e6
        time.sleep(0.2)
    raise AssertionError("no sweep is answered")


def cuts(host: CutHost, command: str, times: int, seed: int) -> Iterator[InstallCut]:
    """Cuts of a command: at random instants, and at the end of each run."""
    rng = random.Random(f"{command} {seed}")
    known: dict[bool, dict[str, str]] = {}
    for found in host.cut(command, 0.0, [0.0]):
        of_s, one = found.at_s, host.again(command, found.at_s, found, 3)
        assert (one.new, one.wrong) == (found.ended, ""), one
        known[one.new] = dict(ANSWERED.findall(one.answer))
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for number in range(0, times, PER_RUN):
            shares = [rng.random() for _ in range(min(PER_RUN, times - number) - 1)]
            begun = []
            for found in host.cut(command, of_s, shares):
                begun.append(pool.submit(host.again, command, of_s, found))
            of_s = found.at_s
            for one in (found.result() for found in begun):
                ((number, said),) = ANSWERED.findall(one.answer)
                right = {**known[not one.new], **known[one.new]}.get(number)
                other = "" if said == right else f"{right} without a cut"
                yield replace(one, wrong="; ".join(filter(None, (one.wrong, other))))


def main() -> int:
    """Print a line for each cut, and one for each command; 1 if anything was wrong."""
    parser = argparse.ArgumentParser("python -m tests.campaigns install-cuts")
    parser.add_argument("commands", nargs="*", default=["install", "apt", "deploy", "taught"])
    parser.add_argument("--times", type=int, default=250, help="cuts of each command (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "install-cuts.jsonl")
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    lines, wrong = [], 0
    with stage() as work, args.out.open("a") as out:
        host = CutHost(Path(work))
        for command in args.commands:
            found = []
            for one in cuts(host, command, args.times, args.seed):
                found.append(one)
                print(json.dumps(asdict(one)), file=out, flush=True)
                print(one, flush=True)
            bad, new = sum(bool(one.wrong) for one in found), sum(one.new for one in found)
            ready, answer = ([getattr(one, n) for one in found] for n in ("ready_s", "answer_s"))
            lines.append(
                f"{command}: {len(found)} cuts, wrong {bad}, after {new} of them the new one runs; "
                f"{median(ready):.1f} s to READY, at most {max(ready):.1f}; {median(answer):.1f} s "
                f"to the first answer, at most {max(answer):.1f}"
            )
            wrong += bad
    print("\n".join(lines))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())

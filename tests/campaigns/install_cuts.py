"""Cuts the power of a host at random instants of an installation: `python -m tests.campaigns
install-cuts` (as root).

A host in a container runs an installed box on the simulated skin. The desktop upgrades it
(`install`, `apt`), or delivers a bundle (`deploy`). After a share of the time that this takes, all
processes of the host are killed at once, and it boots again without the desktop. Within LATEST_S of
the boot it must answer its first sweep, as it does without a cut, and no release may be sent back.
Data that killed processes have written stay; `tests.cuts` also cuts with lost writes.
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
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path

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
ANSWER = re.compile(r"(sweep \d+: (?!no answer, gap)[^(]*).*")
"""A line of the journal, with the answer but without the time that it took. A busy machine loses
frames of the simulated skin; such a sweep says nothing."""
AND = "; "


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
        emulated_machines.wheel(work, work / "source")
        (self.wheel,) = work.glob("*.whl")
        hosts._fetch_wheels()
        with self._booted() as (host, upper):
            host.machine.put(DROP_IN, f"[Service]\n{nspawn.SIM}\n")
            done = self._desktop("install", host, self.wheel).communicate(timeout=LONGEST_S)
            host.service.until("ActiveState", "active")
            assert "READY" in str(done), done
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
        folder = self.work / f"wheel-{next(self._names)}"
        folder.mkdir()
        new = hosts.changed_wheel(self.wheel, folder, "palpate/more.py", f"# {folder.name}\n")
        if command == "install":
            return self._desktop("install", host, new)
        words = ("--wheels", new, "--key", self.signer, "--architectures", "amd64")
        run(sys.executable, ROOT / "systemd" / "debian.py", folder, *words)
        (package,) = folder.glob("*.deb12_*.deb")
        (parcel,) = host.machine.parcel.parent.glob("parcel")
        shutil.copy(package, parcel / "palpate.deb")
        return host.machine.begin("sh", "-c", APT)

    def cut(self, command: str, of_s: float, share: float) -> InstallCut:
        """Run a command, cut the power after this share of `of_s` seconds, and boot again. Whole
        for `of_s` 0."""
        with self._booted() as (host, upper):
            host.service.until("ActiveState", "active")
            before = host.machine.run("readlink", *LINKS).stdout
            process, begin = self.begun(command, host), time.monotonic()
            try:
                said, _ = process.communicate(timeout=of_s * share or LONGEST_S)
                assert process.returncode == 0, said
            except subprocess.TimeoutExpired:
                pass
            at_s = time.monotonic() - begin
            host.machine.cut()
            process.kill()
            process.communicate()
            again = self._again(upper.parent, before, 1 if of_s else 3)
            found = InstallCut(command, round(at_s, 2), round(of_s or at_s, 2), *again)
        shutil.rmtree(upper.parent, ignore_errors=True)
        return found

    def _again(self, work: Path, before: str, answers: int) -> tuple[float, float, str, bool, str]:
        """Boot a host that was cut: the rest of an InstallCut."""
        begin = time.monotonic()
        with nspawn.Machine(
            work / "root", work / "host" / "parcel", work / "again.log", volatile=False
        ) as machine:
            service = nspawn.Service(machine)
            service.until("ActiveState", "active")
            ready_s = int(service["ActiveEnterTimestampMonotonic"]) / 1e6 - begin
            answer, answered_s = _answers(machine, answers)
            answer_s = answered_s - begin
            after = machine.run("readlink", *LINKS).stdout
            rejected = machine.run("cat", "/opt/palpate.rejected").stdout
        wrong = [f"sent back: {rejected}"] * bool(rejected)
        wrong += [f"answered after {answer_s:.1f} s"] * (answer_s > LATEST_S)
        times = round(ready_s, 2), round(answer_s, 2)
        return *times, answer, after != before, "; ".join(wrong)


def _answers(machine: nspawn.Machine, count: int) -> tuple[str, float]:
    """The first answers in the journal, and the time of the first in s. Raises AssertionError."""
    end_s = time.monotonic() + LONGEST_S
    journal = ("journalctl", "-q", "-b", "-u", "palpate", "-o", "json")
    while time.monotonic() < end_s:
        lines = [json.loads(line) for line in machine.get(*journal).splitlines()]
        found = [(line, it) for line in lines if (it := ANSWER.fullmatch(str(line["MESSAGE"])))]
        if len(found) >= count:
            texts = [it[1].strip() for _, it in found[:count]]
            return AND.join(texts), int(found[0][0]["__MONOTONIC_TIMESTAMP"]) / 1e6
        time.sleep(0.2)
    raise AssertionError("no sweep is answered")


def cuts(host: CutHost, commands: Sequence[str], times: int, seed: int) -> Iterator[InstallCut]:
    """The whole run of each command, then its cuts."""
    for command in commands:
        rng = random.Random(f"{command} {seed}")
        whole = host.cut(command, 0.0, 0.0)
        assert whole.new, whole
        yield whole
        for _ in range(times):
            one = host.cut(command, whole.at_s, rng.random())
            if one.answer not in whole.answer.split(AND):
                other = f"{one.wrong}; another answer than {whole.answer!r}".lstrip("; ")
                one = InstallCut(**(asdict(one) | {"wrong": other}))
            yield one


def main() -> int:
    """Print a line for each cut, and one for each command; 1 if anything was wrong."""
    parser = argparse.ArgumentParser("python -m tests.campaigns install-cuts")
    parser.add_argument("commands", nargs="*", default=["install", "apt", "deploy"])
    parser.add_argument("--times", type=int, default=20, help="cuts of each command (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "install-cuts.jsonl")
    args = parser.parse_args()
    done: dict[str, list[InstallCut]] = {}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with stage() as work, args.out.open("w") as out:
        for one in cuts(CutHost(Path(work)), args.commands, args.times, args.seed):
            done.setdefault(one.command, []).append(one)
            print(json.dumps(asdict(one)), file=out, flush=True)
            print(one, flush=True)
    for command, found in done.items():
        ready, answer = (max(getattr(c, n) for c in found) for n in ("ready_s", "answer_s"))
        cut = found[1:]
        wrong, new = sum(bool(c.wrong) for c in cut), sum(c.new for c in cut)
        print(
            f"{command}: {len(cut)} cuts, wrong {wrong}, after {new} of them the new one runs; "
            f"at most {ready:.1f} s to READY, {answer:.1f} s to the first answer"
        )
    return int(any(c.wrong for found in done.values() for c in found))


if __name__ == "__main__":
    sys.exit(main())

"""Delivery, cut short. In: signed bundles that are copied to the box, taken, started, committed and left again. Out: a
scene, whose judge finds each box that does not come back with the old bundle or the new one, whole.

`python -m cuts.delivery copy FROM TO` is what copies a bundle to the box: it syncs nothing. `python -m cuts.delivery WAY
ARGUMENT ...` is `palpate` in one of WAYS: it crashes, or is wrong on purpose.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from subprocess import run

from appliance import bundle, disk, signature
from appliance.__main__ import main
from appliance.ledger import Ledger
from appliance.manifest import SCHEMA
from appliance.shelf import Shelf, Signed
from appliance.trial import Trial
from cuts.calls import NotFollowed
from cuts.scene import Found, Scene, Step

STORE, INCOMING = "store", "store/incoming"
APART = re.compile(r"store/(incoming/.+|bundles/\.[^/]+/.+)")
"""What is copied, until it is accepted, and what is in the folders that are not complete: nobody reads that."""
PROBATION = 2
"""Sweeps."""
ANSWER = re.compile(r"\$PPLP,RES,\d+,[\d.]+,(?:ok|unsure|undecided),(?:[^,]*,){6}([0-9a-f]{8}),")
PROMISE = re.compile(r"bundle ([0-9a-f]{8}) (?:is accepted; it )?runs (?:on trial )?from the next start on.*")
DIED = 3
NAMES = ("packaged", "first", "second", "third", "fourth", "last")
SIMULATED = ("--sim", "skin", "--virtual", "--sweeps")


@dataclass(frozen=True, slots=True)
class Shop:
    """What the box gets, in a folder beside it: bundles of these NAMES, one counter higher each, signed by one key."""

    folder: Path

    @classmethod
    def opened(cls, folder: Path) -> Shop:
        """Make all that."""
        key = folder / "key"
        run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", key], check=True)
        (folder / "signers").write_text(f"shop {key.with_suffix('.pub').read_text()}")
        for counter, name in enumerate(NAMES[1:], 1):
            shutil.copytree(bundle.DEFAULT, folder / name)
            manifest = replace(bundle.load(folder / name).manifest, name=name, counter=counter, schema=SCHEMA).json()
            (folder / name / bundle.MANIFEST).write_bytes(manifest)
            (folder / name / bundle.SIGNATURE).write_bytes(signature.sign(manifest, key))
        return cls(folder)

    def at(self, name: str) -> Path:
        """Where a bundle is before it is delivered."""
        return bundle.DEFAULT if name == "packaged" else self.folder / name

    def words(self, folder: Path, *words: str | Path) -> list[str]:
        """A command of the box in `folder`. @: where bundles are copied to."""
        said = [str(word).replace("@", f"{folder / INCOMING}/") for word in words]
        where = f"store.folder={folder / STORE}", f"store.signers={self.folder / 'signers'}"
        how = "store.status=", f"store.probation_sweeps={PROBATION}"
        return said + [word for value in (*where, *how) for word in ("--set", value)]

    def palpate(self, name: str, *words: str, way: str = "") -> Step:
        """A command of the box, in one of WAYS or as it is."""
        program = ["cuts.delivery", way] if way else ["appliance"]
        code = DIED if way == "crash" else 0
        return Step(name, lambda folder: [sys.executable, "-m", *program, *self.words(folder, *words)], code)

    def copy(self, name: str) -> Step:
        """Somebody copies a bundle to the box."""
        command = [sys.executable, "-m", "cuts.delivery", "copy", self.at(name)]
        return Step(f"copy {name}", lambda folder: [*command, folder / INCOMING / name])

    def story(self) -> Iterator[tuple[str, Step]]:
        """What happens to a box; before each command, which bundles may run if that is cut short."""
        do, once, often = self.palpate, ("run", *SIMULATED, "1"), ("run", *SIMULATED, str(PROBATION))
        yield "packaged", self.copy("first")
        yield "packaged first", do("accept the first ever", "accept", "@first")
        yield "first", do("start and commit it", *often)
        yield "first", self.copy("second")
        yield "first second", do("accept another", "accept", "@second")
        yield "second", do("start it, end in order", *once)
        yield "second", do("start and commit it again", *often)
        yield "second", self.copy("third")
        yield "second third", do("accept one that will crash", "accept", "@third")
        yield "third", do("start it, crash", *once, way="crash")
        yield "third", do("start it, crash again", *once, way="crash")
        yield "second third", do("start it, crash a third time", *once, way="crash")
        yield "second", do("start a fourth time", *once)
        yield "second first", do("roll back", "rollback")
        yield "first", do("start after rolling back", *once)
        yield "first second", do("roll forward", "rollback")
        yield "second", self.copy("fourth")
        yield "second", do("accept as the candidate", "accept", "--shadow", "@fourth")
        yield "second fourth", do("promote the candidate", "promote")
        yield "fourth", do("commit it by hand", "commit")

    def scene(self, way: str = "") -> Scene:
        """The story, each command of which is cut short; way: no more of it than an accept, in one of WAYS."""
        told = list(self.story())
        may = {step.name: names.split() for names, step in told}
        ids = {name: bundle.load(self.at(name)).id for name in NAMES}

        def judge(found: Found) -> list[str]:
            ran = {found.heard} if found.heard else {ids[name] for name in may[found.step]}
            return self._comes_back(found.folder, ran) or self._takes_another(found.folder, ids["last"])

        if way:
            steps: tuple[Step, ...] = (self.palpate("accept another", "accept", str(self.at("second")), way=way),)
            return Scene("delivery", self._delivered, steps, judge, APART, _promised)
        return Scene("delivery", _bare, tuple(step for _, step in told), judge, APART, _promised)

    def _delivered(self, folder: Path) -> None:
        """A box that runs the first bundle."""
        _bare(folder)
        for words in (("accept", self.at("first")), ("run", *SIMULATED, str(PROBATION))):
            code, said = _apart(self.words(folder, *words))
            if code:
                raise NotFollowed(f"{words[0]} ended with {code}: {_end(said)}")

    def _comes_back(self, folder: Path, ids: set[str]) -> list[str]:
        """What is wrong with the box when it starts twice."""
        return [wrong for time in ("first", "second") for wrong in self._answers(folder, f"{time} start", ids)]

    def _answers(self, folder: Path, when: str, ids: set[str]) -> list[str]:
        code, said = _apart(self.words(folder, "run", *SIMULATED, str(PROBATION)))
        names = ANSWER.findall(said)
        if code or len(names) != PROBATION or not set(names) <= ids:
            return [f"{when}: exit code {code}, answers by {set(names)} instead of {ids}: {_end(said)}"]
        return []

    def _takes_another(self, folder: Path, last: str) -> list[str]:
        """What is wrong with the box when the last bundle is delivered and committed."""
        again = folder / INCOMING / "again"
        shutil.copytree(self.at("last"), again)
        code, said = _apart(self.words(folder, "accept", again))
        if code:
            return [f"the next delivery ends with {code}: {_end(said)}"]
        left = [path.name for path in (folder / STORE).rglob("*.part*")]
        return [f"{name} is left" for name in left] + self._answers(folder, "after the next delivery", {last})


def _bare(folder: Path) -> None:
    (folder / INCOMING).mkdir(parents=True)


def _promised(said: str) -> str:
    """The bundle that is to run from the next start on, where a command has ended by saying so."""
    told = PROMISE.fullmatch(said.rstrip("\n").rpartition("\n")[2])
    return told[1] if told else ""


def _end(said: str) -> str:
    return said.strip().rpartition("\n")[2][-300:]


def _apart(words: list[str]) -> tuple[int, str]:
    """Run a command of the box in a child that has its libraries already; exit code, and all that it said."""
    told = os.memfd_create("told")
    sys.stdout.flush()  # or the child says it, too
    child = os.fork()
    if not child:
        os.dup2(told, 1)
        os.dup2(told, 2)
        try:
            os._exit(main(words))
        finally:
            os._exit(DIED)
    _, status = os.waitpid(child, 0)
    with os.fdopen(told, "rb") as file:
        file.seek(0)
        return os.waitstatus_to_exitcode(status), file.read().decode("utf-8", "replace")


def copy(from_: Path, to: Path) -> None:
    """Copy a bundle with plain writes, in place of what is left of an earlier attempt."""
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir()
    for path in sorted(from_.iterdir()):
        (to / path.name).write_bytes(path.read_bytes())


def _gone_for_a_moment(path: Path, target: str) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)
    disk.sync(path.parent)


def _copied(self: Shelf, held: Signed) -> None:
    self.at(held.sha).mkdir()
    for name, data in held.files.items():
        (self.at(held.sha) / name).write_bytes(data)


WAYS: dict[str, tuple[object, str, Callable[..., object]]] = {
    "crash": (Trial, "stopping", lambda self: os._exit(DIED)),
    "right": (disk, "put", disk.put),
    "the link is gone for a moment": (disk, "link", _gone_for_a_moment),
    "the ledger in place": (disk, "put", Path.write_bytes),
    "the link first": (Ledger, "activated", lambda self, sha, counter, now: self),
    "nothing synced": (disk, "sync", lambda path: None),
    "bundles copied": (Shelf, "put", _copied),
}
"""What is put in place of what; after the first two wrong on purpose, and the judge must find that."""


if __name__ == "__main__":
    way, *words = sys.argv[1:]
    if way == "copy":
        copy(Path(words[0]), Path(words[1]))
    else:
        setattr(*WAYS[way])
        sys.exit(main(words))

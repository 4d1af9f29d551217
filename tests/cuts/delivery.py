"""Delivery and enrolment, cut short. Signed bundles are copied to the box, taken, started,
committed and replaced, and the box learns labels.

The judges find each box that does not come back with either the old or the new bundle, whole.
`python -m tests.cuts.delivery WAY ARGUMENT ...` is `palpate` in one of WAYS: it crashes, or is
wrong on purpose.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory
from types import MappingProxyType

from palpate.bundle import bundle
from palpate.bundle.manifest import SCHEMA
from palpate.cli.main import main
from palpate.core import storage
from palpate.deployment import signature
from palpate.deployment.store import SHA
from palpate.deployment.trial import Trial
from tests.cuts.calls import DEADLINE_S, NotFollowed
from tests.cuts.scene import CutScene, Found, SceneStep
from tests.factories.install_scripts import enrolment_key
from tests.factories.paths import ROOT

STORE, INCOMING = "store", "store/incoming"
ENROLMENT = "enrolment"
"""Folder of this box's key, beside the shop's bundles."""
APART = re.compile(r"store/(incoming/.+|teaching/.+|bundles/\.[^/]+/.+)")
"""Copies before they are installed, and contents of incomplete folders: nobody reads these."""
PROBATION = 2
"""Number of sweeps on probation."""
ANSWER = re.compile(r"\$PPLP,RES,\d+,[\d.]+,(?:ok|unsure|undecided),(?:[^,]*,){6}([0-9a-f]{8}),")
PROMISE = re.compile(
    r"bundle ([0-9a-f]{8}) (?:is installed; it )?runs (?:on trial )?from the next start on.*"
    r"|palpate: installed: .*, ([0-9a-f]{8}), \d+ labels; it runs on trial from the next start on.*"
    r"|bundle ([0-9a-f]{8}) with .* is installed, on trial from the next start on.*"
)
DIED = 3
LABELS = ("cork", "felt")
"""Labels that the box learns, one after the other, each from a sweep of another simulated tube."""
NAMES = ("packaged", "first", "second", "third", "fourth", "fifth", "last")
START = ("run", "--sim", "skin", "--virtual", "--sweeps", "1")
START_AND_COMMIT = (*START[:-1], str(PROBATION))
COPY = """
import shutil, sys; from pathlib import Path; old, new = map(Path, sys.argv[1:])
shutil.rmtree(new, ignore_errors=True); new.mkdir()
for path in sorted(old.iterdir()): (new / path.name).write_bytes(path.read_bytes())
"""
"""A user's program that copies a bundle to the box and replaces the remains of an earlier attempt;
it syncs nothing."""


@dataclass(frozen=True, slots=True)
class Shop:
    """A folder with deliveries: bundles of NAMES, rising counters, one key; and the box's key."""

    folder: Path

    @classmethod
    def opened(cls, folder: Path) -> Shop:
        """Make the bundles and keys."""
        key = folder / "key"
        run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", key], check=True)
        (folder / "allowed_signers").write_text(f"shop {key.with_suffix('.pub').read_text()}")
        enrolment_key(folder / ENROLMENT)
        for counter, name in enumerate(NAMES[1:], 1):
            shutil.copytree(bundle.DEFAULT, folder / name)
            held = bundle.load(folder / name).manifest
            manifest = replace(held, name=name, counter=counter, schema=SCHEMA).json()
            (folder / name / bundle.MANIFEST).write_bytes(manifest)
            (folder / name / bundle.SIGNATURE).write_bytes(signature.sign(manifest, key))
        return cls(folder)

    def at(self, name: str) -> Path:
        """The path of a bundle before it is delivered."""
        return bundle.DEFAULT if name == "packaged" else self.folder / name

    def words(self, folder: Path, *words: str | Path) -> list[str]:
        """A command of the box in `folder`. @ stands for the folder to which bundles are copied."""
        output = [str(word).replace("@", f"{folder / INCOMING}/") for word in words]
        where = f"store.folder={folder / STORE}", f"store.keys={self.folder}"
        how = "store.runtime=", f"store.trial_sweeps={PROBATION}"
        return output + [word for value in (*where, *how) for word in ("--set", value)]

    def palpate(self, name: str, *words: str, way: str = "", code: int | None = None) -> SceneStep:
        """A command of the box, in one of WAYS or unchanged. code: its exit code, if another."""
        program = ["tests.cuts.delivery", way] if way else ["palpate"]
        ends = code if code is not None else DIED if way == "crash" else 0
        return SceneStep(
            name, lambda folder: [sys.executable, "-m", *program, *self.words(folder, *words)], ends
        )

    def copy(self, name: str) -> SceneStep:
        """A user copies a bundle to the box."""
        command = [sys.executable, "-S", "-c", COPY, self.at(name)]
        return SceneStep(f"copy {name}", lambda folder: [*command, folder / INCOMING / name])

    def steps(self) -> Iterator[tuple[str, SceneStep]]:
        """The commands on a box, each after the bundles that may run if it is cut short."""
        do = self.palpate
        yield "packaged", self.copy("first")
        yield "packaged first", do("install the first ever", "bundles", "install", "@first")
        yield "first", do("start and commit it", *START_AND_COMMIT)
        yield "first", self.copy("second")
        yield "first second", do("install another", "bundles", "install", "@second")
        yield "second", do("start it, end in order", *START)
        yield "second", do("start and commit it again", *START_AND_COMMIT)
        yield "second", self.copy("third")
        yield "second third", do("install one that will crash", "bundles", "install", "@third")
        yield "third", do("start it, crash", *START, way="crash")
        yield "third", do("start it, crash again", *START, way="crash")
        yield "second third", do("start it, crash a third time", *START, way="crash")
        yield "second", do("start a fourth time", *START)
        yield "second first", do("roll back", "bundles", "rollback")
        yield "first", do("start after rolling back", *START)
        yield "first second", do("roll forward", "bundles", "rollback")
        yield "second", self.copy("fourth")
        yield "second", do("install as the candidate", "bundles", "install", "--shadow", "@fourth")
        yield "second fourth", do("promote the candidate", "bundles", "promote")
        yield "fourth", self.copy("fifth")
        yield (
            "fourth fifth",
            do("install one more while that is on trial", "bundles", "install", "@fifth"),
        )
        yield "fifth second", do("roll back from the trial", "bundles", "rollback")
        yield "second fifth", do("install it again", "bundles", "install", "@fifth")
        yield "fifth", do("commit it by hand", "bundles", "commit")

    def scene(self) -> CutScene:
        """The scene of all steps; each command is cut short."""
        return self._scene("delivery", _bare, list(self.steps()))

    def enrolment(self) -> CutScene:
        """A box learns LABELS, removes one and gets another bundle; each command is cut."""
        return self._scene("enrolment", self._delivered, list(self._enrolments()), self._learned())

    def records(self, label: str) -> SceneStep:
        """The box records a sweep of a new material on the simulated skin."""
        seed = str(LABELS.index(label) + 1)
        skin = ("--sim", "skin", "--virtual", "--seed", seed)
        return self.palpate(f"record {label}", "teach", "--label", label, "--sweeps", "1", *skin)

    def enrols(self, label: str, way: str = "right", name: str = "") -> SceneStep:
        """The box learns the label from its sweep, and signs it."""
        return self.palpate(name or f"enrol {label}", "teach", "--use", way=way, code=0)

    def learns(self, way: str) -> CutScene:
        """A single enrolment, in one of WAYS, on a box that runs the first bundle."""

        def recorded(folder: Path) -> None:
            self._delivered(folder)
            _done(self.records(LABELS[0]), folder)

        steps = [("first cork", self.enrols(LABELS[0], way))]
        return self._scene("enrolment", recorded, steps, self._learned(LABELS[:1]))

    def _enrolments(self) -> Iterator[tuple[str, SceneStep]]:
        """As `steps`; a label stands for the bundle that has learned up to it."""
        do = self.palpate
        yield "first", self.records("cork")
        yield "first cork", self.enrols("cork")
        yield "cork", do("start it and end in order", *START)
        yield "cork", do("start and commit it", *START_AND_COMMIT)
        yield "cork", self.records("felt")
        yield "cork felt", self.enrols("felt")
        yield "felt cork", do("roll back from the trial", "bundles", "rollback")
        yield "cork first", do("roll back", "bundles", "rollback")
        yield "first cork", do("roll forward", "bundles", "rollback")
        yield "cork felt", self.enrols("felt", name="enrol felt again")
        yield "felt", self.copy("second")
        yield "felt", do("commit it by hand", "bundles", "commit")
        yield "felt second", do("install another", "bundles", "install", "@second")

    def _learned(self, labels: tuple[str, ...] = LABELS) -> dict[str, str]:
        """The ids of the bundle with each label added: the same sweeps give the same bytes."""
        with TemporaryDirectory() as aside:
            self._delivered(folder := Path(aside))
            ids = {}
            for label in labels:
                _done(self.records(label), folder)
                ids[label] = _promised(output := _done(self.enrols(label), folder))
                if not ids[label]:
                    raise NotFollowed(f"{label} cannot be enrolled: {_end(output)}")
        return ids

    def alone(self, way: str) -> CutScene:
        """A single install, in one of WAYS, on a box that runs the first bundle."""
        step = self.palpate(
            "install another", "bundles", "install", str(self.at("second")), way=way
        )
        return self._scene("delivery", self._delivered, [("first second", step)])

    def _scene(
        self,
        name: str,
        prepare: Callable[[Path], None],
        reported: list[tuple[str, SceneStep]],
        learned: Mapping[str, str] = MappingProxyType({}),
    ) -> CutScene:
        may = {step.name: names.split() for names, step in reported}
        ids = {name: bundle.load(self.at(name)).id for name in NAMES} | learned

        def judge(found: Found) -> list[str]:
            ran = {found.heard} if found.heard else {ids[name] for name in may[found.step]}
            return self._comes_back(found.folder, ran) or self._takes_another(
                found.folder, ids["last"]
            )

        return CutScene(name, prepare, tuple(step for _, step in reported), judge, APART, _promised)

    def _delivered(self, folder: Path) -> None:
        """A box that runs the first bundle."""
        _bare(folder)
        for words in (("bundles", "install", self.at("first")), START_AND_COMMIT):
            code, output = _apart(self.words(folder, *words))
            if code:
                raise NotFollowed(f"{words[0]} ended with {code}: {_end(output)}")

    def _comes_back(self, folder: Path, ids: set[str]) -> list[str]:
        """Faults of the box when it starts twice."""
        first = self._answers(folder, "first start", ids)
        return first + self._answers(folder, "second start", ids)

    def _answers(self, folder: Path, when: str, ids: set[str]) -> list[str]:
        code, output = _apart(self.words(folder, *START))
        names = ANSWER.findall(output)
        if code or len(names) != 1 or not set(names) <= ids:
            instead = f"answers by {names} instead of {sorted(ids)}: {_end(output)}"
            return [f"{when}: exit code {code}, {instead}"]
        return []

    def _takes_another(self, folder: Path, last: str) -> list[str]:
        """Faults of the box when the last bundle is delivered and committed."""
        again = folder / INCOMING / "again"
        shutil.copytree(self.at("last"), again)
        code, output = _apart(self.words(folder, "bundles", "install", again))
        if code:
            return [f"the next delivery ends with {code}: {_end(output)}"]
        held = [path.name for path in (folder / STORE / "bundles").iterdir()]
        left = [path.name for path in (folder / STORE).iterdir() if path.suffix == storage.PART]
        left += [name for name in held if not SHA.fullmatch(name)]
        wrong = self._answers(folder, "after the next delivery", {last})
        return [f"{name} is left" for name in left] + wrong


def _bare(folder: Path) -> None:
    (folder / INCOMING).mkdir(parents=True)


def _promised(output: str) -> str:
    """The bundle that must run from the next start, if the cut command has announced it."""
    reported = PROMISE.fullmatch(output.splitlines()[-1])
    return next(filter(None, reported.groups())) if reported else ""


def _done(step: SceneStep, folder: Path) -> str:
    """The output of a step that is not cut short."""
    words = step.command(folder)
    done = run(words, cwd=ROOT, capture_output=True, text=True, check=False, timeout=DEADLINE_S)
    if done.returncode:
        raise NotFollowed(f"{step.name} ended with {done.returncode}: {_end(done.stderr)}")
    return done.stderr + done.stdout


def _end(output: str) -> str:
    return output.strip().rpartition("\n")[2][-300:]


def _apart(words: list[str]) -> tuple[int, str]:
    """Exit code and output of a command of the box, in a child with its libraries loaded."""
    reported = os.memfd_create("output")
    sys.stdout.flush()  # otherwise the child prints it too
    child = os.fork()
    if not child:
        signal.alarm(DEADLINE_S)
        sys.stdout = sys.stderr = os.fdopen(reported, "w", 1)
        try:
            os._exit(main(words))
        finally:
            os._exit(DIED)
    _, status = os.waitpid(child, 0)
    with os.fdopen(reported, "rb") as file:
        file.seek(0)
        return os.waitstatus_to_exitcode(status), file.read().decode("utf-8", "replace")


def _gone_for_a_moment(path: Path, target: str) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)
    storage.sync(path.parent)


WAYS: dict[str, tuple[object, str, Callable[..., object]]] = {
    "crash": (Trial, "stopping", lambda self: os._exit(DIED)),
    "right": (storage, "put", storage.put),
    "the link is gone for a moment": (storage, "link", _gone_for_a_moment),
    "the ledger in place": (storage, "put", Path.write_bytes),
}
"""The parts of the program that each way replaces. All but the first two are wrong on purpose, and
the judge must find that."""


if __name__ == "__main__":
    setattr(*WAYS[sys.argv[1]])
    sys.exit(main(sys.argv[2:]))

"""New materials taught into a delivered bundle: from recorded sweeps to the bundle on trial."""

from __future__ import annotations

import errno
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.cli.main import main
from palpate.core.clock import SystemClock
from palpate.core.config import load
from palpate.core.devices import Devices
from palpate.core.errors import ApplianceError, BundleError, ConfigError, ModelError
from palpate.core.observer import Observer
from palpate.deployment.enrolment_key import EnrolmentKey
from palpate.deployment.signed import SignedBundle
from palpate.inference.classifier import Classifier
from palpate.io.robot_link import command
from palpate.learn import enrolment, install, materials
from palpate.learn.program import (
    RecordingPhase,
    TaughtLesson,
    TeachingProgram,
    TryingPhase,
)
from palpate.learn.session import MOST_NAMED, TeachingSession
from palpate.runtime import assembly
from palpate.sim import skin
from palpate.sweeps import sweep_folder
from palpate_train.data.sets import Dataset
from tests.campaigns import junk
from tests.factories import deliveries, lessons
from tests.factories.paths import ROOT

pytestmark = [deliveries.NEEDED, pytest.mark.slow]
WORLD = skin.WORLDS[""]
CORK, FELT = 6, 4
"""Numbers of two new materials."""


def slides(material: int, count: int, first: int = 0) -> list[np.ndarray]:
    """Sweeps of a material that nobody trained, drawn by this number, at different places."""
    tube = junk.random_material(junk.SweepDraw(WORLD, np.random.default_rng(material)))
    world, made = replace(WORLD, tubes=(tube,)), []
    for n in range(first, first + count):
        rng = np.random.default_rng([material, n])
        made.append(skin.window(tube.name, skin.placements("T-REAL", n + 1)[0], rng, world))
    return made


def rests(count: int) -> list[np.ndarray]:
    """Sweeps of a finger that rests."""
    return [junk.window("finger rests", WORLD, n)[0] for n in range(count)]


def record(
    store: Path, material: str, of: list[np.ndarray], first: int, folder: str = "sweeps"
) -> None:
    """Write recorded sweeps of a material, numbered from `first`."""
    labels = np.zeros(len(of), int)
    sweeps = Dataset(np.stack(of), labels, (material,), skin.FORMAT.rate_hz, {}, material)
    lessons.write(store / folder, sweeps, first=first)


class TaughtDelivery:
    """A box in service with a delivered bundle. words: its settings."""

    def __init__(self, folder: Path) -> None:
        delivery = deliveries.Delivery(folder)
        delivery.committed(1)
        self.store = Path(delivery.how.folder)
        sets = [f"store.folder={self.store}", f"store.keys={folder}"]
        self.words = [word for one in sets for word in ("--set", one)]
        self.settings = load(None, sets, site=ROOT / "tests/factories/no-site.toml")

    @property
    def running(self) -> SignedBundle:
        return assembly.store(self.settings).running()

    def teach(self, capsys: Any, *more: str) -> tuple[int, dict[str, Any]]:
        """`palpate teach --json`: its exit code, and its last line."""
        capsys.readouterr()
        code = main(["teach", *self.words, "--json", *more])
        return code, json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.fixture
def box(tmp_path: Path) -> TaughtDelivery:
    """A box with five sweeps of cork beside one of a finger at rest."""
    one = TaughtDelivery(tmp_path)
    record(one.store, "cork", [*rests(1), *slides(CORK, 5)], 1)
    return one


def test_a_new_material_joins_the_delivered_ones(box, capsys):
    """Signed, on trial, without a fit; trained labels stay."""
    before = box.running
    code, learnt = box.teach(capsys)
    assert code == 0
    assert learnt["sweeps"] == 5
    assert "among 7" in learnt["text"]
    code, news = box.teach(capsys, "--use")
    assert code == 0, news
    assert [one["number"] for one in news["no_slides"]] == [1]
    assert news["no_slides"][0]["text"].startswith("sweep 1 of cork is ")
    after = box.running
    assert after.signer == f"{deliveries.SIGNER}, enrolled here"
    assert after.bundle.manifest.labels == (*before.bundle.manifest.labels, "cork")
    assert after.bundle.enrolled == {"cork": 5}
    assert {name: after.files[name] for name in before.files} == dict(before.files)
    assert not (box.store / "teaching").exists()


def test_more_sweeps_another_material_and_a_forgotten_one(box, capsys):
    """Each USE learns anew; enrolled ones stay."""
    box.teach(capsys, "--use")
    first = box.running.bundle
    record(box.store, "cork", slides(CORK, 2, first=10), 10)
    assert box.teach(capsys, "--use")[0] == 0
    assert box.running.bundle.enrolled == {"cork": 7}
    record(box.store, "felt", slides(FELT, 1), 20)
    assert box.teach(capsys, "--use")[0] == 0
    assert box.running.bundle.enrolled == {"cork": 7, "felt": 1}
    assert main(["teach", *box.words, "--forget", "cork"]) == 0
    assert box.teach(capsys, "--use")[0] == 0
    assert box.running.bundle.enrolled == {"felt": 1}
    assert first.enrolled == {"cork": 5}


def test_a_material_keeps_its_name_for_people(box, capsys):
    """Through every later USE; labels of the bundle are taken."""
    for path in sorted((box.store / "sweeps").glob("*.json")):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"display": "木"}))
    assert box.teach(capsys, "--use")[0] == 0
    assert box.running.bundle.manifest.displays == {"cork": "木"}
    for path in (box.store / "sweeps").glob("sweep-*"):
        path.unlink()
    record(box.store, "felt", slides(FELT, 2), 20)
    assert box.teach(capsys, "--use")[0] == 0
    assert box.running.bundle.manifest.displays == {"cork": "木"}
    devices = Devices(SystemClock())
    typed = TeachingProgram(box.settings, devices, skin.FORMAT, TaughtLesson()).names
    assert [typed.label(name) for name in ("木", "felt", "石")] == ["cork", "felt", "material"]
    assert {*box.running.bundle.manifest.labels} <= {*typed.displays, *typed.plain}


@pytest.mark.parametrize(
    ("name", "code"), [("cork ", 0), ("木", 0), ("corc", 78), ("石", 78), ("cork,", 78)]
)
def test_a_material_is_forgotten_by_its_label_or_its_name(box, capsys, name, code):
    """A slip forgets nothing, and is said."""
    for path in (box.store / "sweeps").glob("*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"display": "木"}))
    assert main(["teach", *box.words, "--forget", name]) == code
    assert (name.strip(" ,") in capsys.readouterr().err) == bool(code)
    held = {"cork": [1, 2, 3, 4, 5, 6]}
    assert sweep_folder.forgotten_in(box.store / "sweeps") == ({} if code else held)


def test_a_delivery_during_use_is_not_replaced(box, capsys, monkeypatch):
    """It stays, and a line says so to the person who teaches."""
    taught = materials.taught

    def slowly(*given: Any, **more: Any) -> enrolment.Enrolment:
        made = taught(*given, **more)
        (box.store / "current").unlink()  # stands for any other bundle
        return made

    with monkeypatch.context() as patched:
        patched.setattr(materials, "taught", slowly)
        code, news = box.teach(capsys, "--use")
    assert code
    assert "meanwhile" in news["text"]
    assert not (box.store / "current").exists()


def test_a_label_without_recorded_sweeps_stays(box, capsys):
    """One that `enrol` has added, whose sweeps are not kept, has the same mean after each USE."""
    store, key = assembly.store(box.settings), EnrolmentKey(box.settings.store.enrolment_key)
    running = box.running
    new = materials.taught(running, {"wool": np.stack(slides(FELT, 2))})
    store.learn(enrolment.files(running.files, new, key.sign(new.file)))
    for _ in range(2):
        assert box.teach(capsys, "--use")[0] == 0
        assert box.running.bundle.enrolled == {"wool": 2, "cork": 5}
        assert box.running.bundle.classes
        assert np.array_equal(box.running.bundle.classes.means[-2], new.bundle.classes.means[-1])


def test_kept_sweeps_of_an_unknown_material_are_taught(box, capsys):
    """Listed, and chosen by one of them; without the skin they become a material."""
    record(box.store, "", slides(FELT, 3), 1, "black-box")
    for number in (1, 2, 3):
        path = box.store / "black-box" / f"sweep-{number:06d}.json"
        verdict = {"status": "unknown", "bundle": box.running.bundle.id, "detail": "; as sweep 1"}
        path.write_text(json.dumps(json.loads(path.read_text()) | {"verdict": verdict}))
    (box.store / "black-box" / "sweep-000002.npy").write_bytes(b"damaged")
    assert main(["teach", *box.words, "--unknown"]) == 0
    assert capsys.readouterr().out.startswith("3 sweeps: 1, 2, 3")
    assert main(["teach", *box.words, "--unknown", "3", "--label", "foam"]) == 78
    code, news = box.teach(capsys, "--unknown", "3", "--label", "felt", "--use")
    assert code == 0, news
    assert box.running.bundle.enrolled == {"cork": 5, "felt": 2}


def test_nothing_new_leaves_the_bundle_in_service(box, capsys):
    """Sweeps of trained materials, of rests alone, or of another format teach nothing."""
    assert main(["teach", *box.words, "--forget", "cork"]) == 0
    record(box.store, "foam", slides(CORK, 3), 20)
    record(box.store, "oak", rests(3), 30)
    before = box.running.sha
    code, news = box.teach(capsys, "--use")
    assert code == 1
    assert "material" in news["text"]
    assert news["text"].endswith("in service stays")
    code, news = box.teach(capsys)
    assert code == 1
    assert "material" in news["text"]
    assert box.running.sha == before


def test_sweeps_that_disagree_are_refused(box, capsys):
    """As by `enrol`: the sweep that is most of all another material is named."""
    record(box.store, "oak", [*slides(CORK, 4), *slides(FELT, 1)], 20)
    code, news = box.teach(capsys, "--use")
    assert code == 1
    assert "'oak'" in news["text"]
    assert "number 5" in news["text"]


@pytest.mark.parametrize(
    "error", [ModelError("std::bad_alloc"), OSError(errno.ENOSPC, "No space left on device")]
)
@pytest.mark.parametrize("more", [(), ("--use",)], ids=["assess", "use"])
def test_a_model_or_disk_that_fails_leaves_the_bundle_in_service(
    box, capsys, monkeypatch, error, more
):
    """The reason is a line for the page; the next attempt succeeds."""
    before = box.running.sha

    def fail(*given: object) -> None:
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(Classifier, "outputs", fail)
        code, news = box.teach(capsys, *more)
    assert code
    assert news["type"] == "error"
    assert news["text"].endswith("in service stays")
    assert box.running.sha == before
    assert box.teach(capsys, *more)[0] == 0


def test_a_reader_that_is_gone_gets_an_exit_code(box):
    """Standard output is full: the result could not be told, and nothing hangs or is half done."""
    words = [sys.executable, "-P", "-m", "palpate", "teach", *box.words, "--json", "--use"]
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            words, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120
        )
    assert done.returncode
    assert "Traceback" not in done.stderr
    assert box.running.bundle.enrolled in ({}, {"cork": 5})


def test_a_taught_bundle_and_another_skin_are_fitted_anew(box):
    """Only a delivered bundle for this skin is taught into; the packaged one is not."""
    store = assembly.store(box.settings)
    assert install.base(store, skin.FORMAT)
    assert install.base(store, None)
    assert install.base(store, replace(skin.FORMAT, rows=8)) is None
    assert install.base(store, replace(skin.FORMAT, window=900))
    files = {**box.running.files}
    del files[bundle.SIGNATURE]
    assert not materials.delivered(SignedBundle(box.running.bundle, "", files))
    (box.store / "current").unlink()
    assert install.base(store, skin.FORMAT) is None


def test_early_answers_are_refused_before_a_sweep(box):
    """They cannot name a label without heads."""
    classifier = replace(box.settings.classifier, early=True)
    with pytest.raises(ConfigError, match=r"classifier.early"):
        materials.check_settings(replace(box.settings, classifier=classifier))


def test_a_sweep_of_another_new_material_is_suspected(box):
    """Left out, it is named as what it is."""
    found = materials.recorded(box.running.bundle, box.store / "sweeps")
    other = slides(FELT, 4)
    mixed = {"cork": np.stack([*found.windows["cork"], other[0]]), "felt": np.stack(other[1:])}
    files = {"cork": [f"sweep-{n:06d}" for n in range(2, 8)], "felt": ["a", "b", "c"]}
    learnt = materials.assessed(box.running, materials.NewSweeps(mixed, files)).json()
    (suspect,) = learnt["suspects"]
    assert re.fullmatch("sweep 6 of cork .* felt", suspect["text"])
    assert suspect["sweep"] == "sweep-000007"
    assert suspect["text"] in learnt["advice"]
    with pytest.raises(BundleError, match="material"):
        materials.assessed(box.running, materials.NewSweeps({}, {}))


def test_the_session_needs_one_material_and_refuses_trained_ones(tmp_path):
    """Beside the delivered labels one material is enough; class bits count all."""

    def sessions(folder: Path, codes: int) -> TeachingSession:
        """A session with a bundle of oak and pine, into which cork was taught."""
        from palpate.core.config import TeachConfig
        from palpate.sweeps.recording import Labels, RecordingSession

        def say(line: bytes) -> None:
            pass

        sweeps = folder / "sweeps"
        recording = RecordingSession(sweeps, skin.FORMAT, Labels(), SystemClock(), say, 3)
        base = ("oak", "pine", "cork")
        return TeachingSession(
            recording, TeachConfig(), lambda by: [], say, codes=codes, base=base, trained=base[:2]
        )

    session: TeachingSession = sessions(tmp_path, codes=8)
    with pytest.raises(ConfigError, match="'oak'"):
        session.commands["TEACH"]("oak")
    for again in ("oak", " oak"):
        with pytest.raises(ConfigError, match="'oak'"):
            session.recording_commands["MATERIAL"](again)
    assert session.materials() == {}
    with pytest.raises(Exception, match="0 materials"):
        session.commands["USE"]("")
    assert session.about()["fewest"] == 1
    assert session.about()["base"] == ["oak", "pine", "cork"]
    narrow = sessions(tmp_path / "narrow", codes=4)
    with pytest.raises(ConfigError, match="4 labels"):
        narrow.commands["TEACH"]("felt")
    assert narrow.commands["TEACH"]("cork") == ["cork", 0]


def test_a_trained_material_is_refused_before_a_sweep(box, capsys):
    """In the terminal, and by page or line after a trial."""
    words = [*box.words, "--label", "foam", "--sim", "skin", "--virtual"]
    recorded = sorted((box.store / "sweeps").iterdir())
    assert main(["teach", *words]) == ConfigError.exit_code
    assert "'foam'" in capsys.readouterr().err
    assert sorted((box.store / "sweeps").iterdir()) == recorded
    settings = replace(box.settings, trigger=replace(box.settings.trigger, mode="serial"))
    format, page = box.running.bundle.format, (Observer(),)
    program = TeachingProgram(settings, Devices(SystemClock()), format, TaughtLesson())
    program.pages, program.address = page, ""
    with ExitStack() as stack:
        phase = TryingPhase(program, stack)
        with pytest.raises(ConfigError, match="'foam'"):
            phase.orders["TEACH"]("foam")
        assert phase.orders["TEACH"]("cork") == ["cork"]


@contextmanager
def by_line(box: TaughtDelivery, *, allowed: bool) -> Iterator[RecordingPhase]:
    """A box that records with commands of its serial line. allowed: teach.serial."""
    trigger, teach = box.settings.trigger, box.settings.teach
    settings = replace(box.settings, trigger=replace(trigger, mode="serial"))
    settings = replace(settings, teach=replace(teach, serial=allowed))
    devices = Devices(SystemClock())
    program = TeachingProgram(settings, devices, skin.FORMAT, TaughtLesson(waits="no page"))
    program.pages, program.address = (), ""
    with ExitStack() as stack:
        yield RecordingPhase(program, stack)


@pytest.mark.parametrize("name", ["TEACH", "MATERIAL"])
@pytest.mark.parametrize("allowed", [False, True])
def test_a_flood_of_names_by_the_line_is_bounded(box, allowed, name):
    """7,160 names: without teach.serial none is taken, with it a page has few to show."""
    taken = 0
    with by_line(box, allowed=allowed) as phase:
        for number in range(7160):
            with suppress(ApplianceError):
                phase.box.obey(command(name, f"name {number}"))
                taken += 1
        shown = phase.about()
    assert (taken > 0) is allowed
    assert [*shown["teach"]["materials"].values()].count(0) <= MOST_NAMED
    assert len(json.dumps(shown)) < 10_000


@pytest.mark.parametrize("allowed", [False, True])
def test_the_robot_labels_nothing_unless_it_may_teach(box, allowed):
    """With teach.serial = false the page alone sets labels, discards, teaches and forgets."""
    orders = (("MATERIAL", "felt"), ("POSITION", "2"), ("SESSION", "b"), ("NEXT", ""))
    with by_line(box, allowed=allowed) as phase:
        for name, text in (*orders, ("TEACH", "felt"), ("FORGET", "felt"), ("DISCARD", "")):
            before = phase.about()
            try:
                phase.box.obey(command(name, text))
                refused = ""
            except ApplianceError as e:
                refused = str(e)
            assert ("teach" in refused) is not allowed, name
            assert allowed or phase.about() == before
        for name, text in orders:
            assert phase.orders[name](text)

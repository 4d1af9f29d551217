"""The store: which bundles a box installs, runs and goes back to."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.cli import bundle_commands
from palpate.core.config import StoreConfig
from palpate.core.errors import ApplianceError, BundleError, ConfigError, ModelError, TemporaryError
from palpate.deployment import store
from palpate.deployment.state import MOST_STARTS, PACKAGED, Standing, StoreState, TrialProgress
from tests.campaigns import flips
from tests.factories import deliveries
from tests.factories.deliveries import Delivery

pytestmark = deliveries.NEEDED
Ways = Callable[[Delivery], object]


@pytest.fixture
def box(tmp_path: Path) -> Delivery:
    """A box without a delivered bundle."""
    return Delivery(tmp_path)


def test_a_fresh_box_runs_the_packaged_bundle(box):
    """Nothing current, nothing to commit or go back to, no folder."""
    assert box.start() == PACKAGED
    assert not box.store.commit()
    nowhere = store.Store(StoreConfig(folder=str(box.folder / "none")), prove=lambda b: None)
    assert (
        nowhere.choose().bundle.id == nowhere.running().bundle.id == bundle.load(bundle.DEFAULT).id
    )
    assert nowhere.candidate() is None
    with pytest.raises(BundleError, match="candidate"):
        box.store.promote()


def test_the_progress_of_a_trial_is_noted(box):
    """Starts, sweeps and seconds. A start that ended in order counts for no boot, and its progress
    holds."""
    for counted in (True, False):
        box.store.note("a", TrialProgress(2, 3, 12.3, True), counted=counted)
        kept = box.store.state.of("a")
        held = (0, 0, 3, 12.3) if counted else (3, 12.3, 0, 0)
        assert (kept.sweeps, kept.streamed_s, kept.last_sweeps, kept.last_s) == held
        assert (kept.starts, kept.worked) == (2, True)
        assert bool(kept.boot) is counted


@pytest.mark.parametrize("sha", ["a", "z"])
def test_what_comes_after_a_committed_bundle_is_on_trial(sha):
    """It goes back to the committed one, which stays as it is."""
    state = StoreState(candidate=sha)
    after = state.activated(sha, 3, "m")
    assert after == StoreState(standings={sha: Standing("m", 3, committed=False)})
    assert after.activated("m", 1, sha) == after


SEQUENCES = {
    "nothing to go back to": "back:-",
    "tried, committed, gone back from": "+1 run:1 ok run:1 +2 ok run:2 back:1 run:1 back:2 run:2",
    "the packaged bundle": "+1 back:0 run:0 +1 ok back:0 run:0 back:1 run:1",
    "three starts without a commit": "+1 ok +2 run:2 run:2 run:2 run:1 run:1",
    "a second trial": "+1 ok +2 +3 run:3 back:1 back:0",
    "two trials that fail": "+1 ok +2 ok +3 +4 run:4 run:4 run:4 run:2 back:1 run:1",
    "a second trial of one that was committed": (
        "+1 ok +2 ok back:1 +2 run:2 run:2 run:2 run:1 back:-"
    ),
    "what runs deployed again": "+1 ok +1 is:1 +2 run:2 run:2 +2 run:2 run:2 run:2 run:1",
    "the committed one deployed again": "+1 ok +2 +1 is:1 run:1 back:0",
    "an older bundle": "+1 ok +2 ok back:1 old:1 old:2 is:1 +2 run:2",
    "a trial does not raise the counter": "+1 ok +9 run:9 +2 run:2",
    "kept for two rollbacks": "+1 ok +2 ok +3 ok +4 ok +5 back:4 back:3",
}
"""Steps: +N installs the bundle with counter N, ok commits, run:N is a start that runs N (0: the
packaged bundle), back:N a rollback to N (-: refused), old:N another bundle with counter N, which is
refused, is:N asks which is current and committed."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SEQUENCES)
def test_what_runs_after(box, name):
    """Installs, commits, starts and rollbacks in any order lead to the bundle of the table."""
    shas = {"0": PACKAGED}
    for step in SEQUENCES[name].split():
        act, _, n = step.partition(":")
        if act == "ok":
            assert box.store.commit()
        elif act == "run":
            assert box.start() == shas[n], step
        elif act == "is":
            assert box.store.current == shas[n]
            assert box.store.state.of(shas[n]).committed
        elif act == "old":
            with pytest.raises(BundleError, match=f"counter {n}, and 2"):
                box.store.install(box.made(int(n), version="other"))
        elif step == "back:-":
            with pytest.raises(BundleError):
                box.store.rollback()
        elif act == "back":
            assert box.store.rollback() == shas[n], step
        else:
            shas[act[1:]] = box.installed(int(act[1:]))


@pytest.mark.slow
def test_the_table_says_what_a_person_wants_to_know(box, logged):
    """One line a bundle; a reason to leave it is logged once."""
    one, two = box.committed(1), box.store.install(box.made(2, name="tubes", version="7"))
    box.start()
    lines = bundle_commands.lines(bundle_commands.entries(box.store))
    assert [line.split()[0] for line in lines] == ["role", "on", "previous", "kept"]
    assert f"on trial  {two[:8]}  tubes 7" in lines[1]
    assert re.search(r"anna.* 1 of 3, 0 of 5.*600", lines[1])
    assert one[:8] in lines[2]
    logged.clear()
    assert [box.start() for _ in range(MOST_STARTS + 1)] == [two, two, one, one]
    assert len(logged) == 3
    told = {e.sha: (e.role, e.detail) for e in bundle_commands.entries(box.store)}
    assert told[one][0] == "current"
    assert told[two][0] == "left"
    assert told[two][1] in logged[-1]


def changed(act: Callable[[Path], object], name: str = "") -> Ways:
    """A way to change a bundle, or one of its files, before it is installed."""

    def way(box: Delivery) -> Path:
        folder = box.made(1)
        act(folder / name)
        return folder

    return way


def flip(path: Path) -> None:
    """Change one bit in the middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def linked(model: Path) -> None:
    """A link to the right model."""
    model.rename(model.with_name("elsewhere"))
    model.symlink_to(model.with_name("elsewhere"))


def piped(manifest: Path) -> None:
    """A pipe that nobody writes to."""
    manifest.unlink()
    os.mkfifo(manifest)


BAD: dict[str, tuple[Ways, str]] = {
    "unsigned": (lambda box: box.copied(deliveries.files(1, None)), "is not signed"),
    "another's key": (
        lambda box: box.copied(deliveries.files(1, deliveries.key(box.folder / "theirs"))),
        "by none of the signers",
    ),
    "no bundle": (lambda box: box.folder, "no bundle at"),
    "too new": (lambda box: box.made(1, runtime="99.0.0"), r"palpate 99\.0\.0"),
    "never counted": (lambda box: box.made(0), "counter 0"),
    "model altered": (changed(flip, bundle.MODEL), "was altered"),
    "golden altered": (changed(flip, bundle.GOLDEN), "was altered"),
    "manifest altered": (changed(flip, bundle.MANIFEST), "."),
    "signature altered": (changed(flip, bundle.SIGNATURE), "."),
    "link": (changed(linked, bundle.MODEL), "cannot be read"),
    "huge": (changed(lambda path: os.truncate(path, 10 << 30), bundle.MODEL), "more than"),
    "pipe": (changed(piped, bundle.MANIFEST), "no plain file"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_bundle_is_refused_and_leaves_nothing(box, name):
    """With its reason; bundle, state and folder do not change."""
    one = PACKAGED if name == "never counted" else box.committed(1)  # which is also below that one
    before = box.store.state
    make, why = BAD[name]
    with pytest.raises(BundleError, match=why):
        box.store.install(make(box))
    assert (box.store.current, box.store.state) == (one, before)
    assert [p.name for p in box.store.bundles.folder.glob("*")] == [one] * bool(one)


def test_what_was_checked_is_written_and_nothing_else(box):
    """Files changed after the check, and files that the manifest does not name, are not copied."""
    folder = box.made(1)
    (folder / "extra").write_bytes(b"x")
    sha = box.store.install(folder)
    names = {bundle.MANIFEST, bundle.SIGNATURE, bundle.MODEL, bundle.GOLDEN, bundle.MEANS}
    assert {p.name for p in box.store.bundles.at(sha).iterdir()} <= names
    folder = box.made(1)

    def change(held: Bundle) -> None:
        for path in folder.iterdir():
            path.write_bytes(b"changed")

    changing = store.Store(box.how, change)
    sha = changing.install(folder)
    assert box.store.bundles.get(sha).sha == sha


def hang(held: Bundle) -> None:
    """Never ends."""
    while True:
        pass


@pytest.mark.parametrize(
    ("does", "why"),
    [
        (lambda b: os.kill(os.getpid(), signal.SIGKILL), "SIGKILL"),
        (lambda b: bytearray(1 << 30), "more than 192 MB"),
        (lambda b: [][0], "IndexError"),
        (hang, r"within 0\.2 s"),
    ],
    ids=["dies", "asks for memory", "raises", "hangs"],
)
def test_a_model_that_kills_its_runtime_is_refused(tmp_path, monkeypatch, does, why):
    """It runs in a child, and what became of it is said."""
    if does is hang:
        monkeypatch.setattr("palpate.deployment.sandbox.DEADLINE_S", 0.2)
    box = Delivery(tmp_path, does)
    with pytest.raises(BundleError, match=why):
        box.installed(1)
    assert box.store.current == PACKAGED


@pytest.mark.slow
def test_a_bundle_that_fails_its_trial_at_the_start_is_left_in_that_start(box, logged):
    """The committed bundle runs."""
    one = box.committed(1)
    two = box.installed(2)
    (box.store.bundles.at(two) / bundle.MODEL).write_bytes(b"rotten")
    assert box.start() == one
    assert "altered" in logged[-1]
    for counter, error in (
        (3, BundleError("golden sweeps differ")),
        (4, ConfigError("no early heads")),
    ):

        def prove(held: Bundle, error: Exception = error) -> None:
            raise error

        box.installed(counter)
        assert store.Store(box.how, prove).choose().folder.name == one
        assert str(error) in logged[-1]


def test_a_committed_bundle_that_is_refused_stops_the_box(box):
    """No other is chosen; the named way back works."""
    one, two = box.committed(1), box.committed(2)
    shutil.rmtree(box.store.bundles.at(two))
    with pytest.raises(BundleError, match="rollback"):
        box.start()
    assert box.store.rollback() == one == box.start()


def test_what_was_changed_by_hand_is_refused(box):
    """Another signed bundle under its name; a link out of the store."""
    one, two = box.committed(1), box.committed(2)
    shutil.rmtree(box.store.bundles.at(two))
    shutil.copytree(box.store.bundles.at(one), box.store.bundles.at(two))
    with pytest.raises(BundleError, match="another"):
        box.start()
    link = Path(box.how.folder, "current")
    link.unlink()
    link.symlink_to("/etc")
    with pytest.raises(BundleError, match="/etc"):
        box.start()


def test_a_removed_state_is_told(box, logged):
    """Committed counters are unknown: said at starts and deliveries; not on a new box."""
    box.committed(5)
    assert not any("missing" in line for line in logged)
    Path(box.how.folder, "bundles.json").unlink()
    box.start()
    assert "bundles" in logged[-1]
    logged.clear()
    box.installed(3)
    assert any("bundles" in line for line in logged)


@pytest.mark.parametrize(
    ("least", "counter", "error"),
    [
        ("4\n", 3, BundleError),
        ("4\n", 4, None),
        ("3\n", 5, None),
        ("four", 5, ConfigError),
        ("", 5, ConfigError),
    ],
)
def test_a_counter_of_root_refuses_what_the_removed_state_would_accept(box, least, counter, error):
    """The delivery before had this counter, and the service's user has removed all of the store;
    a file without a number accepts nothing."""
    box.installed(4)
    box.how.least_counter.write_text(least)
    shutil.rmtree(box.how.folder)
    Path(box.how.folder).mkdir()
    with pytest.raises(error) if error else nullcontext():
        assert box.installed(counter) == box.store.current


def test_a_damaged_bundle_is_mended_by_deploying_it_again(box):
    """Its folder is replaced by a complete folder, even if the bundle is current."""
    one = box.committed(1)
    (box.store.bundles.at(one) / bundle.MODEL).write_bytes(b"rotten")
    assert [e.role for e in bundle_commands.entries(box.store)] == ["previous", "damaged"]
    assert box.installed(1) == one == box.start()
    assert os.listdir(box.store.bundles.folder) == [one]


@pytest.mark.slow
def test_leftovers_and_old_bundles_go_at_the_next_install(box):
    """Incomplete folders are removed, and bundles to which no other bundle goes back."""
    shas = [box.committed(n) for n in range(1, 5)]
    left = box.store.bundles.folder / f".{shas[0]}-abc"
    left.mkdir()
    (left / "model.onnx").write_bytes(b"half")
    five = box.installed(5)
    assert (
        set(os.listdir(box.store.bundles.folder))
        == {five, *shas[2:]}
        == set(box.store.state.standings)
    )
    assert box.store.rollback() == shas[3]
    assert box.store.rollback() == shas[2]


@pytest.mark.slow
def test_a_candidate_waits_and_is_promoted(box):
    """The candidate does not change which bundle runs. After its promotion it is on trial."""
    one = box.committed(1)
    two = box.store.install(box.made(2), shadow=True)
    assert box.start() == one
    candidate = box.store.candidate()
    assert candidate
    assert candidate.id == two[:8]
    assert [(e.role, e.sha) for e in bundle_commands.entries(box.store)][-1] == ("candidate", two)
    assert box.store.promote() == two == box.start()
    assert box.store.candidate() is None
    with pytest.raises(BundleError, match="candidate"):
        box.store.promote()
    assert box.store.rollback() == one
    box.store.install(box.made(3), shadow=True)
    box.committed(4)
    with pytest.raises(BundleError, match="3, and 4"):
        box.store.promote()


def test_one_command_at_a_time(box, monkeypatch):
    """A second waits for a limited time; only the owner may change the store."""
    monkeypatch.setattr(store, "LOCK_S", 0.1)
    box.installed(1)
    with box.store._locked(), pytest.raises(ApplianceError, match="use"):
        store.Store(box.how, lambda b: None).commit(wait_s=0.1)
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    with pytest.raises(ConfigError, match="user"):
        box.store.commit()


@pytest.mark.slow
def test_a_disk_that_takes_no_note_runs_what_was_committed(box, monkeypatch, logged):
    """An uncounted start could loop for ever."""

    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device", str(path))

    for committed in (lambda: PACKAGED, lambda: box.committed(1)):
        before, tried = committed(), box.installed(2)
        with monkeypatch.context() as patch:
            patch.setattr("palpate.core.storage.put", full)
            assert box.start() == before
            assert "space" in logged[-1]
        assert box.start() == tried
        box.store.rollback()


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"floor": 1}',
        '{"standings": []}',
        '{"standings": {"": []}}',
        '{"standings": {"": {"starts": "many"}}}',
    ],
)
def test_a_state_that_cannot_be_read_is_named(box, text):
    """Its content is not guessed."""
    box.installed(1)
    Path(box.how.folder, "bundles.json").write_text(text)
    with pytest.raises(BundleError, match=r"bundles\.json"):
        box.start()


@pytest.mark.slow
@pytest.mark.thorough  # hundreds of altered bundles
def test_no_altered_bundle_is_accepted(tmp_path):
    """A sample of `python -m tests.campaigns flips`, with and without an enrolled label: flipped
    bits in each file, files of another signed bundle, cut files, unsigned and older bundles."""
    found = flips.campaign(tmp_path, 50, seed=2)
    assert found[flips.FLIPPED]["tried"] == 50
    assert sum(kind.startswith(flips.ENROLLED) for kind in found) >= 14
    assert len(found) >= 28
    assert not any(
        count["accepted"] or count["believed"] or count["changed"] for count in found.values()
    )


def test_a_slow_check_does_not_count_against_a_trial(tmp_path, monkeypatch):
    """ssh-keygen too slow: restarted, and still on trial."""
    box = Delivery(tmp_path)
    box.committed(1)
    two = box.installed(2)

    def slow(*words: object, **options: object) -> None:
        raise subprocess.TimeoutExpired("ssh-keygen", 10)

    with monkeypatch.context() as slowly:
        slowly.setattr(subprocess, "run", slow)
        for _ in range(5):
            with pytest.raises(TemporaryError) as e:
                box.store.choose()
            assert e.value.exit_code == 75
    assert box.start() == two
    assert box.store.state.of(two).starts == 1


def test_memory_that_is_short_at_a_start_counts_and_the_trial_goes_on(tmp_path):
    """Restarted; it gives way after MOST_STARTS."""
    short: list[str] = []

    def prove(bundle: Bundle) -> None:
        if bundle.manifest.counter == 2 and short:
            raise ModelError(f"no memory for the model: {short.pop()}; end other programs")

    box = Delivery(tmp_path, prove)
    one = box.committed(1)
    two = box.installed(2)
    short.append("std::bad_alloc")
    with pytest.raises(ModelError) as e:
        box.start()
    assert e.value.exit_code == 70
    assert box.store.state.of(two).starts == 1
    assert box.start() == two
    short.extend(["std::bad_alloc"] * MOST_STARTS)
    for _ in range(MOST_STARTS - 2):
        with pytest.raises(ModelError):
            box.start()
    assert box.start() == one

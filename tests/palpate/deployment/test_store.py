"""The store: which bundles a box installs, runs and goes back to."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.cli import bundle_commands
from palpate.core.config import StoreConfig
from palpate.core.errors import (
    ApplianceError,
    BundleError,
    ConfigError,
    ModelError,
    TemporaryError,
)
from palpate.deployment import store
from palpate.deployment.state import MOST_STARTS, PACKAGED
from tests.campaigns import flips
from tests.factories import deliveries
from tests.factories.deliveries import Delivery

pytestmark = deliveries.NEEDED
Ways = Callable[[Delivery], object]


@pytest.fixture
def box(tmp_path: Path) -> Delivery:
    """A box without a delivered bundle."""
    return Delivery(tmp_path)


def test_a_fresh_box_runs_the_packaged_bundle(box: Delivery):
    """Nothing was deployed: no current bundle, nothing to commit, nothing to go back to, no store
    folder needed."""
    assert box.start() == PACKAGED
    assert not box.store.commit()
    with pytest.raises(BundleError, match="no committed bundle to go back to"):
        box.store.rollback()
    nowhere = store.Store(StoreConfig(folder=str(box.folder / "none")), prove=lambda b: None)
    assert (
        nowhere.choose().bundle.id == nowhere.running().bundle.id == bundle.load(bundle.DEFAULT).id
    )
    assert nowhere.candidate() is None


@pytest.mark.slow
def test_an_accepted_bundle_is_tried_committed_and_gone_back_from(box: Delivery, logged: list[str]):
    """Two bundles are installed, tried and committed one after the other; rollbacks alternate
    between them."""
    one = box.installed(1)
    chosen = box.store.choose()
    assert chosen.trial
    assert (chosen.folder.name, chosen.bundle.manifest.counter) == (one, 1)
    assert logged == [f"bundle {one[:8]} is on trial, start 1 of 3"]
    assert box.store.commit()
    assert box.store.choose().trial is None
    two = box.committed(2)
    assert box.start() == two
    for back in (one, two, one):
        assert box.store.rollback() == back
        assert box.start() == back
    assert len(logged) == 1


@pytest.mark.slow
def test_the_first_bundle_goes_back_to_the_packaged_one(box: Delivery):
    """A failed trial and a rollback lead to the packaged bundle, a second rollback to the installed
    bundle again."""
    one = box.installed(1)
    assert box.store.rollback() == PACKAGED == box.start()
    assert box.installed(1) == one
    box.store.commit()
    assert box.store.rollback() == PACKAGED == box.start()
    assert box.store.rollback() == one == box.start()


@pytest.mark.slow
def test_three_uncommitted_starts_go_back(box: Delivery, logged: list[str]):
    """The fourth start runs the committed bundle and logs one line; `palpate bundles` has the
    reason."""
    one, two = box.committed(1), box.installed(2)
    assert [box.start() for _ in range(MOST_STARTS)] == [two] * MOST_STARTS
    logged.clear()
    assert [box.start(), box.start()] == [one, one]
    assert logged == [
        f"<4>bundle {two[:8]} has failed its trial, and {one[:8]} runs again: it was started 3 "
        "times without being committed"
    ]
    told = {e.sha: e for e in bundle_commands.entries(box.store)}
    assert (told[two].role, told[two].detail) == (
        "left",
        "it was started 3 times without being committed",
    )
    assert told[one].role == "current"


@pytest.mark.slow
def test_a_second_trial_goes_back_to_what_was_committed(box: Delivery):
    """After the second trial the box does not go back to the first bundle, which was never
    committed."""
    one, two, three = box.committed(1), box.installed(2), box.installed(3)
    assert box.start() == three
    assert box.store.rollback() == one
    told = {e.sha: e.role for e in bundle_commands.entries(box.store)}
    assert told == {one: "current", two: "left", three: "left", PACKAGED: "previous"}
    assert box.store.rollback() == PACKAGED


@pytest.mark.slow
def test_two_trials_that_fail_leave_the_way_back(box: Delivery):
    """The bundle before the committed bundle is kept, however many bundles were tried since."""
    one, two = box.committed(1), box.committed(2)
    box.installed(3)
    box.installed(4)
    assert [box.start() for _ in range(MOST_STARTS + 1)][-1] == two
    assert box.store.rollback() == one == box.start()


@pytest.mark.slow
def test_a_bundle_that_failed_a_second_trial_is_not_gone_back_to(box: Delivery):
    """A bundle is committed, rolled back by hand, deployed again, and fails its trial: a rollback
    does not lead to it."""
    one, two = box.committed(1), box.committed(2)
    assert box.store.rollback() == one
    assert box.installed(2) == two
    assert [box.start() for _ in range(MOST_STARTS + 1)][-1] == one
    with pytest.raises(BundleError, match="no committed bundle to go back to"):
        box.store.rollback()


@pytest.mark.slow
def test_deploying_again_what_runs_changes_nothing(box: Delivery):
    """A committed bundle stays committed; a bundle on trial gets three new starts."""
    one = box.committed(1)
    assert box.installed(1) == one
    assert box.store.state.of(one).committed
    two = box.installed(2)
    box.start()
    assert box.installed(2) == two
    assert (box.store.state.of(two).starts, box.store.state.of(two).previous) == (0, one)


def test_deploying_the_committed_one_ends_the_trial_of_another(box: Delivery):
    """The committed bundle is current again, and the bundle on trial is dropped."""
    one, two = box.committed(1), box.installed(2)
    assert box.installed(1) == one
    assert box.store.current == one
    assert box.store.state.of(one).committed
    assert not box.store.state.of(two).committed


@pytest.mark.slow
def test_an_older_bundle_is_refused_unless_it_is_the_newest(box: Delivery):
    """The counter must be above all committed counters, also after a rollback. The newest bundle
    itself may be installed again."""
    one, two = box.committed(1), box.committed(2)
    box.store.rollback()
    for counter in (1, 2):
        with pytest.raises(
            BundleError, match=f"counter {counter}, and 2 was committed here before"
        ):
            box.store.install(box.made(counter, version="other"))
    assert box.store.current == one
    assert box.installed(2) == two
    assert box.start() == two


@pytest.mark.slow
def test_a_trial_does_not_raise_the_least_counter(box: Delivery):
    """A bundle that was never committed may be replaced by a bundle with a lower counter."""
    box.committed(1)
    box.installed(9)
    assert box.start() != box.installed(2) == box.start()


def alter(name: str) -> Ways:
    """A way to alter a file of a bundle."""

    def way(box: Delivery) -> Path:
        folder = box.made(1)
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / name).write_bytes(data)
        return folder

    return way


def unsigned(box: Delivery) -> Path:
    """A bundle without a signature."""
    return deliveries.put(box.folder / "in", deliveries.files(1, None))


def strange(box: Delivery) -> Path:
    """A bundle signed with a key that nobody knows."""
    return deliveries.put(
        box.folder / "in", deliveries.files(1, deliveries.key(box.folder / "theirs"))
    )


def linked(box: Delivery) -> Path:
    """A bundle whose model is a link to the right one."""
    folder = box.made(1)
    (folder / bundle.MODEL).rename(box.folder / "model")
    (folder / bundle.MODEL).symlink_to(box.folder / "model")
    return folder


def huge(box: Delivery) -> Path:
    """A bundle whose model is a sparse file of 10 GB."""
    folder = box.made(1)
    os.truncate(folder / bundle.MODEL, 10 << 30)
    return folder


def piped(box: Delivery) -> Path:
    """A bundle whose manifest is a pipe that nobody writes to."""
    folder = box.made(1)
    (folder / bundle.MANIFEST).unlink()
    os.mkfifo(folder / bundle.MANIFEST)
    return folder


BAD: dict[str, tuple[Ways, str]] = {
    "unsigned": (unsigned, "is not signed"),
    "another's key": (strange, "signed by none of the signers in"),
    "no bundle": (lambda box: box.folder, "no bundle at"),
    "too new": (lambda box: box.made(1, runtime="99.0.0"), r"needs palpate 99\.0\.0"),
    "never counted": (lambda box: box.made(0), "has counter 0"),
    "model altered": (alter(bundle.MODEL), "was altered"),
    "golden altered": (alter(bundle.GOLDEN), "was altered"),
    "manifest altered": (alter(bundle.MANIFEST), "cannot be read|does not fit|must|is not"),
    "signature altered": (alter(bundle.SIGNATURE), "signed by none|does not fit"),
    "link": (linked, "cannot be read"),
    "huge": (huge, "more than"),
    "pipe": (piped, "no plain file"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_bundle_is_refused_and_leaves_nothing(box: Delivery, name: str):
    """A bad bundle is refused with its reason. The current bundle, the state and the folder of
    bundles do not change."""
    one = PACKAGED if name == "never counted" else box.committed(1)  # which is also below that one
    before = box.store.state
    make, why = BAD[name]
    with pytest.raises(BundleError, match=why):
        box.store.install(make(box))
    assert (box.store.current, box.store.state) == (one, before)
    assert [p.name for p in box.store.bundles.folder.glob("*")] == [one] * bool(one)


def test_what_else_lies_there_is_not_taken(box: Delivery):
    """A file that the manifest does not name is not copied."""
    folder = box.made(1)
    (folder / "extra").write_bytes(b"x")
    sha = box.store.install(folder)
    names = {bundle.MANIFEST, bundle.SIGNATURE, bundle.MODEL, bundle.GOLDEN, bundle.MEANS}
    assert {p.name for p in box.store.bundles.at(sha).iterdir()} <= names


def test_what_was_checked_is_what_is_written(box: Delivery):
    """The owner of the folder changes it after the check: the checked files are installed."""
    folder = box.made(1)

    def change(held: Bundle) -> None:
        for path in folder.iterdir():
            path.write_bytes(b"changed")

    changing = store.Store(box.how, change)
    sha = changing.install(folder)
    assert box.store.bundles.get(sha).sha == sha


@pytest.mark.parametrize(
    ("does", "why"),
    [
        (
            lambda b: os.kill(os.getpid(), signal.SIGKILL),
            "killed the process that tried it .SIGKILL",
        ),
        (lambda b: bytearray(1 << 30), "asks for more than 192 MB"),
        (lambda b: [][0], "cannot be run: IndexError"),
    ],
    ids=["dies", "asks for memory", "raises"],
)
def test_a_model_that_kills_its_runtime_is_refused(
    tmp_path: Path, does: Callable[[Bundle], object], why: str
):
    """The model runs in a child process. This process continues, and reports why the child
    died."""
    box = Delivery(tmp_path, does)
    with pytest.raises(BundleError, match=why):
        box.installed(1)
    assert box.store.current == PACKAGED


def test_a_model_that_hangs_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The child ends at the deadline."""
    monkeypatch.setattr("palpate.deployment.sandbox.DEADLINE_S", 0.2)

    def hang(held: Bundle) -> None:
        while True:
            pass

    with pytest.raises(BundleError, match=r"not run within 0\.2 s"):
        Delivery(tmp_path, hang).installed(1)


@pytest.mark.slow
def test_a_bundle_that_fails_its_trial_at_the_start_is_left_in_that_start(
    box: Delivery, logged: list[str]
):
    """Damaged files, other results for the golden sweeps, or unfit settings: the committed bundle
    runs."""
    one = box.committed(1)
    two = box.installed(2)
    (box.store.bundles.at(two) / bundle.MODEL).write_bytes(b"rotten")
    assert box.start() == one
    assert "was altered" in logged[-1]
    for counter, error in (
        (3, BundleError("golden sweeps differ")),
        (4, ConfigError("no early heads")),
    ):

        def prove(held: Bundle, error: Exception = error) -> None:
            raise error

        box.installed(counter)
        assert store.Store(box.how, prove).choose().folder.name == one
        assert str(error) in logged[-1]


def test_a_committed_bundle_that_is_refused_stops_the_box(box: Delivery):
    """The box does not choose another bundle by itself. The error names the way back, and that way
    works."""
    one, two = box.committed(1), box.committed(2)
    shutil.rmtree(box.store.bundles.at(two))
    with pytest.raises(BundleError, match="committed; `palpate bundles rollback` goes back"):
        box.start()
    assert box.store.rollback() == one == box.start()


def test_another_bundle_in_a_bundles_place_is_refused(box: Delivery):
    """The folder holds a complete and signed bundle that does not belong to the folder's name."""
    one, two = box.committed(1), box.committed(2)
    shutil.rmtree(box.store.bundles.at(two))
    shutil.copytree(box.store.bundles.at(one), box.store.bundles.at(two))
    with pytest.raises(BundleError, match="holds another bundle"):
        box.start()


def test_a_damaged_bundle_is_mended_by_deploying_it_again(box: Delivery):
    """Its folder is replaced by a complete folder, even if the bundle is current."""
    one = box.committed(1)
    (box.store.bundles.at(one) / bundle.MODEL).write_bytes(b"rotten")
    assert [e.role for e in bundle_commands.entries(box.store)] == ["previous", "damaged"]
    assert box.installed(1) == one == box.start()
    assert os.listdir(box.store.bundles.folder) == [one]


@pytest.mark.slow
def test_leftovers_and_old_bundles_go_at_the_next_install(box: Delivery):
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
def test_a_candidate_waits_and_is_promoted(box: Delivery):
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
    with pytest.raises(BundleError, match="no candidate"):
        box.store.promote()
    assert box.store.rollback() == one
    box.store.install(box.made(3), shadow=True)
    box.committed(4)
    with pytest.raises(BundleError, match="counter 3, and 4 was committed"):
        box.store.promote()


def test_one_command_at_a_time(box: Delivery, monkeypatch: pytest.MonkeyPatch):
    """A second command waits for a limited time. Only the owner of the folder may change the
    store."""
    monkeypatch.setattr(store, "LOCK_S", 0.1)
    box.installed(1)
    with box.store._locked(), pytest.raises(ApplianceError, match="in use by another command"):
        store.Store(box.how, lambda b: None).commit(wait_s=0.1)
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    with pytest.raises(ConfigError, match="do this as that user"):
        box.store.commit()


@pytest.mark.slow
def test_a_disk_that_takes_no_note_runs_what_was_committed(
    box: Delivery, monkeypatch: pytest.MonkeyPatch, logged: list[str]
):
    """A bundle on trial is not started if the start cannot be counted: a loop of crashes would go
    unnoticed."""

    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device", str(path))

    for committed in (lambda: PACKAGED, lambda: box.committed(1)):
        before, tried = committed(), box.installed(2)
        with monkeypatch.context() as patch:
            patch.setattr("palpate.core.storage.put", full)
            assert box.start() == before
            assert "No space left on device, so no bundle can be on trial" in logged[-1]
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
def test_a_state_that_cannot_be_read_is_named(box: Delivery, text: str):
    """Its content is not guessed."""
    box.installed(1)
    Path(box.how.folder, "bundles.json").write_text(text)
    with pytest.raises(BundleError, match=r"bundles\.json cannot be read"):
        box.start()


def test_a_link_out_of_the_store_is_refused(box: Delivery):
    """Such a link can only have been set by hand."""
    Path(box.how.folder, "current").symlink_to("/etc")
    with pytest.raises(BundleError, match="leads to '/etc'"):
        box.start()


@pytest.mark.slow
def test_the_table_says_what_a_person_wants_to_know(box: Delivery):
    """One line a bundle: role, id, name, counter, signer, trial."""
    one, two = box.committed(1), box.store.install(box.made(2, name="tubes", version="7"))
    box.start()
    lines = bundle_commands.lines(bundle_commands.entries(box.store))
    assert [line.split()[0] for line in lines] == ["role", "on", "previous", "kept"]
    assert f"on trial  {two[:8]}  tubes 7" in lines[1]
    assert "2        anna@lab   start 1 of 3, 0 of 5 sweeps, 0 of 600 s" in lines[1]
    assert one[:8] in lines[2]


@pytest.mark.slow
@pytest.mark.thorough  # hundreds of altered bundles
def test_no_altered_bundle_is_accepted(tmp_path: Path):
    """A sample of `python -m tests.campaigns flips`, with and without an enrolled label: flipped
    bits in each file, files of another signed bundle, cut files, unsigned and older bundles."""
    found = flips.campaign(tmp_path, 50, seed=2)
    assert found[flips.FLIPPED]["tried"] == 50
    assert sum(kind.startswith(flips.ENROLLED) for kind in found) >= 14
    assert len(found) >= 28
    assert not any(
        count["accepted"] or count["believed"] or count["changed"] for count in found.values()
    )


@pytest.mark.parametrize("removed", ["bundles.json"])
def test_a_removed_state_is_told(tmp_path: Path, removed: str, logged: list[str]):
    """Without the state nothing is known of committed counters: each start and each delivery say
    so. A new box says nothing."""
    box = Delivery(tmp_path)
    box.committed(5)
    assert not any("is missing" in line for line in logged)
    (Path(box.how.folder) / removed).unlink()
    box.start()
    assert "older bundles are accepted again" in logged[-1]
    logged.clear()
    box.installed(3)
    assert any("older bundles are accepted again" in line for line in logged)


def test_a_slow_check_does_not_count_against_a_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """ssh-keygen that takes too long ends the start with an exit code that is restarted, as often
    as it likes, and the bundle stays on trial."""
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


def test_memory_that_is_short_at_a_start_counts_and_the_trial_goes_on(tmp_path: Path):
    """The program ends with an exit code that is restarted. Once there is memory, the bundle on
    trial runs; a bundle for which there never is any gives way after MOST_STARTS."""
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

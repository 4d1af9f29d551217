"""Cuts: the disk after a kill or a loss of power at any moment; wrong programs are found."""

import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.cuts import black_box, calls, delivery, recording, releases, scene, teaching, tree
from tests.cuts.calls import NotFollowed
from tests.cuts.scene import CrashPoint, CutScene, Found, ScenePlay, SceneStep

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(calls.lacking()), reason=f"needs {calls.lacking()}"),
]

Makes = Callable[..., ScenePlay]


@pytest.fixture
def work() -> Iterator[Path]:
    """A folder in memory."""
    with scene.stage() as folder:
        yield Path(folder)


@pytest.fixture
def play(work: Path) -> Makes:
    """Plays lines of Python, whose folder is `f`, after other lines that prepare it."""

    def make(
        does: str, before: str = "", judge: Callable[[Found], list[str]] = lambda found: []
    ) -> ScenePlay:
        code = (
            "import os, sys; from pathlib import Path; from palpate.core import storage; "
            "f = Path(sys.argv[1])\n"
        )

        def prepare(folder: Path) -> None:
            exec(code.replace("sys.argv[1]", repr(str(folder))) + before, {})

        step = SceneStep("it", lambda folder: [sys.executable, "-S", "-c", code + does, folder])
        return ScenePlay(CutScene("lines", prepare, (step,), judge), work)

    return make


def left(play: ScenePlay, call: str | None) -> list[tree.Tree]:
    """The folders that a loss of power may leave before the first such call; None: at the end."""
    return next(
        list(m.disk.left()) for m in play.moments() if (m.call.name if m.call else None) == call
    )


def wrong(points: list[CrashPoint]) -> list[str]:
    """All faults that were found."""
    return [f"{p.step}, {p.how} before {p.call}: {text}" for p in points for text in p.wrong]


DIED = "7 +++ killed by SIGKILL +++"


@pytest.mark.parametrize(
    ("lines", "found"),
    [
        (["7 fsync(3) = 0", '7 unlink("\\x61") = -1 ENOENT (No such file)', DIED], [0, -1]),
        (["7 fsync(3 <unfinished ...>", "8 fsync(4) = 0", "7 <... fsync resumed>) = 5"], [0, 5]),
        (["7 fsync(3 <unfinished ...>", "8 fsync(4) = 0", DIED], [0, None]),
        (["7 fsync(3 <unfinished ...>) = ?", DIED], [None]),
        (["7 ???() = ?", DIED], []),
        (["7 ???( <unfinished ...>", "8 fsync(4) = 0", DIED], [0]),
        (["7 ???( <unfinished ...>", "8 fsync(4) = 0", "7 <... ??? resumed>) = ?", DIED], [0]),
        (["7 ???() = 0"], None),
        (["7 ???( <unfinished ...>", "7 <... ??? resumed>) = 3"], None),
        (["strace: it stopped"], None),
    ],
)
def test_lines_of_strace_become_calls(lines: list[str], found: list[int | None] | None):
    """Results in the order of the ends, None for a call in which the process was killed. A thread
    that was killed before the name of its call was seen has not made this call; a call without a
    name that did end, or another line, is not taken for nothing."""
    if found is None:
        with pytest.raises(NotFollowed):
            list(calls._calls(lines, "/"))
    else:
        assert [call.result for call in calls._calls(lines, "/")] == found


def test_what_is_not_synced_may_be_there_or_not(play: Makes):
    """A new file: no name, or a name with none, half or all of its content."""
    played = play("a = open(f / 'a', 'wb', 0); a.write(b'1234'); os.fsync(a.fileno())")
    contents = [b"", b"12", b"1234", bytes(4)]
    assert left(played, "fsync") == [{}] + [{"a": held} for held in (b"1234", b"", b"12", bytes(4))]
    assert sorted(map(str, left(played, "fsync")[1:])) == sorted(
        str({"a": held}) for held in contents
    )
    assert left(played, None) == [{}, {"a": b"1234"}]


def test_what_is_overwritten_may_be_the_old_or_nothing(play: Makes):
    """Overwritten and not synced: the old content may still be there, or half of the new."""
    played = play("(f / 'a').write_bytes(b'NEW.')", "(f / 'a').write_bytes(b'old')")
    assert [found["a"] for found in left(played, None)] == [b"NEW.", b"old", b"", b"NE", bytes(4)]
    assert [found["a"] for found in left(played, "write")] == [b"", b"old"]


def test_a_renaming_is_never_half_done(play: Makes):
    """A rename or an exchange of names: before or after; a sync of one folder is enough."""
    before = "[storage.put(f / name, name.encode()) for name in 'ab']; (f / 'x').mkdir()"
    played = play(
        "(f / 'a').rename(f / 'x' / 'a'); storage.sync(f / 'x'); "
        "storage.exchange(f / 'b', f / 'x' / 'a')",
        before,
    )
    assert left(played, "fsync") == [
        {"a": b"a", "b": b"b", "x": None},
        {"b": b"b", "x": None, "x/a": b"a"},
    ]
    assert left(played, None) == [
        {"b": b"b", "x": None, "x/a": b"a"},
        {"b": b"a", "x": None, "x/a": b"b"},
    ]


def test_names_of_two_folders_come_in_any_order(play: Makes):
    """The later of two changes may be on the disk alone, unless both are in one folder."""
    played = play(
        "[(f / name).mkdir() for name in ('x/1', 'x/2', 'y/3')]",
        "(f / 'x').mkdir(); (f / 'y').mkdir()",
    )
    found = [" ".join(sorted(found.keys() - {"x", "y"})) for found in left(played, None)]
    assert found == ["", "x/1", "x/1 x/2", "y/3", "x/1 y/3", "x/1 x/2 y/3"]


def test_a_symlink_is_swapped_in_one_step(play: Makes):
    """The link leads to the old or the new target, also if it was left half done before."""
    played = play(
        "storage.link(f / 'current', 'new')",
        "storage.link(f / 'current', 'old'); (f / 'current.part').symlink_to('x')",
    )
    found = {found["current"] for moment in played.moments() for found in moment.disk.left()}
    assert found == {"old", "new"}
    assert left(played, None) == [{"current": "new"}]


def test_a_kill_comes_before_its_call(play: Makes):
    """A program killed on entry to a renaming has not renamed; its output reaches the judge."""
    judged = []
    played = play(
        "print('now'); sys.stdout.flush(); (f / 'a').rename(f / 'b'); print('then')",
        "(f / 'a').touch()",
        lambda found: judged.append((tree.read(found.folder), found.heard)) or [],
    )
    (moment, end) = played.moments()
    played.kill(moment)
    assert judged == [({"a": b""}, "\nnow\n")]
    assert (moment.call.name, end.call, end.output) == ("rename", None, "\nnow\nthen\n")
    with pytest.raises(NotFollowed, match="was not killed at its rename number 2"):
        played.kill(replace(moment, call=replace(moment.call, nth=2)))


@pytest.mark.parametrize(
    "does",
    [
        "import mmap; a = open(f / 'a', 'r+b'); m = mmap.mmap(a.fileno(), 1); m[0] = 65",
        "a = open(f / 'a', 'r+b'); os.posix_fallocate(a.fileno(), 0, 99)",
        "os.system(f'echo more >>{f}/a')",
        "os.open(f, os.O_TMPFILE | os.O_RDWR)",
        "sys.exit(1)",
    ],
    ids=["mapped", "allocated", "a child's", "nameless", "failed"],
)
def test_what_cannot_be_followed_is_told(play: Makes, does: str):
    """A program that changes files in an unknown way, or fails, is not taken for idle."""
    with pytest.raises(NotFollowed):
        play(does, "(f / 'a').write_bytes(b'0')")


def test_recording_loses_no_more_than_the_sweep_in_progress(work: Path):
    """Power cut at every moment of two runs, some kills: every sweep said to be stored is there."""
    played = ScenePlay(recording.scene(), work)
    points = [played.power(moment) for moment in played.moments()]
    points += [played.kill(moment) for moment in list(played.moments())[8:60:10]]
    assert wrong(points) == []
    assert len(points) > 60


@pytest.mark.thorough  # kills a command at every call
def test_the_command_that_records_loses_no_more_than_the_sweep_in_progress(work: Path):
    """`palpate record` itself, killed and without power before some of its last calls."""
    played = ScenePlay(recording.palpate(), work)
    last = list(played.moments())[-8:-1:2]
    assert wrong([how(moment) for how in (played.power, played.kill) for moment in last]) == []


@pytest.mark.thorough  # kills a program at every call that changes a file
@pytest.mark.parametrize(
    "scene",
    [recording.scene(recording.THREAD), black_box.scene("thread")],
    ids=lambda scene: scene.name,
)
def test_a_kill_at_each_call_of_the_disk_thread_loses_no_more(work: Path, scene: CutScene):
    """Killed before each call that changes a file, in either thread."""
    played = ScenePlay(scene, work)
    moments = [moment for moment in played.moments() if moment.call]
    syncs = [m for m in moments if m.call.name == "fsync" and m.call.thread]
    assert len(syncs) >= 18
    assert wrong([played.kill(moment) for moment in moments]) == []


def test_a_kill_and_then_a_loss_of_power_lose_no_more(work: Path):
    """Killed between making and syncing the folder; the next run must not rely on it."""
    played = ScenePlay(recording.scene(), work)
    made = next(m for m in played.moments() if m.call and m.call.name == "fsync")
    assert wrong([played.kill_then_power(made)]) == []


@pytest.mark.thorough  # the campaign itself cuts at all calls
@pytest.mark.parametrize(
    "way", [way for way in recording.WAYS if way not in ("right", recording.THREAD)]
)
def test_ways_that_are_wrong_are_found(work: Path, way: str):
    """The judge finds each way of writing files that loses some."""
    played = ScenePlay(recording.scene(way), work)
    assert any(played.power(moment).wrong for moment in played.moments())


def test_the_black_box_loses_no_more_than_the_sweep_in_progress(work: Path):
    """Power cut at every moment of two runs: the last sweeps are there, never many more."""
    played = ScenePlay(black_box.scene(), work)
    assert wrong([played.power(moment) for moment in played.moments()]) == []


@pytest.mark.thorough  # every moment of eleven commands
def test_a_release_is_activated_and_sent_back_whole(work: Path):
    """Power cut at every moment: the old release runs, or the new. The next release is taken, and
    goes back to the proven one."""
    played = ScenePlay(releases.scene(), work)
    points = [played.power(moment) for moment in played.moments()]
    assert wrong(points) == []
    assert len(points) > 90


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> delivery.Shop:
    """Signed bundles, and a file with the signer that the box trusts."""
    if not shutil.which("ssh-keygen"):
        pytest.skip("needs ssh-keygen (apt-get install openssh-client)")
    return delivery.Shop.opened(tmp_path_factory.mktemp("shop"))


def cut_at_renames(played: ScenePlay) -> list[CrashPoint]:
    """Killed before each rename; power cut before the link to the bundle is renamed."""
    return [
        (played.power if moment.call.paths[1].endswith("/current") else played.kill)(moment)
        for moment in played.moments()
        if moment.call and moment.call.name.startswith("rename")
    ]


@pytest.mark.thorough  # up to a minute of kills and power cuts each
@pytest.mark.parametrize("name", ["delivery", "enrolment", "teaching"])
def test_a_command_that_is_cut_short_leaves_the_old_bundle_or_the_new(
    shop: delivery.Shop, work: Path, name: str
):
    """Cut anywhere, the box starts, answers and takes the next bundle; no sweep is lost."""
    once = teaching.TeachingShop(shop.folder).once
    scenes = {"delivery": shop.alone, "enrolment": shop.learns, "teaching": lambda way: once()}
    points = cut_at_renames(ScenePlay(scenes[name]("right"), work))
    assert wrong(points) == []
    if name == "teaching":
        assert len(points) >= 5
    else:
        assert [point.states for point in points] == [1, 1, 4]


@pytest.mark.thorough  # kills a box at every call that changes a file
@pytest.mark.parametrize("name", ["delivery", "enrolment", "teaching"])
def test_what_happens_to_a_box_in_between_is_as_the_scene_says(
    shop: delivery.Shop, work: Path, name: str
):
    """Power fails after each command: the expected bundle answers, and the next is taken."""
    taught = teaching.TeachingShop(shop.folder).teaching
    scenes = {"delivery": shop.scene, "enrolment": shop.enrolment, "teaching": taught}
    played = ScenePlay(scenes[name](), work)
    points = [played.power(moment) for moment in played.moments() if not moment.call]
    assert wrong(points) == []
    assert len(points) == len(played.scene.steps)


@pytest.mark.thorough  # two deliveries, each cut at all calls
@pytest.mark.parametrize(
    ("way", "call", "what"),
    [
        ("the link is gone for a moment", "symlink", r"start: exit code 0, answers by"),
        ("the ledger in place", "write", r"start: exit code 78"),
    ],
    ids=["link", "ledger"],
)
def test_deliveries_that_are_wrong_are_found(
    shop: delivery.Shop, work: Path, way: str, call: str, what: str
):
    """A store that is neither old nor new for a moment: a kill at that moment finds it."""
    played = ScenePlay(shop.alone(way), work)
    ends = ("/current", "/bundles.json")
    moments = [m for m in played.moments() if m.call and m.call.name == call]
    (moment,) = [m for m in moments if m.call.paths[0].endswith(ends)]
    assert re.search(what, str(played.kill(moment).wrong))

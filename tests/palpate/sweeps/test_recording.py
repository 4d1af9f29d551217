"""Recordings: labels, what REC reports, and a disk that is full, read-only or in use."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pynmea2
import pytest

from palpate.core.errors import ApplianceError, ConfigError, FormatError
from palpate.core.sweep_file import load, sidecar
from palpate.core.sweep_set import SweepSet
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.service.feed import FeedServer
from palpate.sim import devices, rig, script, skin
from palpate.sweeps import recording, sweep_folder
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_folder import SweepFolder
from palpate_train.data import readers, sets
from tests.factories import toy_bundle
from tests.factories.feeds import FeedPeer
from tests.factories.recorded_page import RecordedPage
from tests.factories.simulated_box import SETTLE_S, Rigged, numbered, played, tubes
from tests.factories.slow_disk import SlowDisk

WOOD, NONE = Labels("wood"), Labels()
Recorded = Callable[..., Rigged]


class Desk:
    """A recording without a box: the sentences that it sends, and a clock that a test sets."""

    def __init__(self, folder: Path, labels: Labels = WOOD, target: int = 10) -> None:
        self.t_ns, self.sentences = 0, []
        self.recording = RecordingSession(
            folder, toy_bundle.FORMAT, labels, self, self.hear, target
        )

    def now_ns(self) -> int:
        """Clock."""
        return self.t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Clock."""

    def hear(self, line: bytes) -> None:
        """Store the fields of a sentence after its kind."""
        self.sentences.append(line.decode().split("*")[0].split(",")[2:])

    def do(self, name: str, text: str = "") -> list[object]:
        """Carry out a command."""
        return self.recording.commands[name](text)

    def sweep(self, number: int, start_ns: int = 0, status: Status = Status.RECORDED) -> list[str]:
        """Record a sweep; returns the fields of the REC sentence."""
        self.recording.sweep(*judged(number, start_ns, status), {"bundle": "b"})
        return self.sentences[-1]

    def outcome(self, number: int) -> list[str]:
        """Record a sweep; returns what became of it, the count and the detail."""
        fields = self.sweep(number)
        return [*fields[1:3], *fields[6:]]


def judged(
    number: int, start_ns: int = 0, status: Status = Status.RECORDED
) -> tuple[Sweep, Verdict]:
    """A sweep, with a window if the status has one, and a verdict on it."""
    windowless = status in (Status.SHORT, Status.GAP)
    frames = Frames.empty(toy_bundle.FORMAT) if windowless else toy_bundle.sweep(0, 0).frames
    sweep = Sweep(number, start_ns, start_ns + 1, status if windowless else Status.OK, frames)
    return sweep, Verdict(number, 5, status, "", 0.0, 0.0, np.empty(0), 0, 0, 1, "")


def names(folder: Path) -> list[str]:
    """The names in a folder."""
    return sorted(path.name for path in folder.iterdir())


def content(folder: Path) -> dict[str, bytes]:
    """The files in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def pairs(*numbers: int) -> list[str]:
    """The names of these sweeps' files."""
    return sorted(f"sweep-{n:06d}.{kind}" for n in numbers for kind in ("json", "npy"))


@pytest.fixture
def recorded(rigged: Callable[..., Rigged], tmp_path: Path) -> Recorded:
    """Builds boxes that record to `tmp_path`."""

    def make(simulated: devices.SimDevices, labels: Labels = NONE) -> Rigged:
        box: Rigged
        recording = RecordingSession(
            tmp_path, skin.FORMAT, labels, simulated.clock, lambda line: box.port.say(line)
        )
        box = rigged(simulated, observers=[recording], commands=recording.commands)
        return box

    return make


def test_a_label_applies_to_sweeps_that_start_after_it(recorded, tmp_path):
    """On the serial line with real edges."""

    def heard(box: Rigged) -> list[list[str]]:
        """The REC sentences that the robot has read: their fields after the kind."""
        box.seconds(0.1)
        return [line.split("*")[0].split(",")[2:] for line in box.heard if ",REC," in line]

    first, *others = script.tubes(1, 3)
    quiet = np.concatenate([np.zeros((3 * 750, 4, 4), np.uint8), first.frames])
    first = rig.Act(quiet, 3 * 750 + first.start, 3 * 750 + first.stop, "")
    simulated = played([first, *others])
    box = recorded(simulated, Labels(session="first day"))
    box.seconds(0.1)
    assert ",LABEL,error," in box.ask("$PPLP,LABEL,1")
    assert "MATERIAL,ok,wood,,first" in box.ask("$PPLP,MATERIAL,wood")
    box.until(lambda: box.box.health.sweeping)
    assert "POSITION,ok,wood,1,first" in box.ask("$PPLP,POSITION,1")
    assert "MATERIAL,ok,metal,1,first" in box.ask("$PPLP,MATERIAL,metal")
    box.until(lambda: box.box.answered == 1)
    box.until(lambda: box.box.health.sweeping)
    assert "NEXT,ok,metal,2,first" in box.ask("$PPLP,NEXT")
    box.until(lambda: simulated.finished(box.box.answered))
    want = [("wood", "", "first day"), ("metal", "1", "first day"), ("metal", "2", "first day")]
    sweeps = [load(tmp_path / f"sweep-{n:06d}.npy")[0] for n in (1, 2, 3)]
    assert [(s.material, s.position, s.session) for s in sweeps] == want
    assert [tuple(rec[3:6]) for rec in heard(box)] == want
    assert all(pynmea2.parse(line, check=True) for line in box.heard)


def test_a_sidecar_holds_everything(recorded, tmp_path):
    """In plain JSON, and nothing of a bundle or of a START command."""
    simulated = tubes(2, 1)
    box = recorded(simulated, Labels("wood", "3", "monday"))
    (verdict,) = box.until(lambda: simulated.finished(box.box.answered))
    about = json.loads((tmp_path / "sweep-000001.json").read_text())
    assert about["verdict"] == verdict.as_dict()
    said = [about["verdict"][name] for name in ("status", "label", "bundle")]
    assert said == ["recorded", "", ""]
    assert about["trigger"]["mode"] == "two-lines"
    assert about["device"]["serial"] == "SIM0001"
    assert about["clock"]["late_ms"] >= 0
    assert np.max(about["unloaded"]["level"]) < 1
    assert np.shape(about["unloaded"]["noise"]) == (4, 4)
    assert (about["run"], about["lost"]) == (0, 0)
    assert (about["material"], about["position"], about["session"]) == ("wood", "3", "monday")
    assert not about.keys() & {"bundle", "tare", "rule", "speed_mm_s", "force_n"}
    again, format = load(tmp_path / "sweep-000001.npy")
    assert format == skin.FORMAT
    assert again.frames.taxels.tobytes() == box.kept[0].frames.taxels.tobytes()


def test_a_recording_is_a_set_to_train_on(recorded, tmp_path):
    """`palpate-train --set DIR` reads labels and windows of the box."""
    simulated = tubes(3, 2)
    box = recorded(simulated, Labels("wood", "1", "a"))
    box.until(lambda: box.box.answered == 1)
    for command in ("MATERIAL,metal", "POSITION,2"):
        box.ask(f"$PPLP,{command}")
    box.until(lambda: simulated.finished(box.box.answered))
    made = readers.read(tmp_path, SweepSet)
    assert [made.materials[k] for k in made.labels] == ["wood", "metal"]
    assert made.groups["position"].tolist() == [1, 2]
    assert (made.samples[1] == box.kept[1].frames.taxels).all()


def test_speed_and_force_reach_sidecar_feed_and_set(rigged, tmp_path):
    """Two sweeps by command with `palpate record`."""
    acts = [rig.Act(numbered(20 * 750), 10**7, 10**7 + 1, "")]
    simulated = played(acts)
    session = RecordingSession(tmp_path, skin.FORMAT, WOOD, simulated.clock, lambda line: None)
    feed = FeedServer(tmp_path / "feed.sock", skin.FORMAT, {}, simulated.clock, {})
    sets = ("trigger.mode=serial",)
    box = rigged(simulated, sets, observers=[session, feed], commands=session.commands)
    box.seconds(0.5)
    peer = FeedPeer(tmp_path / "feed.sock")
    for start in ("START,30.5,1.5", "START,60,0.25"):
        assert ",START,ok*" in box.ask(f"$PPLP,{start}")
        box.seconds(2.5)
        box.ask("$PPLP,STOP")
        box.seconds(0.5)
    verdicts = [line for line in peer.lines() if line["type"] == "verdict"]
    for abouts in (verdicts, [sidecar(tmp_path / f"sweep-{n:06d}.npy") for n in (1, 2)]):
        found = [(about["speed_mm_s"], about["force_n"]) for about in abouts]
        assert found == [(30.5, 1.5), (60.0, 0.25)]
    groups = readers.read(tmp_path, SweepSet).groups
    assert groups["speed"].tolist() == [30_500, 60_000]
    assert groups["force"].tolist() == [1_500, 250]


def test_rec_says_what_became_of_each_sweep(tmp_path):
    """Stored with its count, labels and file; a fault of the window; skipped without a window."""
    desk = Desk(tmp_path, Labels("wood", "3", "a b"))
    assert desk.sweep(1) == ["1", "stored", "1", "wood", "3", "a b", "sweep-000001"]
    assert desk.sweep(2, status=Status.SHORT) == ["2", "skipped", "1", "wood", "3", "a b", "short"]
    faulty = desk.sweep(3, status=Status.NO_CONTACT)
    assert faulty[1:3] + faulty[6:] == ["stored", "2", "sweep-000003 no-contact"]
    assert desk.sweep(4)[6] == "sweep-000004"
    desk.do("MATERIAL")
    assert desk.sweep(5)[3:] == ["", "3", "a b", "sweep-000005 no material"]
    assert names(tmp_path) == pairs(1, 3, 4, 5)
    for name in ("MATERIAL", "POSITION", "SESSION"):
        desk.do(name, "x" * 24)
    assert desk.sweep(999_999)[3:7] == ["x" * 24] * 3 + ["sweep-999999"]


def test_the_label_at_the_start_edge_counts(tmp_path):
    """Whenever it is answered; before all kept changes none."""
    desk = Desk(tmp_path, Labels())
    for t_ns, material in ((100, "a"), (200, "b"), (300, "c")):
        desk.t_ns = t_ns
        desk.do("MATERIAL", material)
    starts = {299: "b", 100: "a", 99: "", 300: "c"}
    assert {start: desk.sweep(n, start)[3] for n, start in enumerate(starts, 1)} == starts
    for desk.t_ns in range(400, 400 + recording.MOST_CHANGES):
        desk.do("MATERIAL", "metal")
    assert [desk.sweep(n, start)[3] for n, start in ((5, 300), (6, 400))] == ["", "metal"]


@pytest.mark.parametrize(
    ("text", "after"),
    [
        ("1", "2"),
        ("9", "10"),
        ("09", "10"),
        *((text, "") for text in ("", "left", "2.5", "9" * 24)),
    ],
)
def test_next_position(tmp_path, text, after):
    """A whole number is increased by one; anything else is an error and stays."""
    desk = Desk(tmp_path, Labels("wood", text))
    if after:
        assert desk.do("NEXT") == ["wood", after, ""]
        return
    with pytest.raises(ApplianceError, match=r"POSITION 1|1 to 24"):
        desk.do("NEXT")
    assert desk.sweep(1)[4] == text


@pytest.mark.parametrize("text", ["-1", "a,b", "blé", "x" * 25, "a\nb", "$"])
def test_labels_that_cannot_be_sent(tmp_path, text):
    """They are refused, by command and as an option, and the label before stays."""
    desk = Desk(tmp_path)
    with pytest.raises(ApplianceError, match="1 to 24"):
        desk.do("MATERIAL", text)
    assert desk.sweep(1)[3] == "wood"
    with pytest.raises(ConfigError, match="session"):
        Labels(session=text)


def test_discard_takes_the_last_and_then_the_one_before(tmp_path):
    """Of this run alone; no number comes twice."""
    before = Desk(tmp_path)
    before.sweep(1)
    before.recording.close()
    desk = Desk(tmp_path)
    for n in (1, 2, 3):
        desk.sweep(n)
    desk.sweep(4, status=Status.SHORT)
    assert desk.do("DISCARD") == [3, 2, "sweep-000004"]
    assert names(tmp_path) == [*pairs(1, 2, 3), "sweep-000004.discarded"]
    assert desk.sweep(5) == ["5", "stored", "3", "wood", "", "", "sweep-000006"]
    assert [desk.do("DISCARD")[0] for _ in range(3)] == [5, 2, 1]
    with pytest.raises(ApplianceError, match="run"):
        desk.do("DISCARD")
    desk.recording.close()
    again = Desk(tmp_path)
    assert names(tmp_path) == [*pairs(1), "sweep-000006.discarded"]
    assert again.sweep(1)[6] == "sweep-000007"
    again.recording.close()
    Desk(tmp_path).recording.close()
    assert names(tmp_path) == pairs(1, 7)


def test_an_answer_that_waits_for_the_disk_holds_up_no_other(rigged, tmp_path):
    """DISCARD once off the disk, also at the end."""
    simulated, disk = tubes(4, 2), SlowDisk()
    recording = RecordingSession(
        tmp_path, skin.FORMAT, WOOD, simulated.clock, lambda line: None, disk=disk
    )
    box = rigged(simulated, observers=[disk, recording], commands=recording.commands)

    def discarding(sweep: int) -> None:
        box.until(lambda: box.box.answered == sweep)
        disk.settle()
        os.write(box.far_end, b"$PPLP,DISCARD\r\n")
        assert ",ANS,NEW,ok" in box.ask("$PPLP,NEW")
        assert (tmp_path / f"sweep-{sweep:06d}.npy").exists()

    discarding(1)
    disk.settle()
    box.until(lambda: any(",ANS,DISCARD,ok,1,0,sweep-000001*" in line for line in box.heard))
    assert names(tmp_path) == ["sweep-000001.discarded"]
    discarding(2)
    box.box.run(lambda: True)
    box.listen(SETTLE_S)
    assert any(",ANS,DISCARD,ok,2,0,sweep-000002*" in line for line in box.heard)


def test_discard_of_the_sweep_that_was_seen(tmp_path):
    """With a number only if it is the last one's."""
    desk = Desk(tmp_path)
    for n in (1, 2):
        desk.sweep(n)
    for other in ("1", "3", "02"):
        with pytest.raises(ApplianceError, match=f"sweep is 2, not {other}"):
            desk.do("DISCARD", other)
    assert desk.do("DISCARD", "2") == [2, 1, "sweep-000002"]
    assert names(tmp_path) == [*pairs(1), "sweep-000002.discarded"]


def test_a_sweep_is_moved_a_material_renamed_and_that_undone(tmp_path):
    """Counts, sidecars, the last sweep and sweeps to come follow; UNDO takes back one after the
    other, without sweeps that are gone; a display name comes and goes with its material."""
    desk = Desk(tmp_path)
    for n in (1, 2, 3):
        desk.sweep(n)
    desk.recording.names.label("Eiche, geölt")
    assert desk.do("MOVE", "3,Eiche geoelt") == [3, "Eiche geoelt"]
    assert desk.do("RENAME", "wood,oak") == ["oak", 2]
    about = desk.recording.about()
    assert (about["material"], about["newest"]) == ("oak", [3, "Eiche geoelt"])
    assert about["last"]["material"] == "Eiche geoelt"

    def found() -> list[tuple[object, object]]:
        kept = [sidecar(path) for path in sorted(tmp_path.glob("*.npy"))]
        return [(one["material"], one.get("display")) for one in kept]

    assert found() == [("oak", None)] * 2 + [("Eiche geoelt", "Eiche, geölt")]
    assert desk.recording.materials() == {"oak": 2, "Eiche geoelt": 1}
    assert desk.do("UNDO") == ["wood to oak"]
    assert desk.sweep(4)[3] == "wood"
    desk.do("DISCARD")
    desk.do("DISCARD")
    desk.do("UNDO")
    assert found() == [("wood", None)] * 2
    assert desk.recording.materials() == {"wood": 2}
    assert desk.recording.about()["undo"] == ""
    again = Desk(tmp_path / "b")
    for name, text in (("MOVE", "1,wood"), ("MOVE", "x"), ("RENAME", "cork,oak"), ("UNDO", "")):
        with pytest.raises(ApplianceError):
            again.do(name, text)
    with pytest.raises(ApplianceError, match="need"):
        desk.do("RENAME", "wood,")
    with pytest.raises(ConfigError):
        desk.do("MOVE", "1,-wood")
    assert found() == [("wood", None)] * 2


@pytest.mark.parametrize(("current", "to_come"), [("wood", "wood"), ("oak", "oak"), ("elm", "elm")])
def test_two_materials_become_one_and_that_undone(tmp_path, current, to_come):
    """Each sweep has its own again, and sweeps to come have what they had before."""
    desk = Desk(tmp_path)
    desk.sweep(1)
    desk.do("MATERIAL", "oak")
    desk.sweep(2)
    desk.do("MATERIAL", current)
    assert desk.do("RENAME", "wood,oak") == ["oak", 2]
    desk.do("UNDO")
    assert desk.recording.materials() == {"wood": 1, "oak": 1}
    assert desk.sweep(3)[3] == to_come


@pytest.mark.parametrize("earlier", [0, 2])
def test_what_became_of_the_last_sweep_is_kept(tmp_path, earlier):
    """As in REC, for displays; an earlier run does not count."""
    before = Desk(tmp_path)
    for n in range(earlier):
        before.sweep(n + 1)
    before.recording.close()
    desk = Desk(tmp_path, Labels("wood", "3", "a"))

    def shown() -> tuple[object, object]:
        about = desk.recording.about()
        return about["last"], about["discard"]

    assert shown() == (None, None)
    desk.sweep(1)
    desk.sweep(2, status=Status.SHORT)
    last, discard = shown()
    labels = {"material": "wood", "position": "3", "session": "a"}
    assert last == {"sweep": 2, "outcome": "skipped", "detail": "short"} | labels
    assert discard == 1
    desk.sweep(3)
    desk.do("DISCARD")
    last, discard = shown()
    assert (last["sweep"], last["outcome"], discard) == (3, "discarded", 1)


def test_the_log_says_what_is_missing(tmp_path, logged):
    """By material and position, with earlier runs, without faults."""
    before = Desk(tmp_path, Labels("wood", "1"), target=2)
    before.sweep(1)
    before.recording.close()
    logged.clear()
    desk = Desk(tmp_path, Labels("wood", "1"), target=2)
    desk.sweep(1, status=Status.SATURATED)
    desk.sweep(2)
    desk.do("MATERIAL", "metal")
    desk.sweep(3)
    desk.do("DISCARD")
    desk.do("POSITION", "2")
    desk.sweep(4)
    desk.do("MATERIAL")
    desk.sweep(5)
    desk.sweep(6, status=Status.SHORT)
    want = [
        ("<4>sweep 1: ", "saturated"),
        ("sweep 2: ", "wood at 1: 2 of 2; missing: another material"),
        ("sweep 3: ", "metal at 1: 1 of 2; missing: metal at 1: 1"),
        ("sweep 4: ", "of 2; missing: metal at 1: 2, metal at 2: 1, wood at 2: 2"),
        ("sweep 5: ", "no material"),
        ("<4>sweep 6: ", "short"),
    ]
    for line, (start, part) in zip(logged, want, strict=True):
        assert line.startswith(start)
        assert part in line


def test_a_folder_of_another_format_is_refused(tmp_path):
    """It stays as it is, also with a damaged sweep in it."""
    first = Desk(tmp_path)
    first.sweep(1)
    first.recording.close()
    other = replace(toy_bundle.FORMAT, rows=3)
    with pytest.raises(ConfigError, match=r"000001\.npy .*3x2 "):
        RecordingSession(tmp_path, other, NONE, first, first.hear)
    (tmp_path / "sweep-000002.json").write_text("{}")
    assert Desk(tmp_path).sweep(1)[6] == "sweep-000003"


def test_discard_that_fails_can_be_repeated(tmp_path, monkeypatch):
    """The sweep counts as stored until the rest is removed."""
    desk, rename = Desk(tmp_path), Path.replace
    desk.sweep(1)

    def broken(path: Path, target: Path) -> Path:
        if path.suffix == ".json":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return rename(path, target)

    with monkeypatch.context() as disk:
        disk.setattr(Path, "replace", broken)
        with pytest.raises(ApplianceError, match="Input/output"):
            desk.do("DISCARD")
    assert names(tmp_path) == ["sweep-000001.json"]
    assert desk.do("DISCARD") == [1, 0, "sweep-000001"]
    assert names(tmp_path) == ["sweep-000001.discarded"]


def test_a_later_run_writes_nothing_over(tmp_path):
    """Unfinished files go; an incomplete sweep keeps its number."""
    first = Desk(tmp_path)
    first.sweep(1)
    first.recording.close()
    before = content(tmp_path)
    (tmp_path / "sweep-000002.json").write_text("{}")
    unfinished = "sweep-000003.json.part", "sweep-000003.npy.part", "forgotten.part"
    for left in (*unfinished, "mine.part"):
        (tmp_path / left).write_bytes(b"half")
    assert Desk(tmp_path).sweep(1)[6] == "sweep-000004"
    after = content(tmp_path)
    assert before.items() <= after.items()
    assert sorted(after.keys() - before.keys()) == ["mine.part", "sweep-000002.json", *pairs(4)]
    about = sidecar(tmp_path / "sweep-000004.npy")
    assert (about["run"], about["id"]) == (3, 1)


def test_a_folder_has_one_program_and_is_on_the_disk(tmp_path, monkeypatch):
    """Others are refused; it is synced into its parent at every start."""
    first = Desk(tmp_path)
    with pytest.raises(ConfigError, match="another"):
        Desk(tmp_path)
    assert first.sweep(1)[1] == "stored"
    first.recording.close()
    Desk(tmp_path).sweep(1)
    assert names(tmp_path) == pairs(1, 2)
    synced: list[Path] = []
    monkeypatch.setattr(sweep_folder.storage, "sync", synced.append)
    for _ in range(2):
        SweepFolder(tmp_path / "a" / "b", toy_bundle.FORMAT).close()
        assert {tmp_path, tmp_path / "a"} <= set(synced)
        synced.clear()


@pytest.mark.parametrize(
    ("blocks", "left", "detail"),
    [
        (1 << 20, 16383, "67.1 MB left of 67.1 for the system"),
        (1000, 49, "0.2 MB left of 0.2 for the system"),
    ],
)
def test_no_room_for_the_system_stops_recording(
    tmp_path, monkeypatch, blocks, left, detail, logged
):
    """REC and one line; each sweep tries again."""
    free = [left]

    def statvfs(path: object) -> os.statvfs_result:
        return os.statvfs_result((4096, 4096, blocks, blocks, free[0], 9, 9, 9, 0, 255))

    monkeypatch.setattr(os, "statvfs", statvfs)
    desk = Desk(tmp_path)
    assert [desk.outcome(n) for n in (1, 2)] == [["full", "0", detail]] * 2
    assert names(tmp_path) == []
    free[0] += 1
    assert desk.sweep(3)[1:3] == ["stored", "1"]
    desk.recording.close()
    trouble, again, end = (line for line in logged if "record: " in line)
    assert re.match(f"<4>record: sweep 1 .*{detail}; ", trouble)
    assert "stored" in again
    assert end.endswith(f"{tmp_path}: 1; missing: wood: 9")


@pytest.mark.parametrize(
    ("code", "outcome"), [(errno.ENOSPC, "full"), (errno.EDQUOT, "full"), (errno.EROFS, "failed")]
)
def test_a_disk_that_refuses(tmp_path, monkeypatch, code, outcome, logged):
    """No space and no quota are `full`, anything else is `failed`, with the reason."""

    def refusing(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
        """A disk on which no sweep can be stored."""

        def refused(*args: object) -> None:
            raise OSError(code, os.strerror(code))

        monkeypatch.setattr(sweep_folder, "save", refused)

    desk = Desk(tmp_path)
    refusing(monkeypatch, code)
    assert desk.sweep(1) == ["1", outcome, "0", "wood", "", "", os.strerror(code)]
    assert len(logged) == 1


def test_what_cannot_be_written_leaves_nothing(tmp_path, logged):
    """Full after n bytes, for any n within both files."""
    desk = Desk(tmp_path)
    desk.sweep(1)
    before = content(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in range(0, max(map(len, before.values())), 50):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            assert desk.sweep(2)[1] == "failed"
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert content(tmp_path) == before
    assert ["stored" in line for line in logged] == [False, True]
    assert desk.sweep(2)[1:3] == ["stored", "2"]


@pytest.mark.parametrize("folder", ["/proc/x", "/dev/null"])
def test_a_folder_that_cannot_be_made(folder):
    """Reported before the robot sweeps."""
    with pytest.raises(ConfigError, match=f"--out {folder}: "):
        Desk(Path(folder))


def test_numbers_in_a_verdict_come_back_bit_for_bit():
    """Also without a short form; no field is left out."""
    _, verdict = judged(1)
    again = json.loads(json.dumps(verdict.as_dict()))
    assert again == verdict.as_dict()
    assert np.array(again["scores"]).tobytes() == verdict.scores.tobytes()
    absent = {"displacement", "speed_mm_s", "force_n", "measured_mm_s", "direction"}
    assert again.keys() == {*Verdict.__slots__, "moved"} - absent
    assert replace(verdict, speed_mm_s=30.0).as_dict()["speed_mm_s"] == 30.0


def test_display_names_outlast_the_run(tmp_path):
    """In sidecar, next run and set; unprintable ones are passed over."""
    for run in range(2):
        one = RecordedPage(tmp_path, Labels())
        assert one.recording.names.displays == ({"Holz geoelt": "Holz, geölt"} if run else {})
        for typed in ("Holz, geölt", "metal"):
            label = one.recording.names.label(typed)
            assert one.recording.commands["MATERIAL"](label)[0] == label
            one.recording.sweep(*one.answered(Status.RECORDED), {})
        assert one.recording.about()["displays"] == {"Holz geoelt": "Holz, geölt"}
        one.recording.close()
    assert sets.load(str(tmp_path)).displays == {"Holz geoelt": "Holz, geölt"}
    path = tmp_path / "sweep-000002.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"display": "a\nb"}))
    one = RecordedPage(tmp_path, Labels())
    assert one.recording.names.displays == {"Holz geoelt": "Holz, geölt"}
    one.recording.close()
    with pytest.raises(FormatError, match="metal"):
        sets.load(str(tmp_path))

"""The one reader and writer of a folder of recordings: which sweeps are learnt from."""

from __future__ import annotations

import io
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError, FormatError
from palpate.core.sweep_file import load, save
from palpate.core.types import Status
from palpate.sweeps import sweep_folder
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_folder import FORGOTTEN, RecordedSweep, SweepFolder
from tests.cuts.recording import SHORT, taken
from tests.factories.slow_disk import SlowDisk, full


def recording(folder: Path, disk: SlowDisk | None = None) -> RecordingSession:
    """A recording of cork."""
    labels = Labels("cork")
    return RecordingSession(folder, SHORT, labels, SystemClock(), lambda line: None, disk=disk)


def put(session: RecordingSession, *numbers: int) -> None:
    """Sweeps with these numbers are recorded."""
    for number in numbers:
        session.sweep(*taken(number, SHORT), {})


def learnt(folder: Path) -> tuple[list[int], dict[str, int]]:
    """The numbers of the sweeps that are learnt from, and the reasons of the others."""
    left_out = Counter[str]()
    found = sweep_folder.taught(folder, left_out)
    return [sweep_folder.number_of(one.path) for one in found], dict(left_out)


def test_each_state_of_a_sweep(tmp_path):
    """One of each: all who learn from a folder leave out the same sweeps for the same reasons."""
    changes = [{}, {"status": Status.GAP}, {"share": 0.5}, {"material": ""}, {"material": "felt"}]
    for number, change in enumerate([*changes, {}], 1):
        one = replace(taken(number, SHORT)[0], **{"material": "cork"} | change)
        status = Status.NO_CONTACT if number == 6 else Status.UNKNOWN
        about = {"verdict": {"status": str(status)}}
        save(tmp_path / f"sweep-{number:06d}.npy", one, SHORT, about)
    for name in ("sweep-000007.npy", "notes.npy"):
        (tmp_path / name).write_bytes(b"half")
    folder = SweepFolder(tmp_path, None)
    folder.forget("felt", [5])
    folder.close()
    reasons = "gap", "early", "no material", "forgotten", "no-contact", "damaged"
    assert learnt(tmp_path) == ([1], dict.fromkeys(reasons, 1))


def test_forgotten_sweeps_of_an_emptied_folder_hide_no_later_ones(tmp_path):
    """A person removes all sweeps, and the program starts again: later ones are taught."""
    one = recording(tmp_path)
    put(one, 1, 2)
    one.forget("cork")
    one.close()
    assert learnt(tmp_path)[0] == []
    for path in tmp_path.glob("sweep-*"):
        path.unlink()
    again = recording(tmp_path)
    put(again, 1, 2)
    assert again.materials() == {"cork": 2}
    assert learnt(tmp_path)[0] == [3, 4]
    again.close()


def test_a_sweep_that_waits_for_the_card_is_forgotten_too(tmp_path):
    """FORGET comes before it is written: it is stored and stays forgotten, also after a start."""
    disk = SlowDisk()
    one = recording(tmp_path, disk)
    put(one, 1)
    one.forget("cork")
    disk.settle()
    assert one.stored == 1
    assert one.materials() == {}
    put(one, 2)
    disk.settle()
    assert one.materials() == {"cork": 1}
    one.close()
    again = recording(tmp_path)
    assert again.materials() == {"cork": 1}
    assert learnt(tmp_path) == ([2], {"forgotten": 1})
    again.close()


def test_a_sweep_that_cannot_be_moved_keeps_its_material(tmp_path, monkeypatch):
    """On a full disk, while a sweep waits for the card, and of a damaged sidecar."""
    disk = SlowDisk()
    one = recording(tmp_path, disk)
    put(one, 1)
    with pytest.raises(ApplianceError):
        one.commands["RENAME"]("cork,oak")
    disk.settle()
    one.close()
    one = recording(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(sweep_folder.storage, "put", full)
        with pytest.raises(ApplianceError, match="No space left"):
            one.commands["MOVE"]("1,oak")
    assert one.materials() == {"cork": 1}
    assert load(tmp_path / "sweep-000001.npy")[0].material == "cork"
    (tmp_path / "sweep-000001.json").write_text("{")
    with pytest.raises(ApplianceError):
        one.commands["MOVE"]("1,oak")
    assert one.materials() == {"cork": 1}
    one.close()


def test_a_sweep_that_comes_while_its_material_is_renamed_has_the_new_name(tmp_path):
    """The answer waits for the card; until then nothing else is moved."""
    disk = SlowDisk()
    one = recording(tmp_path, disk)
    put(one, 1)
    disk.settle()
    reply = one.commands["RENAME"]("cork,oak")
    put(one, 2)
    assert not reply.done()
    with pytest.raises(ApplianceError):
        one.commands["MOVE"]("1,elm")
    disk.settle()
    assert reply.result()[0] == "oak"
    assert one.materials() == {"oak": 2}
    assert [one.sweep.material for one in sweep_folder.taught(tmp_path, Counter())] == ["oak"] * 2
    one.close()


def test_nothing_is_forgotten_while_sweeps_are_moved(tmp_path):
    """FORGET in the meantime would mark them under a name that they lose: a start taught them."""
    disk = SlowDisk()
    one = recording(tmp_path, disk)
    put(one, 1)
    disk.settle()
    renamed = one.commands["RENAME"]("cork,oak")
    with pytest.raises(ApplianceError, match="RENAME"):
        one.forget("cork")
    disk.settle()
    assert renamed.result(0) == ["oak", 1]
    one.forget("oak")
    disk.settle()
    one.close()
    again = recording(tmp_path)
    assert again.materials() == {}
    again.close()


def test_forget_and_discard_are_answered_once_the_card_has_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """They do not wait for the card, and nothing is said or counted before. A failure is the answer
    and changes nothing; another DISCARD meanwhile is refused."""
    disk = SlowDisk()
    one = recording(tmp_path, disk)
    put(one, 1, 2)
    disk.settle()
    forgotten = one.forget("cork")
    assert (forgotten.done(), one.materials()) == (False, {"cork": 2})
    disk.settle()
    assert (forgotten.result(0), one.materials()) == ([], {})
    put(one, 3)
    disk.settle()
    assert learnt(tmp_path) == ([3], {"forgotten": 2})
    gone = one.commands["DISCARD"]("3")
    with pytest.raises(ApplianceError, match="DISCARD"):
        one.commands["DISCARD"]("")
    assert (gone.done(), one.about()["last"]["outcome"]) == (False, "stored")
    disk.settle()
    assert gone.result(0) == [3, 2, "sweep-000003"]
    assert not (tmp_path / "sweep-000003.npy").exists()
    put(one, 4)
    disk.settle()
    monkeypatch.setattr(sweep_folder.storage, "put", full)
    monkeypatch.setattr(sweep_folder.storage, "sync", full)
    for ask in (one.forget, one.commands["DISCARD"]):
        reply = ask("cork" if ask == one.forget else "4")
        disk.settle()
        with pytest.raises(ApplianceError, match="No space left"):
            reply.result(0)
    assert (one.materials(), one.about()["discard"]) == ({"cork": 1}, 4)
    one.close()


@pytest.mark.parametrize("content", ["", "[]", '{"cork": 3}', '{"cork": ["x"]}', "[" * 9999])
def test_a_damaged_list_of_forgotten_sweeps_is_named(tmp_path, content):
    """Nothing is taught by mistake, and the folder is free again."""
    (tmp_path / FORGOTTEN).write_text(content)
    for _ in range(2):
        with pytest.raises(FormatError, match=FORGOTTEN):
            SweepFolder(tmp_path, SHORT)


def test_sweeps_of_another_folder_are_adopted(tmp_path):
    """They get the next numbers and the material; the others stay."""
    session = recording(tmp_path / "old")
    put(session, 1, 2)
    session.close()
    old = [RecordedSweep.load(path) for path in sorted((tmp_path / "old").glob("*.npy"))]
    folder = SweepFolder(tmp_path / "new", SHORT)
    assert [folder.adopt(one, "felt") for one in (*old, old[0])] == [1, 2, 3]
    folder.close()
    again = [RecordedSweep.load(path) for path in sorted((tmp_path / "new").glob("*.npy"))]
    assert [(one.sweep.id, one.sweep.material, one.about["run"]) for one in again] == [
        (1, "felt", 0),
        (2, "felt", 0),
        (1, "felt", 2),
    ]


def test_a_table_of_another_form_is_no_sweep(tmp_path):
    """Records in two dimensions, with the sum of their file."""
    path, out = tmp_path / "sweep-000001.npy", io.BytesIO()
    save(path, taken(1, SHORT)[0], SHORT, {})
    np.save(out, np.load(path)[None])
    path.write_bytes(out.getvalue())
    about = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(about | {"crc32": crc32(out.getvalue())}))
    with pytest.raises(FormatError, match="not"):
        load(path)

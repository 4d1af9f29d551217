"""The findings of the campaign of full load: each target is missed by invented figures; a box that
is counted from inside; a full disk; one box with all clients, for some seconds."""

from __future__ import annotations

import os
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.clock import SystemClock
from palpate.core.types import Frames, SweepFormat
from tests.campaigns import full_load
from tests.campaigns.full_load_judge import figures, missed, table
from tests.factories import toy_bundle
from tests.skins.load import NUMBERS, FrameCheck

STILL = {"turn_ms": 12.0, "found": 1, "loss_known": True}
PHASES = [("calm", 0.0, 60.0), ("processor away", 60.0, 72.0), ("disk full", 72.0, 90.0)]
PEERS = {"feed": {"verdict": 20, "frame": 900}, "page": 7, "tcp": 8, "modbus": 9}


def lines(lost: int = 150) -> list[dict[str, Any]]:
    """A box that was counted every two seconds for 90 s: 100 frames and an answer each second, and
    `lost` frames at 62 s."""
    found: list[dict[str, Any]] = []
    for at in range(0, 92, 2):
        gone = lost * (at > 62)
        counts = {
            "came": 100 * at - gone,
            "missing": gone,
            "counted": gone,
            "stops": at,
            "answered": at,
            "said": 10 * at,
            "dropped": 0,
        }
        found.append({"at_s": float(at), **STILL, **counts})
        status = "gap" if at == 62 else "unknown"
        found += [
            {"at_s": at + 0.5 * i, "sweep": at + i, "status": status, "answer_ms": 5.0 + i}
            for i in (0, 1)
            if at < 90
        ]
    return found


def box(full: bool) -> dict[str, Any]:
    """The figures of one box without faults."""
    timed = [(float(at), 1.0 + at % 2) for at in range(90)]
    looks = [(float(at), 0.1 * at, 70_000 + at) for at in range(0, 90, 5)]
    about = {
        "skin": "papillarray",
        "full": full,
        "format": "3x3x3",
        "heard": 900,
        "results": 90,
        "twice": 0,
    }
    kept = {"kept": {"full": 3}, "recorded": 80, "black_box": 70, "compared": 60, "reading": 0.07}
    return figures(lines(), PHASES, timed, looks) | about | kept


@pytest.fixture
def content() -> dict[str, Any]:
    """A campaign in which all is well."""
    about = {"machine": "m", "real_time": True, "load": [1.5, 2.5], "seed": 7, "commit": "abc"}
    return {**about, "peers": {"papillarray": deepcopy(PEERS)}, "boxes": [box(False), box(True)]}


def test_a_campaign_in_which_all_is_well_misses_nothing(content: dict[str, Any]) -> None:
    """The given figures come back, for the calm phase and for each fault; each box has its rows."""
    assert missed(content) == []
    calm = content["boxes"][1]["calm"]
    assert (calm["came"], calm["missing"], calm["stops"], calm["n"]) == (6000, 0, 60, 60)
    assert calm["edge_ms"] == {"p50": 5.5, "p99": 6.0, "p100": 6.0}
    assert calm["in_box_ms"]["p50"] == 1.5
    assert (calm["share"], calm["turn_ms"]["p100"]) == (0.1, 12.0)
    away = content["boxes"][1]["faults"]["processor away"]
    assert (away["missing"], away["counted"], away["statuses"]) == (
        150,
        150,
        {"unknown": 10, "gap": 2},
    )
    assert content["boxes"][1]["faults"]["disk full"]["missing"] == 0
    text = table(content)
    assert (
        "for 1 min without faults, on m, with real-time priority; "
        "load average 1.5 before, 2.5 after; seed 7" in text
    )
    assert (
        "| papillarray, 3x3x3 | all attached | 6,000 | 0, 0 | 60, 60 | 5.5 / 6.0 / 6.0 ms |" in text
    )
    assert (
        "| processor away | papillarray | nothing attached | 1 | 150, 150 | 12, 12 | 0 | `gap` "
        "2, `unknown` 10 |" in text
    )
    assert (
        "- papillarray: 10.0 % of a core here, reading alone 7.0 % (`palpate check`); "
        "60 % of a core six times slower" in text
    )
    assert (
        "reading alone 42 %; 100 % of a core ten times slower, reading alone 70 %: `palpate "
        "check` fails there." in text
    )
    assert (
        "In the whole run 1,800 sentences were sent, 1,800 came and 0 were counted as dropped."
        in text
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"missing": 151}, "151 frames are missing, 150 are counted as lost"),
        ({"found": 2}, "the skin was lost and found 1 times"),
        ({"stops": 91}, "91 stop edges, 90 answers, of which observers saw 90"),
        ({"stops": 88}, "88 stop edges, 90 answers, of which observers saw 90"),
        ({"answers": 89}, "90 stop edges, 90 answers, of which observers saw 89"),
        ({"twice": 1}, "1 answers came twice"),
        ({"heard": 899}, "900 sentences were sent, 899 came and 0 are counted as dropped"),
        ({"recorded": 0}, "nothing in recorded"),
        ({"black_box": 0}, "nothing in black_box"),
        ({"compared": 0}, "nothing in compared"),
        ({"kept": {"stored": 80}}, "the disk was never full for a recording"),
    ],
)
def test_each_target_can_be_missed(
    content: dict[str, Any], change: dict[str, Any], said: str
) -> None:
    """Only the box with the fault is named."""
    content["boxes"][1] |= change
    assert missed(content) == [f"papillarray, all attached: {said}"]


def test_drops_without_a_fault_late_answers_and_idle_peers_are_found(
    content: dict[str, Any],
) -> None:
    """Sentences dropped while a robot reads, a median that is two milliseconds later, a peer that
    got nothing."""
    full = content["boxes"][1]
    full["calm"] |= {"dropped": 2, "in_box_ms": {"p50": 3.5}}
    content["peers"]["papillarray"] |= {"tcp": 0, "feed": {"frame": 900}}
    assert missed(content) == [
        "papillarray, all attached: 2 sentences dropped in the time without faults",
        "papillarray: 3.5 ms in the box in the median, bare 1.5 ms",
        "papillarray: the peer at verdict got nothing",
        "papillarray: the peer at tcp got nothing",
    ]


def test_a_skin_without_a_count_may_err_by_a_frame_in_each_stop(content: dict[str, Any]) -> None:
    """It was stopped once: one frame too few is within the error of its times, two are not; with a
    count of the skin even one is a fault."""
    content["boxes"][0] |= {"loss_known": False, "missing": 151}
    assert missed(content) == []
    content["boxes"][0]["missing"] = 100
    assert missed(content) == []
    content["boxes"][1]["missing"] = 149
    assert missed(content) == [
        "papillarray, all attached: 149 frames are missing, 150 are counted as lost"
    ]
    content["boxes"][1]["missing"] = 150
    content["boxes"][0]["missing"] = 152
    assert missed(content) == ["papillarray, bare: 152 frames are missing, 150 are counted as lost"]


def test_missing_frames_are_seen_by_their_numbers() -> None:
    """Missing between two turns or within one, up to two seconds of them, also where the numbers
    wrap."""
    check = FrameCheck(SystemClock())
    for numbers in (range(9_900, 9_950), range(9_960, 10_000), range(12_100, 12_110)):
        at = np.array(numbers) % NUMBERS**2
        taxels = np.zeros((len(at), 3, 3), np.uint8)
        taxels[:, 0, 0], taxels[:, 0, 1] = at % NUMBERS, at // NUMBERS
        check.frames(Frames(at, at, taxels))
    assert (check.came, check.missing) == (100, 10 + 2100)


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system")
@pytest.mark.slow
def test_a_disk_fills_to_the_last_byte_and_goes(tmp_path: Path) -> None:
    """Nothing can be written until the filler is gone; afterwards neither disk nor file is left."""
    with full_load.disk(tmp_path / "disk") as folder:
        full_load.fill(folder / "filler")
        with pytest.raises(OSError, match="No space left"):
            (folder / "more").write_bytes(bytes(8192))
        (folder / "filler").unlink()
        (folder / "more").write_bytes(bytes(8192))
    assert not any(folder.iterdir())
    assert not folder.with_suffix(".ext4").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system")
@pytest.mark.slow
@pytest.mark.thorough  # a box with all its clients, for half a minute
def test_one_skin_under_full_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both boxes at work with real processes, through each fault: recorded, compared and served,
    and each sentence accounted for."""
    times = {"SETTLE_S": 3.0, "FULL_S": 4.0, "DEAF_S": 28.0, "REST_S": 4.0, "LOOK_S": 1.0}
    for name, seconds in times.items():
        monkeypatch.setattr(full_load, name, seconds)
    format = SweepFormat(16, 32, 100.0, 20, "uint8")
    bundle = toy_bundle.put(tmp_path / "bundle", toy_bundle.files(format=format))
    found = full_load.measure({"flexitac": bundle}, 0.1, 1, (), tmp_path / "disks")
    bare, full = found["boxes"]
    assert (bare["full"], full["full"]) == (False, True)
    for one in found["boxes"]:
        assert 0 < one["reading"] < 1
        assert one["said"] == one["heard"] + one["dropped"]
        assert one["faults"]["port blocked"]["dropped"] > 0
        assert one["answered"] - one["stops"] in (0, 1)
        assert one["twice"] == 0
        assert one["calm"]["n"] > 0
        assert one["faults"]["processor away"]["missing"] > 0
    assert full["kept"]["full"] > 0
    assert min(full[kind] for kind in ("recorded", "black_box", "compared")) > 0
    assert bare["recorded"] == bare["black_box"] == bare["compared"] == 0
    peers = found["peers"]["flexitac"]
    assert min(peers["feed"]["verdict"], peers["page"], peers["tcp"], peers["modbus"]) > 0

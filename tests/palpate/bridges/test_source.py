"""The feed of a box with several fingers as a bridge sees it, from the server of the box itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from palpate.bridges.source import FeedSource
from palpate.core.types import Status, SweepFormat
from palpate.sim import skin
from tests.factories.bridges import eventually
from tests.factories.feeds import OK, Offered, frames

WIDE = SweepFormat(2, 5, 100.0, 100, "int16")


def test_answers_and_frames_of_the_feed_name_the_fingers(tmp_path: Path):
    """The answer of the hand has one of each finger with its own status; each frame the name of its
    finger, whose format is that of its skin. The next answer, of a box with one skin, has none."""
    known = {name: {"format": f.json()} for name, f in (("left", skin.FORMAT), ("right", WIDE))}
    offered = Offered(tmp_path / "feed.sock", hand=[skin.FORMAT, WIDE], known={"fingers": known})
    offered.turns()
    heard: list[dict] = []
    source = FeedSource(str(offered.path), frame=heard.append, frames_hz=20)

    def told(there: bool) -> bool:
        offered.turns()
        return there

    try:
        eventually(lambda: told(len(source.fingers) == 2))
        assert {name: (f["rows"], f["cols"]) for name, f in source.fingers.items()} == {
            "left": (4, 4),
            "right": (2, 5),
        }
        offered.feed.frames(replace(frames(2), finger="left"))
        offered.feed.frames(replace(frames(3, WIDE), finger="right"))
        eventually(lambda: told(len(heard) == 2))
        assert {line["finger"]: len(line["taxels"]) for line in heard} == {"left": 4, "right": 2}
        away = replace(OK, finger="right", status=Status.NO_CONTACT, label="", probability=0.0)
        offered.feed.answered(replace(OK, fingers=(replace(OK, finger="left"), away)))
        eventually(lambda: told(source.view().answers == 1))
        answer = source.view().answer
        assert answer.finger == ""
        assert [(of.finger, str(of.status), of.label) for of in answer.fingers] == [
            ("left", "ok", "plastic rough"),
            ("right", "no-contact", ""),
        ]
        offered.feed.answered(OK)
        eventually(lambda: told(source.view().answers == 2))
        assert source.view().answer.fingers == ()
        assert source.view().damaged == 0
    finally:
        source.close()
        offered.feed.stopping()

"""The progress of a recording, in words."""

from __future__ import annotations

import re

from palpate.sweeps.progress import RecordingProgress


def test_each_material_is_wanted_at_every_position():
    """Up to the target; removed pairs and no material do not count; long lists are cut."""

    def counted(target: int, *pairs: tuple[str, str]) -> RecordingProgress:
        """The progress after sweeps of these materials at these positions."""
        progress = RecordingProgress(target)
        for pair in pairs:
            progress.add(*pair)
        return progress

    progress = counted(2, *((material, "1") for material in "abcda"), ("a", "2"))
    found, missing = progress.line("a", "1").split("; missing: ")
    assert (found, len(missing.split(", "))) == ("a at 1: 2 of 2", 6)
    assert missing.startswith("a at 2: 1, b at 1: 1")
    assert missing.endswith("d at 1: 1 and 1 more")
    assert "material" in counted(1).missing()
    progress = counted(1, ("a", ""))
    assert "material" in progress.missing()
    progress.add("b", "", 3)
    assert re.match("b: 3 of 1; nothing", progress.line("b", ""))
    progress = counted(1, ("a", "1"), ("b", "1"), ("c", "1"), ("", "1"))
    progress.add("a", "1", -1)
    assert re.match("nothing .*2 m.*1 position", progress.missing())
    assert "material" in progress.line("", "1")
    progress = counted(1, *((material, position) for material in "ab" for position in "12"))
    assert progress.missing().endswith("2 positions")

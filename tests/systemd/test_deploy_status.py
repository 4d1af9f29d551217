"""A box whose status file cannot be read does not stop the delivery to it or to others."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "systemd"))
deploy = pytest.importorskip("deploy")

PACKED = deploy.BundleArchive("a" * 64, "one 1", b"")


class AnsweringBox:
    """A box that answers each question with the same text, and notes the questions."""

    def __init__(self, text: str) -> None:
        self.text, self.asked = text, list[tuple[str, str]]()

    def run(self, what: str, command: str, *, user: str = "", **more: object) -> str:
        """Answer."""
        self.asked.append((command, user))
        return self.text


@pytest.mark.parametrize(
    "status",
    ["", "{", "[]", "3", '{"bundle": 5}', "{}", "\0" * 50, "[" * 5000, '{"bundle": "' + "b" * 8],
)
def test_an_unreadable_status_counts_as_another_bundle(status: str):
    """No exception, and the bundle is delivered."""
    box = AnsweringBox(f"bundles/{PACKED.sha}\n{status}")
    assert deploy._runs(box, PACKED, "/s", "/r/status.json") is False
    ((command, user),) = box.asked
    assert user == "palpate"
    assert f"head -c {deploy.MOST_STATUS}" in command


def test_a_status_that_can_be_read_is_used():
    """The bundle that runs already is not delivered again."""
    box = AnsweringBox(f'bundles/{PACKED.sha}\n{{"bundle": "{"a" * 8}"}}')
    assert deploy._runs(box, PACKED, "/s", "/r/status.json") is True

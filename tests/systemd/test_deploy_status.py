"""A box whose status file cannot be read does not stop the delivery to it or to others."""

import json

import pytest

from tests.factories.install_scripts import require_pyinfra, run_here

require_pyinfra()
SHA = "a" * 64
ASK = """
import json, sys, deploy
class AnsweringBox:
    asked = []
    def run(self, what, command, *, user="", **more):
        self.asked.append((command, user))
        return {answer!r}
archive = deploy.BundleArchive("{sha}", "one 1", 1, b"")
runs = deploy._runs(AnsweringBox(), archive, "/s", "/r/status")
print(json.dumps([runs, AnsweringBox.asked, deploy.MOST_STATUS]))
"""


def asked(answer: str) -> tuple[bool, list[list[str]], int]:
    """Deploy's verdict for a box's answer, its commands with users, the largest status."""
    runs, commands, most = json.loads(run_here(ASK.format(answer=answer, sha=SHA)))
    return runs, commands, most


@pytest.mark.parametrize(
    "status",
    ["", "{", "[]", "3", '{"bundle": 5}', "{}", "\0" * 50, "[" * 5000, '{"bundle": "' + "b" * 8],
    ids=["empty", "cut", "list", "number", "no text", "no bundle", "zeros", "deep", "cut text"],
)
def test_an_unreadable_status_counts_as_another_bundle(status: str):
    """No exception, and the bundle is delivered."""
    runs, commands, most = asked(f"bundles/{SHA}\n{status}")
    assert runs is False
    ((command, user),) = commands
    assert user == "palpate"
    assert f"head -c {most}" in command


def test_a_status_that_can_be_read_is_used():
    """The bundle that runs already is not delivered again."""
    assert asked(f'bundles/{SHA}\n{{"bundle": "{"a" * 8}"}}')[0] is True

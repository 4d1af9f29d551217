"""The action ~/sweep: the bridge as a process, another node as a second one, over loopback."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from palpate.core.sentences import Sentence
from palpate.core.status import Status
from tests.factories.bridges import LONG_S, bridge, eventually
from tests.factories.speaking_box import SpeakingBox, obeying, result, state
from tests.robots import ros
from tests.robots.ros import RosPeer

WRITES = ("-p", "allow_writes:=true")
LONG = {"slide_s": LONG_S, "timeout_s": 2 * LONG_S}


@pytest.fixture(autouse=True, scope="module")
def _installed() -> None:
    """These tests need ROS 2 and the action's messages."""
    ros.required()
    ros.messages_required()


@pytest.fixture
def node(box: SpeakingBox) -> Iterator[RosPeer]:
    """A node that hears the box through a bridge that may command it, and knows its labels."""
    with ros.peer() as peer, ros.bridge("-p", f"port:={box.path}", *WRITES):
        ready(box, peer)
        yield peer


def ready(box: SpeakingBox, peer: RosPeer) -> None:
    """Wait until the bridge is there."""
    eventually(lambda: bool(box.say(state())) or peer.on("state") != [])
    eventually(lambda: [s.kind for s in box.heard].count("LABEL") >= 3)


def commands(box: SpeakingBox) -> list[str]:
    """The commands that the box has heard, without questions."""
    return [s.kind for s in box.heard if s.kind not in ("STATE", "LABEL")]


def swept(node: RosPeer, **terms: float | bool) -> Mapping[str, Any]:
    """Send a goal; its result."""
    before = len(node.on("result"))
    node.sweep(**terms)
    return later(node, before)


def later(node: RosPeer, before: int) -> Mapping[str, Any]:
    """The result after so many."""
    eventually(lambda: len(node.on("result")) > before)
    return node.on("result")[before]


def phases(node: RosPeer) -> list[str]:
    """The feedback of the goals."""
    return [feedback["phase"] for feedback in node.on("feedback")]


def begun(node: RosPeer, **terms: float) -> None:
    """Send a goal, and wait until the finger slides."""
    before = phases(node).count("sliding")
    node.sweep(**LONG | terms)
    eventually(lambda: phases(node).count("sliding") > before)


def silent(heard: Sentence) -> list[bytes]:
    """A box that obeys and answers no sweep."""
    return obeying(heard)[:1]


def test_a_sweep(box, node):
    """START, the slide, STOP, all fields of RES; feedback announces the slide; NEW on request."""
    found = swept(node, slide_s=0.1, timeout_s=LONG_S, new_object=True, speed_mm_s=30.1)
    assert (found["state"], found["status"], found["label"]) == ("succeeded", "ok", "wood")
    counts = [found[name] for name in ("sweep", "code", "fused", "lost", "share")]
    assert counts == [1, 1, 1, 0, 1]
    figures = [round(found[name], 3) for name in ("probability", "margin", "latency_ms")]
    assert figures == [0.9, 0.8, 1.25]
    assert (found["bundle"], found["message"]) == ("9f3c2a1b", "use the label")
    assert commands(box) == ["NEW", "START", "STOP"]
    assert [s.fields for s in box.heard if s.kind == "START"] == [["30.1"]]
    eventually(lambda: phases(node) == ["sliding", "judging"])
    eventually(lambda: node.on("verdict") != [])


def test_an_early_answer(box, node):
    """Feedback has it while the finger slides; the result follows at once."""
    box.script = lambda s: [
        *silent(s),
        *([result(1, label="paper", share="0.40")] if s.kind == "START" else []),
    ]
    found = swept(node, **LONG)
    eventually(lambda: phases(node) == ["sliding", "early"])
    early = node.on("feedback")[-1]
    assert (early["status"], early["label"], round(early["probability"], 3)) == ("ok", "paper", 0.9)
    assert (found["state"], found["label"], round(found["share"], 3)) == ("succeeded", "paper", 0.4)


def test_what_was_not_ok(box, node):
    """`unsure` is an answer; a fault is none, and its status and remedy are there."""
    lines = iter((result(1, "unsure"), result(2, "stuck-taxel", "", detail="taxel 2.3")))
    box.script = lambda s: [*silent(s), *([next(lines)] if s.kind == "STOP" else [])]
    unsure = swept(node, slide_s=0.1)
    assert (unsure["state"], unsure["status"], unsure["label"]) == ("succeeded", "unsure", "wood")
    stuck = swept(node, slide_s=0.1)
    told = [stuck[name] for name in ("state", "status", "label", "code")]
    assert told == ["aborted", "stuck-taxel", "", 0]
    assert stuck["message"] == "a loaded taxel shows a constant count; check the skin (taxel 2.3)"


def test_one_at_a_time_and_canceled(box, node):
    """A second goal is rejected; canceled, the box aborts; the next goal works."""
    box.script = lambda s: [*obeying(s), *([result(1, "aborted", "")] if s.kind == "ABORT" else [])]
    begun(node)
    assert swept(node)["state"] == "rejected"
    assert commands(box) == ["START"]
    node.cancel()
    found = later(node, 1)
    assert (found["state"], found["status"]) == ("canceled", "aborted")
    assert commands(box) == ["START", "ABORT"]
    box.script = lambda s: [*silent(s), *([result(2)] if s.kind == "STOP" else [])]
    assert swept(node, slide_s=0.1)["state"] == "succeeded"


def test_unplugged_meanwhile(box, node):
    """Aborted with the reason, as is a goal without a line; plugged in, the next works."""
    begun(node)
    box.unplug()
    lost = later(node, 0)
    assert (lost["state"], lost["status"], lost["sweep"]) == ("aborted", "", 0)
    assert lost["message"].startswith("the box was lost during the sweep: ")
    absent = swept(node)
    assert absent["state"] == "aborted"
    assert absent["message"].startswith("not ready within 3 s: ")
    box.plug_in()
    eventually(lambda: box.say(state()) or node.last("diagnostics")["level"] == 0)
    assert swept(node, slide_s=0.1)["state"] == "succeeded"


def test_cleaned_up_meanwhile(box, node):
    """The sweep is aborted before the line is closed; configured again, goals work."""
    box.script = lambda s: [*silent(s), *([result(1, "aborted", "")] if s.kind == "ABORT" else [])]
    begun(node)
    assert node.call("deactivate")["success"]
    assert node.call("cleanup")["success"]
    ended = later(node, 0)
    assert (ended["state"], ended["status"]) == ("aborted", "aborted")
    assert commands(box) == ["START", "ABORT"]
    assert swept(node)["message"].startswith("the node is not configured")
    assert node.call("configure")["success"]
    box.script = lambda s: [*silent(s), *([result(2)] if s.kind == "STOP" else [])]
    assert swept(node, slide_s=0.1)["state"] == "succeeded"


def test_the_bridge_ends_meanwhile(box):
    """By SIGTERM: the box's sweep is aborted."""
    with ros.peer() as peer:
        with ros.bridge("-p", f"port:={box.path}", *WRITES) as process:
            ready(box, peer)
            begun(peer)
            process.terminate()
            assert process.wait(LONG_S) == 0
        assert commands(box) == ["START", "ABORT"]


def test_commands_need_allow_writes(box):
    """Without it nothing reaches the box, and no other node can set it; verdicts come."""
    with ros.peer() as peer, ros.bridge("-p", f"port:={box.path}"):
        ready(box, peer)
        want = "commands are refused; start the bridge with -p allow_writes:=true"
        found = swept(peer)
        assert (found["state"], found["message"]) == ("aborted", want)
        assert peer.call("tare") == {"service": "tare", "success": False, "message": want}
        refused = peer.call("allow_writes")
        assert not refused["success"]
        assert "read-only" in refused["message"]
        assert peer.call("tare")["message"] == want
        assert commands(box) == []
        eventually(lambda: bool(box.say(result(1))) or peer.on("verdict") != [])


def test_without_the_messages(box, tmp_path):
    """palpate_msgs cannot be imported: one log line about it, and everything else works."""
    broken = tmp_path / "path" / "palpate_msgs"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise ImportError('no palpate_msgs here')\n")
    path = f"{broken.parent}:{ros.environment()['PYTHONPATH']}"
    with (
        (tmp_path / "log").open("wb") as log,
        ros.peer() as peer,
        ros.bridge("-p", f"port:={box.path}", *WRITES, log=log.fileno(), PYTHONPATH=path),
    ):
        ready(box, peer)
        assert peer.call("tare")["success"]
    lines = [line for line in (tmp_path / "log").read_text().splitlines() if "~/sweep" in line]
    assert len(lines) == 1
    assert "docs/robots/ros2.md" in lines[0]


@pytest.mark.slow
def test_with_the_box_itself(tmp_path):
    """The box's program on a simulated skin, a bridge on its serial line, another node: the box
    numbers, times and answers sweeps, whatever the simulated finger did; it decides about a second
    START."""
    quiet = ["--set", "store.runtime=", "--set", "store.folder=/nonexistent"]
    line = tmp_path / "line"
    command = [sys.executable, "-m", "palpate", "run", "--sim", "skin", "--trigger", "serial"]
    command += ["--set", f"serial.port={line}"]
    with (
        bridge("tcp", "--link", line, "--allow-writes") as address,
        subprocess.Popen(
            [*command, *quiet], cwd=ros.ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as run,
        ros.peer() as peer,
        ros.bridge("-p", f"port:=socket://{address[0]}:{address[1]}", *WRITES),
    ):
        try:
            eventually(lambda: peer.on("state") != [])
            for number in (1, 2):
                found = swept(peer, slide_s=2.5, timeout_s=LONG_S)
                assert (found["sweep"], found["share"]) == (number, 1)
                status = Status(found["status"])
                answered = status.classified or status is Status.UNKNOWN
                assert found["state"] == ("succeeded" if answered else "aborted")
            begun(peer)
            assert peer.call("start")["success"]
            ended = later(peer, 2)
            assert (ended["state"], ended["status"]) == ("aborted", "no-stop")
        finally:
            run.terminate()

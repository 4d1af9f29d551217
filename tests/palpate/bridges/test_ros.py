"""The bridge to ROS 2 as a process, and another node as a second one, over loopback."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent

import pytest

from palpate.cli.main import main
from palpate.core.sentences import sentence
from tests.factories.bridges import LONG_S, eventually
from tests.factories.paths import ROOT
from tests.factories.speaking_box import SpeakingBox, finger, result, state
from tests.robots import ros, ros_launch
from tests.robots.ros import RosPeer

OK, WARN, ERROR, STALE = range(4)
PARAMETERS = ROOT / "docs" / "robots" / "palpate.yaml"
WRITES = ("-p", "allow_writes:=true")


@pytest.fixture(autouse=True, scope="module")
def _installed() -> None:
    """These tests need ROS 2."""
    ros.required()


@pytest.fixture
def node(box: SpeakingBox) -> Iterator[RosPeer]:
    """A node that hears the box through the bridge; its parameters come from the page's file."""
    with (
        ros.peer() as peer,
        ros.bridge("--params-file", str(PARAMETERS), "-p", f"port:={box.path}", *WRITES),
    ):
        eventually(lambda: said(box, lambda: peer.on("state") != []))
        yield peer


def said(box: SpeakingBox, there: Callable[[], bool], line: bytes = b"") -> bool:
    """Say a state once more, and see."""
    box.say(line or state())
    return there()


def verdict(box: SpeakingBox, node: RosPeer, line: bytes) -> dict:
    """The message that an answer becomes."""
    before = len(node.on("verdict"))
    box.say(line)
    eventually(lambda: len(node.on("verdict")) > before)
    return node.on("verdict")[-1]


def test_an_answer_becomes_a_message(box, node):
    """OK with the label; WARN if unusable; ERROR if nothing was learned; early is marked."""
    eventually(lambda: [s.kind for s in box.heard].count("LABEL") == 3)
    heard = verdict(box, node, result(1, label="paper"))
    assert (heard["level"], heard["message"], heard["frame_id"]) == (OK, "paper", "fingertip")
    assert (heard["values"]["code"], heard["values"]["probability"], heard["values"]["early"]) == (
        "2",
        "0.9",
        "false",
    )
    assert (heard["values"]["measured_mm_s"], heard["values"]["direction"]) == ("", "")
    slid = verdict(box, node, result(1, optional=("", "30.5", "cols-")))["values"]
    assert (slid["measured_mm_s"], slid["direction"], slid["lost"]) == ("30.5", "cols-", "0")
    assert heard["stamp"] > 0
    assert verdict(box, node, result(2, "unsure"))["level"] == WARN
    assert verdict(box, node, result(3, "unknown", ""))["level"] == WARN
    fault = verdict(box, node, result(4, "stuck-taxel", "", detail="taxel 2.3"))
    assert fault["level"] == ERROR
    assert (
        fault["message"]
        == "stuck-taxel: a loaded taxel shows a constant count; check the skin (taxel 2.3)"
    )
    assert verdict(box, node, result(5, share="0.40"))["values"]["early"] == "true"


def test_an_answer_names_its_fingers(box, node):
    """The answer of the hand, then a status for each finger under its name, with its own label and
    probability; one without contact is an ERROR as in a box with one skin. The next answer, without
    fingers, has its own status alone."""
    eventually(lambda: [s.kind for s in box.heard].count("LABEL") == 3)
    box.say(finger("left", 1, "ok", "paper"))
    box.say(finger("right", 1, "no-contact", "", "0.000"))
    heard = verdict(box, node, result(1, label="paper"))
    assert (heard["name"], heard["message"]) == ("palpate: verdict", "paper")
    left, right = heard["fingers"]
    assert (left["name"], left["level"]) == ("palpate: verdict left", OK)
    assert (left["message"], left["values"]["probability"]) == ("paper", "0.9")
    assert left["values"]["code"] == "2"
    assert (right["name"], right["level"]) == ("palpate: verdict right", ERROR)
    assert right["message"].startswith("no-contact: ")
    assert right["values"]["label"] == ""
    assert "finger" not in heard["values"]
    assert verdict(box, node, result(2))["fingers"] == []


def test_the_box_is_unplugged_dead_and_back(box, node):
    """OK, WARN once after a loss, ERROR without a skin, STALE without a box, OK."""

    def level() -> int:
        return node.last("diagnostics")["level"]

    eventually(lambda: said(box, lambda: level() == OK))
    box.say(result(1), result(5), state(answered=5))
    eventually(
        lambda: any(
            d["level"] == WARN and "answers" in d["message"] for d in node.on("diagnostics")
        )
    )
    eventually(
        lambda: said(
            box,
            lambda: level() == ERROR and node.last("state")["level"] == ERROR,
            state("mismatch", 5),
        )
    )
    box.unplug()
    eventually(lambda: level() == STALE and node.last("state")["level"] == STALE)
    assert not node.call("tare")["success"]
    box.plug_in()
    eventually(
        lambda: said(
            box, lambda: level() == OK and node.last("state")["level"] == OK, state(answered=5)
        )
    )
    assert verdict(box, node, result(6))["message"] == "wood"


def test_services(box, node):
    """Each is its command; the message is the box's reply; a refusal is not a success."""
    assert node.call("tare") == {"service": "tare", "success": True, "message": "16 taxels"}
    for name in ("new_object", "start", "stop", "abort"):
        assert node.call(name)["success"]
    heard = [s.kind for s in box.heard if s.kind != "LABEL"]
    assert heard == ["TARE", "NEW", "START", "STOP", "ABORT"]
    box.script = lambda s: [sentence("ANS", s.kind, "error", "set trigger.mode to serial")]
    assert node.call("start") == {
        "service": "start",
        "success": False,
        "message": "START: set trigger.mode to serial",
    }


def test_the_lifecycle(box, node):
    """Inactive no verdict; cleaned up no line; configured and activated again, it works."""
    assert node.call("deactivate")["success"]
    before = len(node.on("verdict"))
    box.say(result(1), state(answered=1))
    seen = len(node.on("diagnostics"))
    eventually(lambda: len(node.on("diagnostics")) > seen + 1)
    assert len(node.on("verdict")) == before
    assert node.call("cleanup")["success"]
    for transition in ("configure", "activate"):
        assert node.call(transition)["success"]
    eventually(lambda: said(box, lambda: len(node.on("verdict")) > before, result(2)))


def test_the_bridge_dies_and_comes_back(box):
    """Killed, not ended: the other node stays, and hears the next bridge."""
    with ros.peer() as node:
        for number in range(2):
            seen = len(node.on("verdict"))
            assert bool(seen) == bool(number)
            with ros.bridge("-p", f"port:={box.path}") as process:
                eventually(
                    lambda seen=seen: said(box, lambda: len(node.on("verdict")) > seen, result(1))
                )
                process.kill()
                process.wait(LONG_S)


def test_a_late_node_gets_the_state(box, node):
    """The last state is kept for later subscribers, such as a screen."""
    with ros.peer() as late:
        assert late.last("state")["values"]["skin"] == "streaming"


def test_frames_from_the_feed(tmp_path):
    """As images, a channel an axis, little-endian; nan where a skin gave no number."""

    @contextmanager
    def fed(folder: Path) -> Iterator[tuple[socket.socket, RosPeer]]:
        """The bridge on a feed: the connection that stands for the box, and a node that listens."""
        path = folder / "feed.sock"
        with socket.socket(socket.AF_UNIX) as listener, ros.peer() as node:
            listener.bind(str(path))
            listener.listen()
            with ros.bridge("-p", f"feed:={path}", "-p", "frames_hz:=10.0"):
                connection, _ = listener.accept()
                with connection:
                    yield connection, node

    form = {"rows": 2, "cols": 1, "axes": 3, "dtype": "float32", "rate_hz": 100, "window": 200}
    hello = {"type": "hello", "schema": 1, "labels": ["wood"], "bundle": "b1", "format": form}
    frame = {"type": "frame", "time_ns": 1, "taxels": [[[1, 2, 3]], [[4, None, 6]]]}
    with fed(tmp_path) as (connection, node):
        assert json.loads(connection.recv(1000))["frames"] == 10
        connection.sendall(json.dumps(hello).encode() + b"\n")

        def sent() -> bool:
            connection.sendall(json.dumps(frame).encode() + b"\n")
            return node.on("frames") != []

        eventually(sent)
        heard = node.on("frames")[0]
        assert (heard["shape"], heard["encoding"], heard["step"]) == ([2, 1], "32FC3", 12)
        assert bytes(heard["data"][:8]) == b"\0\0\x80\x3f\0\0\0\x40"
        assert bytes(heard["data"][16:20]) == b"\0\0\xc0\x7f"
        assert not node.call("start")["success"]


def test_no_box_is_named():
    """Neither port nor feed: the node stays unconfigured, and can be configured later."""
    with ros.peer() as node, ros.bridge():
        assert not node.call("configure")["success"]


def test_an_end_that_wakes_nobody_is_seen():
    """rclpy may wake the executor before the context has ended: the node ends anyway."""
    silent_end = dedent("""
    import threading
    from rclpy.utilities import get_default_context
    from palpate.bridges import ros
    def end():
        context = get_default_context()
        # as the signal handler does it: its waking of the executor has passed
        context._Context__context.shutdown()
    threading.Timer(2, end).start()
    ros.run([])
    """)
    done = subprocess.run(
        [ros.PYTHON, "-c", silent_end], cwd=ROOT, env=ros.environment(), timeout=LONG_S, check=False
    )
    assert done.returncode == 0


def test_without_ros_the_command_says_what_to_do(capsys):
    """This environment has no rclpy: exit code 78, one line with the remedy."""
    assert main(["bridge", "ros"]) == 78
    assert "setup.bash" in capsys.readouterr().err


def test_the_launch_file(box):
    """The process that it describes is the bridge with the parameters beside it, configured and
    activated. It goes through its lifecycle, and ends with SIGINT, which launch sends first.
    `launch` itself is not available as a wheel and was not run."""
    ((process, command),) = ros_launch.processes(
        PARAMETERS.with_name("palpate.launch.py"), port=str(box.path)
    )
    assert (process.respawn, process.respawn_delay, process.output) == (True, 2.0, "screen")
    assert command[0] == "python3"
    environment = ros.environment() | {"PATH": f"{ros.PYTHON.parent}:{os.environ['PATH']}"}
    with (
        ros.peer() as node,
        subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as launched,
    ):
        try:
            eventually(lambda: said(box, lambda: node.on("state") != []))
            assert verdict(box, node, result(1))["frame_id"] == "fingertip"
            for transition in ("deactivate", "cleanup", "configure", "activate"):
                assert node.call(transition)["success"]
            assert verdict(box, node, result(2))["message"] == "wood"
            launched.send_signal(signal.SIGINT)
            assert launched.wait(LONG_S) == 0
            assert "Traceback" not in launched.stderr.read()
        finally:
            launched.kill()


def test_the_launch_file_configures_where_it_is_told_to(box, tmp_path):
    """With autostart: false the node waits for a manager."""
    for name in ("palpate.launch.py", "palpate.yaml"):
        text = (PARAMETERS.parent / name).read_text()
        (tmp_path / name).write_text(text.replace("autostart: true", "autostart: false"))
    ((_, command),) = ros_launch.processes(tmp_path / "palpate.launch.py", port=str(box.path))
    environment = ros.environment() | {"PATH": f"{ros.PYTHON.parent}:{os.environ['PATH']}"}
    with (
        ros.peer() as node,
        subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as launched,
    ):
        try:
            assert not node.call("activate")["success"]
            assert box.heard == []
            for transition in ("configure", "activate"):
                assert node.call(transition)["success"]
            eventually(lambda: said(box, lambda: node.on("state") != []))
        finally:
            launched.kill()

"""The plug-in for LeRobot: against stand-ins for its names, and against the package itself."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest

from tests.factories import feed_lines, lerobot
from tests.factories.bridges import eventually

pytestmark = pytest.mark.usefixtures("hurried")

NOTHING = feed_lines.load(1.5, 1.5, 0)
PRESSED = feed_lines.load(1.5, 1.5)


@pytest.fixture(scope="module")
def plugin() -> Any:
    return lerobot.plugin()


@contextmanager
def saying(feed: lerobot.PlayedFeed, frame: Any) -> Iterator[None]:
    """Send a frame every 20 ms."""
    ending = threading.Event()

    def go_on() -> None:
        while not ending.wait(0.02):
            feed.say(feed_lines.frame(2, frame))

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


@pytest.fixture
def camera(plugin: Any, tmp_path: Path) -> Iterator[Any]:
    """A connected camera with `feed`, whose skin was unloaded at first."""
    with lerobot.played(tmp_path / "feed") as feed:
        made = plugin.PalpateCamera(plugin.PalpateCameraConfig(feed=str(tmp_path / "feed"), fps=10))
        made.feed = feed
        with saying(feed, NOTHING):
            made.connect()
            for _ in range(8):
                made.read()
        yield made
        if made.is_connected:
            made.disconnect()


def taken(camera: Any, *lines: dict[str, Any]) -> dict[str, float]:
    """The observation after these lines and a frame of the pressed skin."""
    camera.feed.say(*lines, feed_lines.frame(3, PRESSED))
    camera.async_read(2000)
    return camera.observation()


def test_frames_verdict_and_displacement(camera):
    """Counts, code, distance from the nearest position; a sweep clears the last answer."""
    assert camera.feed.asked[0] == {"frames": 10, "sweeps": False}
    first = camera.observation()
    assert (first["verdict_code"], first["moved_known"]) == (0, 0)
    for _ in range(12):  # the shown contact is a mean over 0.3 s
        found = taken(camera, feed_lines.verdict(1, 2.5))
    assert len([name for name in found if name.startswith("taxel")]) == 16
    assert (found["taxel_1_1"], found["taxel_2_3"]) == (PRESSED[0, 0], PRESSED[1, 2])
    assert found["verdict_code"] == 1 + feed_lines.LABELS.index("plastic rough")
    assert (found["verdict_probability"], found["verdict_usable"]) == (0.962, 1)
    assert found["moved_known"] == 1
    assert abs(found["moved_rows_mm"]) < 0.3
    assert abs(found["moved_cols_mm"]) < 0.3
    unsure = taken(camera, feed_lines.verdict(2, 3, "wood", "unsure"))
    assert (unsure["verdict_code"], unsure["verdict_usable"]) == (2, 0)
    assert taken(camera, feed_lines.state(sweeping=True))["verdict_code"] == 0
    camera.feed.say(*[feed_lines.frame(4, feed_lines.load(2.5, 1.5))] * 12)
    eventually(lambda: camera.observation()["moved_rows_mm"] > 2)


def test_the_image(camera):
    """Counts from black to white, four fifths high; below them verdict and displacement."""
    for _ in range(12):
        taken(camera, feed_lines.verdict(1, 2.5))
    image = camera.read_latest()
    assert (image.shape, image.dtype) == ((160, 128, 3), np.uint8)
    shown = image[16:128:32, 16:128:32]
    np.testing.assert_array_equal(shown, PRESSED[..., None].repeat(3, axis=2))
    code = 1 + feed_lines.LABELS.index("plastic rough")
    assert image[150, 10].tolist() == [code, 245, 255]
    assert image[150, 120, 2] == 255
    assert np.abs(image[150, 120, :2].astype(int) - 128).max() <= 3


def test_three_axes_have_colours(plugin):
    """Counts between `low` and `high`; no frame is black, and no displacement is marked."""
    form = {"rows": 1, "cols": 2, "axes": 3, "dtype": "float32", "rate_hz": 100, "window": 9}
    touch = plugin.LastTouch(feed_lines.hello(format=form, alignment=None))
    touch.take(feed_lines.health(1))
    assert not touch.image(10, 4, -1, 1)[:8].any()
    touch.take({"type": "frame", "taxels": [[[-1, 0, 1], [None, 9, -9]]]})
    image = touch.image(10, 4, -1, 1)
    assert image[0, [0, 3]].tolist() == [[0, 128, 255], [0, 255, 0]]
    assert image[9, 3].tolist() == [128, 128, 0]
    assert touch.values()["taxel_1_2_2"] == 9
    with pytest.raises(ValueError, match=r"\(1, 2\) .*\(1, 2, 3\)"):
        touch.take({"type": "frame", "taxels": [[1, 2]]})


def test_a_restarted_box_is_read_again(camera):
    """Nothing of the program before stays, and a skin that does not stream gives its reason."""

    def is_old(camera: Any) -> bool:
        try:
            camera.read_latest(20)
        except TimeoutError as e:
            return "ms old; " in str(e)
        return False

    taken(camera, feed_lines.verdict(1, 2.5))
    camera.feed.say(feed_lines.hello(pid=72), feed_lines.state("no-device", "the skin is off"))
    eventually(lambda: camera.observation()["verdict_code"] == 0)
    assert camera.observation()["taxel_2_2"] == 0
    with pytest.raises(TimeoutError, match="skin"):
        camera.async_read(50)
    eventually(lambda: is_old(camera))
    camera.feed.say({"type": "frame", "taxels": "?"})
    with pytest.raises(TimeoutError, match="line"):
        camera.async_read(300)


def test_what_cannot_be_read_is_refused(plugin, tmp_path, monkeypatch):
    """A wrong configuration, a box that is off, and calls out of turn."""
    for wrong, why in (
        ({"fps": 50}, "fps is 50; the feed gives 1 to 20"),
        ({"low": 9, "high": 9}, "low is 9 and high 9"),
        ({"height": 0}, "the image is 128x0"),
    ):
        with pytest.raises(ValueError, match=why):
            plugin.PalpateCameraConfig(**wrong)
    camera = plugin.PalpateCamera(plugin.PalpateCameraConfig(feed=str(tmp_path / "none")))
    with pytest.raises(ConnectionError, match="connected"):
        camera.read()
    monkeypatch.setattr(plugin, "PATIENCE_S", 0.3)
    with pytest.raises(ConnectionError, match="palpate"):
        camera.connect()
    assert not camera.is_connected
    camera.connect(warmup=False)
    with pytest.raises(ConnectionError, match="connected"):
        camera.connect()
    for call in (camera.read_latest, camera.observation):
        with pytest.raises(RuntimeError, match="palpate"):
            call()
    camera.disconnect()
    monkeypatch.setattr(plugin, "DEFAULT", str(tmp_path / "none"))
    assert plugin.PalpateCamera.find_cameras() == []


@pytest.mark.slow
def test_lerobot_itself_finds_and_reads_it(tmp_path):
    """By its distribution's prefix and a command line; observations become features."""
    in_lerobot = dedent("""
    import json, sys
    import draccus
    from dataclasses import dataclass, field
    from lerobot.cameras import CameraConfig
    from lerobot.cameras.utils import make_cameras_from_configs
    from lerobot.datasets.utils import hw_to_dataset_features
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()

    @dataclass
    class Robot:
        cameras: dict[str, CameraConfig] = field(default_factory=dict)

    words = '{skin: {type: palpate, fps: 10, width: 64, height: 80, feed: "%s"}}' % sys.argv[1]
    robot = draccus.parse(Robot, args=[f"--cameras={words}"])
    (camera,) = make_cameras_from_configs(robot.cameras).values()
    with camera:
        image, observation = camera.read(), camera.observation()
        latest = camera.read_latest()
    state = {name: type(value) for name, value in observation.items()}
    features = hw_to_dataset_features(state | {"skin": latest.shape}, "observation")
    print(json.dumps({
        "type": robot.cameras["skin"].type,
        "shape": image.shape,
        "code": observation["verdict_code"],
        "features": {name: [one["dtype"], list(one["shape"])] for name, one in features.items()},
    }))
    """)
    lerobot.required()
    with lerobot.played(tmp_path / "feed") as feed, saying(feed, PRESSED):
        found = lerobot.run(in_lerobot, tmp_path / "feed")
    assert found == {
        "type": "palpate",
        "shape": [80, 64, 3],
        "code": 0,
        "features": {
            "observation.state": ["float32", [22]],
            "observation.images.skin": ["video", [80, 64, 3]],
        },
    }

"""A sensor of LeRobot: frames, verdict and displacement of a box, from its feed (PROTOCOL.md, part
4).

LeRobot imports every distribution whose name begins with `lerobot_camera_`, finds the camera of a
configuration by its class name, and keeps an image of each camera with each observation.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from palpate.alignment.live import ContactTracker, Expected
from palpate.client.feed import DEFAULT, Feed
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError
from palpate.core.schema import typed
from palpate.core.types import SweepFormat

MOST_HZ = 20
"""Most frames a second that the feed gives."""
PATIENCE_S = 5.0
"""Longest wait for the box in `connect` and `read`."""
LOOK_S = 0.1
BAND = 5
"""The lowest of so many parts of the image shows verdict and displacement."""
NONE, PER_MM = 128, 10
"""Brightness of no displacement, and its change for each millimetre."""
CHANNELS = 3


@CameraConfig.register_subclass("palpate")
@dataclass(kw_only=True)
class PalpateCameraConfig(CameraConfig):  # type: ignore[misc]  # lerobot has no types
    """feed: socket of the box, or its end of `ssh -L`. fps: 1 to 20. low, high: raw counts that are
    black and white. width, height: of the image, in pixels."""

    feed: str = DEFAULT
    fps: int | None = MOST_HZ
    width: int | None = 128
    height: int | None = 160
    low: float = 0.0
    high: float = 255.0

    def __post_init__(self) -> None:
        if not 0 < (self.fps or 0) <= MOST_HZ:
            raise ValueError(f"fps is {self.fps}; the feed gives 1 to {MOST_HZ} frames a second")
        if not self.low < self.high:
            raise ValueError(f"low is {self.low} and high {self.high}; give raw counts, low first")
        if not (self.width and self.height):
            raise ValueError(f"the image is {self.width}x{self.height}; give its size in pixels")


class LastTouch:
    """The last news of a box: its frame, its verdict and where the contact is.

    hello: the first line of the feed. frame: raw counts [R, C] or [R, C, A], None before the first.
    status, label: of the last sweep, "" while a sweep runs and before the first. moved_mm: along
    rows and columns, from the nearest position of the training, None if that is unknown. trouble:
    why the skin does not stream. Raises KeyError, TypeError, ValueError or ApplianceError for a
    line that does not fit its type.
    """

    def __init__(self, hello: Mapping[str, Any]) -> None:
        self.format = typed(SweepFormat, dict(hello["format"]))
        self.labels = tuple(map(str, hello["labels"]))
        self.frame: NDArray[np.float64] | None = None
        self.status = self.label = self.trouble = ""
        self.probability = 0.0
        self.moved_mm: tuple[float, float] | None = None
        self._skin = ""
        offered = replace(self.format, rate_hz=float(hello["frames_hz"]))
        expected = Expected.read(offered, hello.get("alignment") or {}, str(hello["bundle"]))
        self._tracker = ContactTracker(expected, str(hello["source"]))

    @property
    def code(self) -> int:
        """The code of the label on the class bits; 0 without one."""
        return self.labels.index(self.label) + 1 if self.label in self.labels else 0

    def take(self, line: Mapping[str, Any]) -> bool:
        """Take another line of the feed; whether it brought a frame."""
        kind = line["type"]
        if kind in ("health", "state"):
            self._skin, self.trouble = str(line["skin"]), str(line["trouble"])
            if self._skin != "streaming":
                self.frame = self.moved_mm = None
                self._tracker.reset()
            if line["sweeping"]:  # an answer of the sweep before is of another touch
                self.status, self.label, self.probability = "", "", 0.0
        elif kind == "verdict":
            self.status, self.label = str(line["status"]), str(line["label"])
            self.probability = float(line["probability"])
        elif kind == "frame":
            self._put(np.array(line["taxels"], np.float64))
            return True
        return False

    def image(self, height: int, width: int, low: float, high: float) -> NDArray[np.uint8]:
        """The frame above, a band with verdict and displacement below; [height, width, 3].

        A skin with one axis is grey; of one with two or three, each axis has a colour. Left half of
        the band: code, probability, whether the label can be used. Right half: displacement along
        rows and columns, whether it is known.
        """
        made = np.zeros((height, width, CHANNELS), np.uint8)
        upper = height - height // BAND
        if self.frame is not None:
            counts = self.frame if self.frame.ndim == 3 else self.frame[..., None].repeat(3, axis=2)
            shade = np.clip((np.nan_to_num(counts, nan=low) - low) / (high - low), 0, 1)
            rows = np.arange(upper) * counts.shape[0] // upper
            cols = np.arange(width) * counts.shape[1] // width
            shown = np.rint(255 * shade)[rows][:, cols][..., :CHANNELS]
            made[:upper, :, : shown.shape[2]] = shown
        made[upper:, : width // 2] = (
            min(self.code, 255),
            round(255 * self.probability),
            255 * (self.status == "ok"),
        )
        moved = [min(max(NONE + PER_MM * mm, 0), 255) for mm in self.moved_mm or (0.0, 0.0)]
        made[upper:, width // 2 :] = (*map(round, moved), 255 * (self.moved_mm is not None))
        return made

    def values(self) -> dict[str, float]:
        """The same as numbers. A count that is not a number is 0, as are unknown distances."""
        frame = np.zeros(self.format.shape) if self.frame is None else np.nan_to_num(self.frame)
        rows_mm, cols_mm = self.moved_mm or (0.0, 0.0)
        return {
            **{_taxel(at): float(count) for at, count in np.ndenumerate(frame)},
            "verdict_code": float(self.code),
            "verdict_probability": self.probability,
            "verdict_usable": float(self.status == "ok"),
            "moved_rows_mm": rows_mm,
            "moved_cols_mm": cols_mm,
            "moved_known": float(self.moved_mm is not None),
        }

    def _put(self, counts: NDArray[np.float64]) -> None:
        if counts.shape != self.format.shape:
            raise ValueError(f"a frame of {counts.shape} instead of {self.format.shape}")
        self.frame = counts
        self._tracker.put(counts[None])
        view = self._tracker.view(self._skin, self.trouble)
        self.moved_mm = None
        if view.centre and view.nearest:
            rows, cols = (float(a - b) for a, b in zip(view.centre, view.nearest, strict=True))
            self.moved_mm = rows, cols


def _taxel(at: Sequence[int]) -> str:
    """The name of a count by its indices: row, column and axis from 1 on, as in sentences."""
    return "_".join(["taxel", *(str(i + 1) for i in at)])


class PalpateCamera(Camera):  # type: ignore[misc]  # lerobot has no types
    """The skin of a box as a camera of LeRobot.

    touch: the last news, None before the box has said hello. A thread reads the feed between
    `connect` and `disconnect`.
    """

    def __init__(self, config: PalpateCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.touch: LastTouch | None = None
        self._clock = SystemClock()
        self._new = threading.Condition()
        self._frames = self._taken = 0
        self._heard_ns = 0
        self._trouble = ""
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_connected(self) -> bool:
        return self._thread is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The box on this computer, if it offers its feed."""
        there = Path(DEFAULT).is_socket()
        return [{"name": "Palpate", "type": "palpate", "id": DEFAULT}] if there else []

    def connect(self, warmup: bool = True) -> None:
        """Connect to the box; with `warmup`, wait for a frame. Raises ConnectionError."""
        if self._thread:
            raise DeviceAlreadyConnectedError(f"{self.config.feed} is connected already")
        self._ending.clear()
        self._frames = self._taken = 0
        self._thread = threading.Thread(target=self._run, daemon=True, name="palpate-lerobot")
        self._thread.start()
        try:
            if warmup:
                self._wait(PATIENCE_S)
        except TimeoutError as e:
            self.disconnect()
            raise ConnectionError(str(e)) from e

    def disconnect(self) -> None:
        self._required()
        self._ending.set()
        if self._thread:
            self._thread.join(PATIENCE_S)
        self._thread = None

    def read(self) -> NDArray[np.uint8]:
        """The image of the next frame, [height, width, 3]. Raises TimeoutError."""
        self._required()
        with self._new:
            self._taken = self._frames
        return self._next(PATIENCE_S)

    def async_read(self, timeout_ms: float = 200) -> NDArray[np.uint8]:
        """The image of the newest frame that was not returned yet. Raises TimeoutError."""
        self._required()
        return self._next(timeout_ms / 1e3)

    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:
        """The image of the newest frame. Raises TimeoutError if it is older than `max_age_ms`, and
        RuntimeError before the first frame."""
        self._required()
        with self._new:
            if not self._frames:
                raise RuntimeError(self._why())
            age_ms = (self._clock.now_ns() - self._heard_ns) / 1e6
            if age_ms > max_age_ms:
                raise TimeoutError(f"the newest frame is {age_ms:.0f} ms old; {self._why()}")
            return self._image()

    def observation(self) -> dict[str, float]:
        """Frame, verdict and displacement as numbers, for a robot that adds them to its state.
        Raises RuntimeError before the box has said hello."""
        self._required()
        with self._new:
            if not self.touch:
                raise RuntimeError(self._why())
            return self.touch.values()

    def _next(self, timeout_s: float) -> NDArray[np.uint8]:
        with self._new:
            self._wait(timeout_s)
            self._taken = self._frames
            return self._image()

    def _wait(self, timeout_s: float) -> None:
        """Wait for a frame that was not returned yet."""
        with self._new:
            if not self._new.wait_for(lambda: self._frames > self._taken, timeout_s):
                raise TimeoutError(self._why())

    def _image(self) -> NDArray[np.uint8]:
        known = self.config
        assert self.touch  # a frame has come
        return self.touch.image(known.height or 0, known.width or 0, known.low, known.high)

    def _why(self) -> str:
        """The reason why no frame comes, for a person."""
        why = self._trouble or (self.touch.trouble if self.touch else "")
        return f"{self.config.feed}: {why or 'no frame comes; see palpate status'}"

    def _required(self) -> None:
        if not self._thread:
            raise DeviceNotConnectedError(f"{self.config.feed} is not connected; call connect")

    def _run(self) -> None:
        with Feed(self.config.feed, frames_hz=self.config.fps or MOST_HZ) as feed:
            while not self._ending.is_set():
                line = feed.read(LOOK_S)
                with self._new:
                    self._trouble = feed.trouble or self._trouble
                    if line is not None and self._take(line):
                        self._frames, self._heard_ns = self._frames + 1, self._clock.now_ns()
                        self._new.notify_all()

    def _take(self, line: Mapping[str, Any]) -> bool:
        """Take a line; whether it brought a frame."""
        self._trouble = ""
        try:
            if line["type"] == "hello":  # another program or bundle: nothing of the last holds
                self.touch = LastTouch(line)
                return False
            return self.touch is not None and self.touch.take(line)
        except (KeyError, TypeError, ValueError, ApplianceError) as e:
            self._trouble = f"a line of the feed does not fit PROTOCOL.md: {e!r}"
            return False

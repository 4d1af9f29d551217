"""The makers' and users' own packages read the emulated skins, a process each."""

import json
import subprocess
import sys

import numpy as np
import pytest

from tests.factories.skins.played import Numbered, played

FRAMES = 20
ASKED = ("paxini", "synria", "dfrobot-tactile")
"""Skins that answer with their newest frame, which may be asked for twice."""
READERS = {
    "flexitac": """
from flexitac import FlexiTacSensor
with FlexiTacSensor(port, rows=12, cols=32, baseline=0.0) as sensor:
    frames = [sensor.read().raw for _ in range(n)]
""",
    "anyskin": """
from anyskin import AnySkinBase
frames = [sample[1:] for sample in AnySkinBase(num_mags=5, port=port).get_data(n)]
""",
    "reskin": """
from anyskin import AnySkinBase
skin = AnySkinBase(num_mags=5, port=port, burst_mode=False)
frames = [sample[1:] for sample in skin.get_data(n + 1)][1:]
""",
    "robotiq-tsf": """
from pyrobotiqtactile import RobotiqTactileSensor
sensor = RobotiqTactileSensor().connect(port)
sensor.configure(update_period_ms=16)
seen = {}  # by the skin's time: the package returns its frame whenever a byte comes, also twice
while len(seen) < n:
    frame = sensor.read_frame(timeout=10)
    seen.update({int(frame.timestamp[0]): frame} if frame.timestamp[0] else {})
frames = list(seen.values())
assert all(len(f.pressure) == 2 and f.accelerometer[1].tolist() == [0, 0, 16384] for f in frames)
frames = [f.pressure for f in frames]
""",
    "paxini": """
from paxini_sdk import SingleSensorBoard
with SingleSensorBoard(port, n_points=9) as board:
    frames = [[p.as_tuple() for p in board.read_distributed_force()] for _ in range(n)]
""",
    "synria": """
from tactile_sdk import TactilePressureSDK
sdk = TactilePressureSDK(port, 1, baudrate=4000000)
sdk.connect()
frames = [sdk.pressure.read_all().values for _ in range(n)]
""",
    "dfrobot-tactile": """
from pymodbus.client import ModbusSerialClient
client = ModbusSerialClient(port, baudrate=115200)
assert client.connect()
frames = [client.read_input_registers(7, count=32, device_id=1).registers for _ in range(n)]
""",
}
"""Each skin's reader, by its own documentation. ReSkin's text has no first frame: a reader joins in
the middle of a line."""


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_a_package_that_is_not_ours_reads_what_was_played(name: str) -> None:
    """Every frame that it reads was played, in order; text is rounded to two digits."""
    end = "\nprint(json.dumps([np.asarray(f).ravel().tolist() for f in frames]))"
    with played(name) as player:
        program = (
            "import json, numpy as np\nport, n "
            f"= {str(player.path)!r}, {FRAMES}\n{READERS[name]}{end}"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
        )
    assert done.returncode == 0, done.stderr[-800:]
    read = np.array(json.loads(done.stdout.splitlines()[-1]))
    source = Numbered(name)
    numbers = [_number(frame, source) for frame in read]
    assert len(numbers) == FRAMES
    steps = np.diff(numbers) % 199
    assert (steps >= (name not in ASKED)).all()
    if name not in ASKED:
        assert np.median(steps) == 1  # a busy reader drops what waited too long


def _number(frame: np.ndarray, source: Numbered) -> int:
    """The number of the frame that was played and looks so."""
    same = [
        i for i in range(199) if np.allclose(source.frame(i).ravel(), frame, rtol=0, atol=0.0051)
    ]
    assert len(same) == 1, f"no such frame was played: {frame[:8]}…"
    return same[0]

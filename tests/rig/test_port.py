"""The serial line on a real kernel: noise, no reader, no port, another program."""

from pathlib import Path

import numpy as np

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core.sentences import MAX_LINE, checksum
from tests.rig.cell import Cell, Touch
from tests.rig.far_end import ADAPTER, FarEnd
from tests.rig.notes import Count, Note
from tests.rig.sound import not_wrong

PORT = "/dev/palpate-robot"
DROPPED, LOST_FRAMES = 8, 5
"""Fields of STA, counted from 0."""
AS_NOBODY = "setpriv --reuid nobody --regid dialout --clear-groups"
HOLD = (
    "import fcntl, sys, termios, time; f = open(sys.argv[1]); "
    "fcntl.ioctl(f, termios.TIOCEXCL); time.sleep(600)"
)


def shown(cell: Cell) -> Touch:
    """RESULT VALID rises with the code of the touched material, or of none."""
    cell.until_ready()
    before, touch = len(cell.lines.log), cell.touch()
    valid = ("RESULT-VALID", True)
    cell.until(
        lambda: valid in [(name, level) for _, name, level in cell.lines.log[before:]],
        60,
        "the sweep was not answered",
    )
    labels = bundle.load(bundle.DEFAULT).manifest.labels
    assert cell.lines.code() in (0, 1 + labels.index(touch.act.label))
    return touch


def test_cable_out(cell: Cell, note: Note) -> None:
    """Without a robot sweeps show on the lines; when it is back it hears the next."""
    answered = int(cell.state()[3])
    cell.serial.close()
    try:
        shown(cell)
    finally:
        cell.serial.open()
    assert cell.state()[3] == str(answered + 1)
    assert cell.serial.ask("$PPLP,ID").startswith("$PPLP,ANS,ID,ok")
    note("cable of the serial line out", "lines go on; sentences again when it is in", 1)


def test_peer_does_not_read(cell: Cell, count: Count, note: Note) -> None:
    """The oldest are dropped and counted, no frame is lost; the newest come whole."""
    begun, before = cell.clock.now_s(), cell.state()
    cell.serial.deaf = True
    since = len(cell.serial.heard)
    for _ in range(200):  # the line alone holds some: QEMU's, the port's and the kernel's
        cell.serial.say(b"$PPLP,STATE\r\n")
        cell.wait(0.01)
    touch = shown(cell)
    cell.clock.sleep_until(round((begun + count(8, 60)) * 1e9))
    assert (
        len(cell.serial.heard) <= since + 9
    )  # a last look had begun, and may have brought several lines
    cell.serial.deaf = False
    cell.serial.say(b"$PPLP,ID\r\n")
    cell.serial.wait_for("$PPLP,ANS,ID,ok", 30, since)  # all that waited is out before this
    after = cell.state()
    heard = [line for _, line in cell.serial.heard[since:]]
    dropped = int(after[DROPPED]) - int(before[DROPPED])
    assert dropped > 0
    assert after[LOST_FRAMES] == before[LOST_FRAMES]
    (result,) = [line for line in heard if ",RES," in line]
    answer = Answer.read(result)
    assert answer
    not_wrong(touch, answer)
    assert all(sound(line) for line in heard[1:])  # the first may have been cut
    # sent: 200 answers, a result and a state each second; sentences that were not dropped arrived
    assert 200 + 1 - dropped < len(heard) < 200 + 1 - dropped + 2 * count(8, 60)
    note(
        f"robot does not read for {count(8, 60)} s",
        "sweep shown on the lines, sentences dropped and counted",
        dropped,
    )


def sound(line: str) -> bool:
    """Whether a line is a whole sentence."""
    body, _, given = line.removeprefix("$").partition("*")
    return line.startswith("$PPLP,") and given == checksum(body)


def test_break_and_noise(cell: Cell, count: Count, note: Note) -> None:
    """After noise and half sentences each whole command is answered once."""
    for _ in range(count(3, 100)):
        cell.machine.qmp("chardev-send-break", id="robot")
        assert cell.serial.ask("$PPLP,ID").startswith("$PPLP,ANS,ID,ok")
    note("break", "the next command is obeyed", count(3, 100))
    rng = np.random.default_rng(1)
    times = count(10, 300)
    for _ in range(times):
        junk = rng.bytes(int(rng.integers(1, MAX_LINE - 16))).translate(None, b"\r\n$")
        since = len(cell.serial.heard)
        cell.serial.say(
            junk
            + b"$PPLP,ID\r\n"
            + junk[:20]
            + b"\r\n$PPLP,STA"
            + junk[20:40]
            + b"$PPLP,NEW\r\n$PPLP,TES"
        )
        cell.serial.wait_for("$PPLP,ANS,NEW,ok", 10, since)
        answers = [
            line.split("*")[0].split(",")[2:4]
            for _, line in cell.serial.heard[since:]
            if ",ANS," in line
        ]
        assert [a for a in answers if a[1] == "ok"] == [["ID", "ok"], ["NEW", "ok"]]
        assert len(answers) <= 4
        cell.serial.say(b"\n")
    note("commands amid noise", "each answered", 2 * times)
    size = count(10_000, 100_000)
    for junk in (b"x" * size, rng.bytes(size)):
        since = len(cell.serial.heard)
        cell.serial.say(junk + b"\r\n")
        # by then noise is separated from commands, and answered; a robot waits at least as long
        cell.state()
        cell.serial.say(b"$PPLP,ID\r\n")
        cell.serial.wait_for("$PPLP,ANS,ID,ok", 60, since)
    assert len(cell.state()) == 17
    note(f"{size} bytes of noise, with line ends and without", "the next command is obeyed", 2)


def tries(cell: Cell, port: str) -> str:
    """The error message for a user of group dialout who opens a port."""
    return cell.machine.run(f"{AS_NOBODY} sh -c ': < {port}'").out


def test_another_program_and_an_adapter(
    cell: Cell, tmp_path: Path, count: Count, note: Note
) -> None:
    """The kernel keeps other users off the port, but not root, until the box is killed; a port that
    another program holds is taken when it is free; an adapter is pulled and put in again. The last
    test of this guest: the settings stay.
    """
    assert "busy" in tries(cell, PORT)
    assert cell.machine.run(f": < {PORT}").rc == 0
    settings = cell.machine.get("/etc/palpate/palpate.toml").decode().replace(PORT, ADAPTER)
    cell.machine.put("/etc/palpate/palpate.toml", settings.encode())
    far = plug(cell, tmp_path / "robot", first=True)
    assert cell.machine.run(f"until test -e {ADAPTER}; do sleep .1; done", timeout_s=20).rc == 0
    hold = f"{AS_NOBODY} python3 -c '{HOLD}' {ADAPTER}"
    cell.machine.run(f"{hold} > /dev/null 2>&1 & echo $! > /run/holder", check=True)
    cell.machine.run("systemctl kill -s KILL palpate", check=True)
    assert cell.lines.wait("READY", False, 20)
    assert tries(cell, PORT) == ""
    cell.until_ready()
    told = "end the program that has it"
    cell.until(lambda: told in cell.journal(), 20, "the held port is not reported")
    assert far.heard == []
    cell.machine.run("kill $(cat /run/holder)", check=True)
    far.wait_for("$PPLP,STA,", 10)
    note(
        "port held by another program",
        "reported, taken when it is free; it is refused to others",
        1,
    )
    assert "busy" in tries(cell, ADAPTER)
    times = count(2, 30)
    for i in range(times):
        cell.machine.qmp("device_del", id="adapter")
        cell.machine.run(f"while test -e {ADAPTER}; do sleep .05; done", check=True)
        far.close()
        far = plug(cell, tmp_path / f"robot{i}")
        far.wait_for("$PPLP,STA,", 20)
        assert far.ask("$PPLP,ID").startswith("$PPLP,ANS,ID,ok")
    # an emulator that was busy with all this has a board with seconds of frames in hand
    cell.restore()
    shown(cell)
    far.wait_for("$PPLP,RES,", 5)
    assert "opened again" in cell.journal()
    note("serial adapter pulled and put in again", "sentences come again", times)


def plug(cell: Cell, path: Path, *, first: bool = False) -> FarEnd:
    """Plug an FTDI adapter in; the robot's end of it."""
    if not first:
        cell.machine.qmp("chardev-remove", id="adapter")
    address = {"type": "unix", "data": {"path": str(path)}}
    backend = {"type": "socket", "data": {"addr": address, "server": True, "wait": False}}
    cell.machine.qmp("chardev-add", id="adapter", backend=backend)
    far = FarEnd(path, cell.clock)
    cell.machine.qmp(
        "device_add",
        driver="usb-serial",
        id="adapter",
        chardev="adapter",
        bus="xhci.0",
        serial="R1",
        **{"always-plugged": True},
    )
    return far

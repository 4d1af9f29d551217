"""The Modbus bridge, seen by pymodbus's client and by bytes put together by hand."""

from __future__ import annotations

import itertools
import json
import random
import socket
import struct
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient

from palpate.bridges import modbus, modbus_pdu, source
from palpate.bridges.modbus import ADDRESSES, COILS, INPUTS, STALE, STATUS_CODES, inputs, registers
from palpate.bridges.source import BoxView, noted
from palpate.cli.main import main
from palpate.client.answers import Answer, BoxState
from palpate.core.errors import FormatError
from palpate.core.sentences import Sentence, read, sentence
from palpate.core.status import Status
from tests.factories import feed_lines, speaking_box
from tests.factories.bridges import LONG_S, RawModbus, bridge, eventually
from tests.factories.paths import ROOT
from tests.factories.speaking_box import LABELS, SpeakingBox, finger, obeying, result, state

pytestmark = pytest.mark.usefixtures("hurried")

Address = tuple[str, int]
START, STOP, NEW = (COILS.index(name) for name in ("START", "STOP", "NEW"))


@pytest.fixture
def address(box: SpeakingBox) -> Iterator[Address]:
    """A bridge to it that may write."""
    with bridge("modbus", "--port", box.path, "--allow-writes") as there:
        yield there


LOWER = bytes.fromhex("0f000000050100")
"""The write of 0 to all coils, with which a connection begins."""


@pytest.fixture
def raw(box: SpeakingBox, address: Address) -> Iterator[RawModbus]:
    """A hand-made client; the box has been heard, and its labels are known."""
    box.say(state())
    with RawModbus(address) as client:
        eventually(lambda: client.registers(ADDRESSES["labels"], 1) == [len(LABELS)])
        client.ask(LOWER)
        yield client


def word(client: RawModbus, name: str) -> int:
    """One register by its name."""
    return client.registers(ADDRESSES[name], 1)[0]


def sweeps(box: SpeakingBox) -> list[str]:
    """The commands of coils that the box has heard."""
    return [s.kind for s in box.heard if s.kind in COILS]


def test_another_client_reads_the_map(box, raw, address):
    """pymodbus finds the answer in input and in holding registers, and the inputs."""
    box.say(result(70_000, label="paper"), state(answered=7))
    eventually(
        lambda: word(raw, "answered") == 0 and raw.registers(ADDRESSES["answered"], 2) == [0, 7]
    )
    with ModbusTcpClient(address[0], port=address[1], timeout=LONG_S) as client:
        for read_words in (client.read_input_registers, client.read_holding_registers):
            found = read_words(0, count=ADDRESSES["label"] + modbus.LABEL_WORDS)
            assert not found.isError()
            words = found.registers
            got = {name: words[at] for name, at in ADDRESSES.items()}
            wanted = {
                "map version": 1,
                "state of the skin": 1,
                "answers": 1,
                "status": STATUS_CODES[Status.OK],
                "label code": 2,
                "probability": 900,
                "margin": 800,
                "latency": 125,
            }
            assert got | wanted == got
            assert words[ADDRESSES["sweep"] :][:2] == [1, 70_000 - 65_536]
            text = client.convert_from_registers(
                words[ADDRESSES["label"] :], client.DATATYPE.STRING
            )
            assert text.rstrip("\0") == "paper"
        bits = client.read_discrete_inputs(0, count=len(INPUTS)).bits
        on = {name for name, bit in zip(INPUTS, bits, strict=False) if bit}
        assert on == {"alive", "ready", "known"}


MEASURED_AT = 42


def test_the_measured_slide_is_read_and_zero_before(box, raw):
    """Tenths of mm/s and a code, not writable; before anything was heard all are zero."""
    # The optional fields of an answer, and the two registers
    measured = (
        ((), [0, 0]),
        ((1,), [0, 0]),
        (("", "30.5", "rows+"), [305, 1]),
        ((1, "8.0", "rows-"), [80, 2]),
        (("", "400.0", "cols+"), [4000, 3]),
        (("", "9999.9", "cols-"), [65535, 4]),
        (("", "30.5", "sideways"), [305, 0]),
    )
    for number, (optional, words) in enumerate(measured, 1):
        box.say(result(number, optional=optional))
        eventually(lambda number=number: word(raw, "answers") == number)
        assert raw.registers(MEASURED_AT, 2) == words, optional
    assert modbus.SLIDE_AT + len(modbus.SLIDE) == MEASURED_AT
    words = registers(BoxView(), alive=False)
    assert {i: w for i, w in enumerate(words) if w} == {0: 1, ADDRESSES["status"]: STALE}
    assert inputs(BoxView(), alive=False) == [False, False, False, True, False, False]


def test_the_fingers_are_read(box, raw):
    """Name, status, code and probability of each; 0 without, also after one skin's answer."""
    fingers_at = 44
    box.say(finger("left", 1, "ok", "paper"))
    box.say(finger("right", 1, "no-contact", "", "0.000"))
    box.say(result(1, label="paper"))
    eventually(lambda: word(raw, "answers") == 1)
    eventually(lambda: word(raw, "label code") == 2)
    found = raw.registers(fingers_at, 1 + 4 * 7)
    assert found[0] == 2
    assert b"".join(w.to_bytes(2, "big") for w in found[1:5]) == b"left\0\0\0\0"
    assert found[5:8] == [STATUS_CODES[Status.OK], 2, 900]
    assert b"".join(w.to_bytes(2, "big") for w in found[8:12]) == b"right\0\0\0"
    assert found[12:15] == [STATUS_CODES[Status.NO_CONTACT], 0, 0]
    assert found[15:] == [0] * 14
    box.say(result(2))
    eventually(lambda: word(raw, "answers") == 2)
    assert raw.registers(fingers_at, 1 + 4 * 7) == [0] * 29


def test_another_client_sweeps(box, raw, address):
    """pymodbus writes speed and force, pulses the coils: the box hears each once, in order."""
    with ModbusTcpClient(address[0], port=address[1], timeout=LONG_S) as client:
        assert not client.write_registers(modbus.SLIDE_AT, [305, 150]).isError()
        assert not client.write_coils(0, [False] * len(COILS)).isError()
        for coil in (NEW, START, STOP):
            assert not client.write_coil(coil, True).isError()
            assert not client.write_coil(coil, True).isError()  # still on: no second command
            assert client.read_coils(0, count=len(COILS)).bits[coil]
            assert not client.write_coils(coil, [False]).isError()
        eventually(lambda: word(raw, "answers") == 1)
    assert sweeps(box) == ["NEW", "START", "STOP"]
    assert [s.fields for s in box.heard if s.kind == "START"] == [["30.5", "1.5"]]


def test_bytes_by_hand(raw):
    """Requests and replies as the specification prints them, with exception codes."""
    raw.send(bytes.fromhex("0400000001"), transaction=0x1234, unit=7)
    assert raw.receive().hex() == "123400000005" + "07" + "0402" + "0001"
    for pdu, code in (
        ("0400270064", 2),  # beyond the map
        ("04ffff0001", 2),
        ("0400000000", 3),  # no register
        ("040000007e", 3),  # 126 of them
        ("0100000000", 3),
        ("01000007d1", 3),
        ("04000000", 3),  # a byte short
        ("0400000001ff", 3),
        ("0500000001", 3),  # neither on nor off
        ("0f0000000301", 3),  # without its coils
        ("0f00000003020700", 3),
        ("050005ff00", 2),  # a coil that is not there
        ("0f0003000301ff", 2),
        ("0600000001", 2),  # a register that is not written
        ("1000000001020001", 2),
        ("10002800010100", 3),  # half a register
        ("2b0e0100", 1),
        ("00", 1),
        ("ff", 1),
    ):
        reply = raw.ask(bytes.fromhex(pdu))
        assert reply == bytes([int(pdu[:2], 16) | 0x80, code]), pdu


def test_a_request_in_pieces_and_several_in_one(raw):
    """TCP keeps no boundaries: byte by byte, and three at once."""
    one = struct.pack(">HHHB", 9, 0, 6, 1) + bytes.fromhex("0400000001")
    for byte in one:
        raw.socket.sendall(bytes([byte]))
    assert raw.receive()[:2] == b"\0\x09"
    raw.socket.sendall(one * 3)
    assert [raw.receive() for _ in range(3)] == [
        one[:4] + b"\0\x05\x01" + bytes.fromhex("04020001")
    ] * 3


def test_nothing_is_written_without_leave(box):
    """Without --allow-writes a write is an illegal function; reading works."""
    with bridge("modbus", "--port", box.path) as address, RawModbus(address) as client:
        for pdu in ("050000ff00", "0f0000000501ff", "060028000a", "1000280001020001"):
            assert client.ask(bytes.fromhex(pdu)) == bytes([int(pdu[:2], 16) | 0x80, 1])
        assert client.registers(0, 1) == [1]
    assert {s.kind for s in box.heard} <= {"LABEL"}


def test_one_command_at_a_time(box, raw, address):
    """Meanwhile another peer gets BUSY, and reading goes on; then its write is sent."""
    box.script = lambda s: [] if s.kind == "TARE" else obeying(s)
    raw.send(bytes.fromhex("050003ff00"))
    box.wait_for("TARE")
    with RawModbus(address) as other:
        other.ask(LOWER)
        assert other.ask(bytes.fromhex("050000ff00")) == b"\x85\x06"
        assert other.registers(0, 1) == [1]
        box.say(sentence("ANS", "TARE", "ok", "16 taxels"))
        assert raw.receive()[7:] == bytes.fromhex("050003ff00")
        assert other.ask(bytes.fromhex("050000ff00")) == bytes.fromhex("050000ff00")
    assert sweeps(box) == ["TARE", "START"]


def test_a_silent_box_is_stale_and_comes_back(box, raw):
    """Unplugged: status 99, state 0, FAULT, a still heartbeat, until it is plugged in again."""
    box.say(result(1))
    eventually(lambda: word(raw, "status") == 1)
    box.unplug()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(source, "STALE_S", 0.1)
        eventually(lambda: word(raw, "status") == STALE)
        before = word(raw, "heartbeat")
        after = [word(raw, name) for name in ("state of the skin", "label code", "answers")]
        assert after == [0, 0, 1]
        assert raw.ask(bytes.fromhex("0200000006")) == bytes.fromhex("020108")
        assert raw.ask(bytes.fromhex("050000ff00")) == b"\x85\x04"
    box.plug_in()

    def back() -> bool:
        box.say(state(answered=1))
        return word(raw, "heartbeat") > before

    eventually(back)
    assert (word(raw, "status"), word(raw, "state of the skin")) == (1, 1)


def test_another_bundle_brings_its_labels(box, raw):
    """The box restarts with another bundle: its labels are asked for, codes follow them."""

    def other(heard: Sentence) -> list[bytes]:
        return (
            [sentence("ANS", "LABEL", "ok", 1, "cork", 1)]
            if heard.kind == "LABEL"
            else obeying(heard)
        )

    box.script = other
    box.say(state(bundle="00000001"), result(1, label="cork"))
    eventually(lambda: word(raw, "labels") == 1)
    assert word(raw, "label code") == 1


def test_hostile_bytes_reach_nobody_else(raw, address):
    """Noise, wrong headers, endless, half or unread bytes cost their own connection."""

    def flood(peer: socket.socket) -> None:
        """Send requests without end, and read no reply."""
        while True:
            peer.sendall((struct.pack(">HHHB", 9, 0, 6, 1) + bytes.fromhex("0400000020")) * 1000)

    generator = random.Random(1)
    for data in [
        *(generator.randbytes(generator.randrange(1, 400)) for _ in range(100)),
        b"\0\1\0\1\0\6\1\4\0\0\0\1",
        b"\0\1\0\0\0\0\1",
        b"\0\1\0\0\xff\xff\1",
        b"GET / HTTP/1.1\r\nHost: box\r\n\r\n",
        b"\xff" * 100_000,
    ]:
        with socket.create_connection(address, timeout=LONG_S) as peer:
            try:
                peer.sendall(data)
            except ConnectionError:
                continue  # closed on its way
    half = [socket.create_connection(address, timeout=LONG_S) for _ in range(4)]
    for peer in half:
        peer.sendall(b"\0\1\0\0\0\6\1\4")
    deaf = socket.create_connection(address, timeout=0.2)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    with pytest.raises((TimeoutError, ConnectionError)):
        flood(deaf)
    assert raw.registers(0, 1) == [1]
    for peer in (*half, deaf):
        peer.close()
    assert raw.registers(0, 1) == [1]


def test_the_feed_in_place_of_the_line(tmp_path):
    """The same map; commands are refused; lines of a later version do no harm."""
    told = {"margin": 0.3, "share": 0.5, "measured_mm_s": 61.2, "direction": "cols-"}
    lines = [
        feed_lines.hello(labels=["wood", "paper"]),
        feed_lines.health(9, frames=70_000),
        {"type": "verdict", "status": "sideways"},
        feed_lines.verdict(6, 9.5, "paper", "unsure", **told),
        {"type": "later"},
        {"type": "lost", "lines": 4},
    ]
    path = tmp_path / "feed.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        with (
            bridge("modbus", "--feed", path, "--allow-writes") as address,
            RawModbus(address) as client,
        ):
            connection, _ = listener.accept()
            connection.sendall(b"".join(json.dumps(line).encode() + b"\n" for line in lines))
            eventually(lambda: word(client, "missed answers") == 4)
            wanted = {
                "status": STATUS_CODES[Status.UNSURE],
                "damaged sentences": 1,
                "label code": 0,
                "likeliest label code": 2,
                "early": 1,
            }
            assert {name: word(client, name) for name in wanted} == wanted
            assert client.registers(ADDRESSES["frames"], 2) == [1, 70_000 - 65_536]
            assert client.registers(MEASURED_AT, 2) == [612, 4]
            client.ask(LOWER)
            assert client.ask(bytes.fromhex("050000ff00")) == b"\x85\x04"
            connection.close()


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=5))
def test_requests_split_anywhere(data, cuts):
    """Any bytes, split anywhere: the same requests, or the same refusal."""
    data = b"\0\1\0\0\0\6\1\4\0\0\0\1" + data
    edges = sorted({0, len(data), *(c % (len(data) + 1) for c in cuts)})

    def whole() -> list[modbus_pdu.ModbusRequest] | None:
        try:
            return modbus_pdu.requests(data)[0]
        except FormatError:
            return None

    found: list[modbus_pdu.ModbusRequest] | None = []
    rest = b""
    try:
        for a, b in itertools.pairwise(edges):
            more, rest = modbus_pdu.requests(data[a:b], rest)
            found += more
    except FormatError:
        found = None
    assert found == whole()


@given(st.binary(min_size=1, max_size=253))
def test_every_pdu_is_parsed_or_refused(pdu):
    """No other error is raised; parsed requests stay within the limits of the specification."""
    try:
        wanted = modbus_pdu.parse(pdu)
    except modbus_pdu.RequestRefused:
        return
    count = wanted.count if isinstance(wanted, modbus_pdu.Reading) else len(wanted.values)
    assert 1 <= count <= modbus_pdu.MOST_BITS


@pytest.mark.parametrize("status", list(Status))
def test_each_status_has_its_code(status):
    """In the order of PROTOCOL.md, from 1; the label's code stands with `ok` alone."""

    def viewed(answer: Answer | None = None, **counts: int) -> BoxView:
        """A view of a box that streams."""
        said = BoxState.of(read(speaking_box.state()).fields)
        view = noted(BoxView(labels=LABELS), said, 1)
        return noted(view, answer, 1) if answer else view

    label = "paper" if status.classified else ""
    words = registers(viewed(Answer(1, 1.0, status, label, 0.9, 0.8, 1, 0, 1e9)), alive=True)
    assert words[ADDRESSES["status"]] == [*Status].index(status) + 1
    assert words[ADDRESSES["label code"]] == (2 if status is Status.OK else 0)
    assert words[ADDRESSES["likeliest label code"]] == (2 if status.classified else 0)
    assert words[ADDRESSES["latency"]] == 65535  # more than fits


def test_the_python_of_the_page_runs(box, raw, address):
    """modbus_client.py: `unsure` is swept again, `ok` gives its code, others errors."""
    names: dict[str, Any] = {}
    exec((ROOT / "docs" / "robots" / "modbus_client.py").read_text(), names)
    numbers = itertools.count(1)
    statuses = iter(["unsure", "ok", "unknown", "stuck-taxel"])

    def script(heard: Sentence) -> list[bytes]:
        answer = [result(next(numbers), next(statuses), "paper")] if heard.kind == "STOP" else []
        return [*obeying(heard)[:1], *answer]

    box.script = script
    with ModbusTcpClient(address[0], port=address[1], timeout=LONG_S) as plc:
        assert names["classify"](plc, lambda: None, timeout_s=LONG_S) == 2
        assert sweeps(box) == ["NEW", "START", "STOP", "START", "STOP"]
        assert names["classify"](plc, lambda: None, timeout_s=LONG_S) == 0
        with pytest.raises(RuntimeError, match="status 10"):
            names["classify"](plc, lambda: None, timeout_s=LONG_S)
        box.unplug()
        with pytest.raises(RuntimeError, match=r"coil 2|not heard"):
            names["classify"](plc, lambda: None, timeout_s=LONG_S)


@pytest.mark.parametrize(
    ("options", "code", "why"),
    [
        (["--port", "x", "--listen", "1502"], 78, "use HOST:PORT"),
        (["--port", "x", "--listen", "127.0.0.1:99999"], 78, "not an address"),
        (["--link", "/nowhere/line"], 78, "/nowhere/line"),
        (["--link", "/proc/version"], 78, "/proc/version"),
        # after a power cut the network may be late: systemd starts it again
        (["--port", "x", "--listen", "203.0.113.1:1502"], 69, "203.0.113.1"),
        (["--port", "x", "--most", "0"], 2, "--most"),
        (["--port", "x", "--link", "y"], 2, "--link"),
    ],
)
def test_settings_that_cannot_be(options, code, why, capsys):
    """The value is named, and the exit code is that of its kind."""
    try:
        ended = main(["bridge", "modbus", *options])
    except SystemExit as e:
        ended = e.code
    assert ended == code
    assert why in capsys.readouterr().err

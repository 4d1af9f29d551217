"""Faults of the system around the box: disk, clock, processor, memory, settings, bundle,
permissions.

The service of a guest keeps its sweeps on small file systems. Sweeps are answered as before, each
loss is logged once, and the box recovers without help.
"""

import base64
import json
import time
from collections import Counter
from pathlib import Path

import pytest

from palpate.client.answers import Answer
from palpate.sim import script
from palpate.sweeps.capture import Playback
from tests.rig.cell import Cell
from tests.rig.image import GUEST_PYTHON
from tests.rig.kept import DROP_IN, KEPT, runs_with
from tests.rig.notes import HOW, Count, Note
from tests.rig.sound import TRIES, begin, check_recovers, known, not_wrong, state, until_state

CAPTURE = "/run/capture"
ROOM = "mount -t tmpfs -o remount,size={},nr_inodes={} none {}"
START_S = 240
"""Longest wait for a service that has to start, also where the emulator shares its processor."""
ANSWER_S = 60
RULES = "/etc/udev/rules.d/70-palpate.rules"
BUNDLE = f"/opt/palpate/lib/python{GUEST_PYTHON}/site-packages/palpate/default_bundle"
SITE = "/etc/palpate/palpate.toml"
SECOND = "echo {} > /sys/devices/system/cpu/cpu1/online"
"""Turns the guest's second processor on or off."""
needs_time = pytest.mark.skipif(
    HOW != "full",
    reason="starts the service again; PALPATE_RIG=full python -m tests.campaigns test-rig",
)
DAMAGE = """
import pathlib, shutil
from palpate.bundle import bundle
from palpate.core import errors
whole, broken = pathlib.Path(bundle.DEFAULT), pathlib.Path("/run/broken")
for name in sorted(p.name for p in whole.iterdir()):
    data = (whole / name).read_bytes()
    for how, bad in (("cut", data[: len(data) // 2]), ("empty", b""), ("gone", None),
                     ("changed", data[:9] + bytes([data[9] ^ 1]) + data[10:])):
        shutil.rmtree(broken, ignore_errors=True)
        shutil.copytree(whole, broken)
        (broken / name).unlink() if bad is None else (broken / name).write_bytes(bad)
        try:
            print(name, how, "loads", bundle.load(broken).id)
        except errors.BundleError as e:
            print(name, how, "BundleError", e)
"""
"""Run in the guest: each file of a bundle cut short, empty, missing, and with one bit turned."""


@pytest.fixture(scope="module")
def keeping(shared: Cell) -> Cell:
    """The guest keeps sweeps and captures on file systems as small as wanted."""
    guest = shared.machine
    shared.acts, shared.packet_frames = known(script.tubes(2)), 48
    for place in (KEPT, CAPTURE):
        mount = f"mount -t tmpfs -o size=96k,uid=palpate,mode=755 none {place}"
        guest.run(f"mkdir -p {place} && {mount}", check=True)
    runs_with(guest, f"record --out {KEPT} --capture {CAPTURE}/all", f"ReadWritePaths={CAPTURE}")
    guest.run("systemctl restart --no-block palpate", check=True)
    shared.plug()
    shared.until_ready(START_S)
    return shared


@pytest.fixture
def box(keeping: Cell, cell: Cell) -> Cell:
    """That guest, READY, with space for a few sweeps."""
    cell.machine.run(ROOM.format("1m", 1000, KEPT), check=True)
    return cell


def sound(cell: Cell) -> Answer:
    """A sweep answered `recorded`, and all that follows in its turn."""
    answers = []
    for _ in range(TRIES):
        touch, answer = cell.sweep(ANSWER_S)
        answers.append(not_wrong(touch, answer))
        state(cell)
        if answer.status == "recorded":
            return answer
    raise AssertionError(f"no sweep is recorded: {answers}")


def journal_count(cell: Cell, text: str) -> int:
    """How many lines of the journal hold a text."""
    count = f"journalctl -u palpate -o cat | grep -cF '{text}'"
    return int(cell.machine.run(count, timeout_s=60).out)


def until_logged(cell: Cell, text: str, since: int = 0) -> None:
    """Wait until more than `since` lines hold it."""

    def there() -> bool:
        cell.wait(1)
        return journal_count(cell, text) > since

    cell.until(there, START_S, f"{text!r} not logged")


def files(cell: Cell) -> dict[str, str]:
    """Name and digest of each file of kept sweeps."""
    lines = cell.machine.out(f"cd {KEPT} && find . -type f -exec md5sum {{}} +").splitlines()
    return {line.split()[1]: line.split()[0] for line in lines}


def used_k(cell: Cell) -> int:
    """KiB of kept sweeps."""
    return int(cell.machine.out(f"df --output=used -k {KEPT} | tail -1"))


def test_disk_full_at_each_write(box: Cell, note: Note):
    """Every sweep is answered, the first failure is logged, only whole files stay."""
    empty = used_k(box)
    sound(box)
    before, used = files(box), used_k(box)
    pages = (used - empty) // 4  # of a whole sweep; with one less it does not fit
    limits, first = [*(range(pages) if HOW == "full" else [pages - 1]), -1], 0
    for n in limits:
        limit = (f"{used + 4 * n}k", 1000) if n >= 0 else ("1m", 1 + len(before))
        box.machine.run(ROOM.format(*limit, KEPT), check=True)
        answer = sound(box)
        first = first or answer.sweep
        assert journal_count(box, f"record: sweep {first} is not stored: ") == 1
        assert files(box) == before
    box.machine.run(ROOM.format("1m", 1000, KEPT), check=True)
    sound(box)
    assert files(box).items() > before.items()
    note(
        "disk full while a sweep is kept (ENOSPC at each page, no inode)",
        "answered; logged; no partial file",
        len(limits),
    )


def test_disk_full_of_a_capture(box: Cell, tmp_path: Path, note: Note):
    """Logged once, the capture ends, sweeps go on, the partial file plays."""
    until_logged(
        box, f"capture: {CAPTURE}/all cannot be written: No space left on device; it ends here"
    )
    sound(box)
    assert journal_count(box, "capture:") == journal_count(box, "it ends here") == 1
    pieces = [
        box.machine.run(f"dd if={CAPTURE}/all bs=12k skip={n} count=1 2>/dev/null | base64")
        for n in range(8)
    ]
    (tmp_path / "all").write_bytes(b"".join(base64.b64decode(piece.out) for piece in pieces))
    play, frames = Playback(tmp_path / "all"), 0
    while not play.finished:
        frames += len(play.read())
        play.edges(play.now_ns())
        play.commands()
    assert frames > 750
    note(
        "disk full while a capture is written", "ends there, logged once; what was written plays", 1
    )


@needs_time
def test_disk_full_for_the_journal(box: Cell, note: Note):
    """No space anywhere: sweeps and plugs go on; it is written again with space."""
    fill = (
        "fallocate -l $(df --output=avail -B1 {0} | tail -1) {0}/fill; "
        "dd if=/dev/zero of={0}/fill2 2>/dev/null;"
    )
    try:
        box.machine.run(fill.format("/run") + fill.format("/var"), timeout_s=200)
        box.unplug()
        assert box.lines.wait("FAULT", True, 30)
        box.plug()
        box.until_ready()
        sound(box)
    finally:
        box.machine.run("rm -f /run/fill* /var/fill*")
    logged = journal_count(box, "skin: ")
    box.unplug()
    until_logged(box, "skin: ", logged)
    box.plug()
    box.until_ready()
    note(
        "no space on any disk, journal included",
        "answered; replugged skin taken; journal goes on",
        1,
    )


def test_clock_set(box: Cell, note: Note):
    """An hour back, a year forward: answers, times and files know nothing of it."""
    for change in ("-1 hour", "+1 year"):
        touch, since = begin(box)
        box.machine.run(f"date -s \"$(date -d '{change}')\"", check=True)
        assert not_wrong(touch, box.answer(since, ANSWER_S)) in ("recorded", "gap")
        times = [
            float(line.split(",")[2])
            for _, line in box.serial.heard[since:]
            if line.startswith("$PPLP,STA,")
        ]
        assert times == sorted(times)
    sound(box)
    box.machine.run(f"hwclock -s || date -s @{int(time.time())}")
    texts = box.machine.run(
        f"cd {KEPT} && for f in *.json; do tr -d '\\n' < $f; echo; done", check=True
    ).out
    about = [json.loads(text) for text in texts.splitlines()]
    assert [a["start_ns"] for a in about] == sorted(a["start_ns"] for a in about)
    assert all(0 < a["stop_ns"] - a["start_ns"] < 6e9 for a in about)
    assert all(name[2:8] == "sweep-" for name in files(box))
    note(
        "clock set back an hour, forward a year, during a sweep",
        "answered; times and files unmoved",
        2,
    )


def by_hand(cell: Cell) -> str:
    """The status of a sweep over an empty skin, or none: edges three seconds apart."""
    since = len(cell.serial.heard)
    for name in ("START", "STOP"):
        for level in (True, False):
            cell.lines.set(name, level)
            cell.wait(0.3)
        cell.wait(2.5)
    return cell.answer(since, ANSWER_S).status


def swept(cell: Cell) -> str:
    """The status of a sweep; by hand where the board cannot know when frames come."""
    since = len(cell.serial.heard)
    touch = cell.touch()
    if cell.clock.until(touch.played.is_set, 10):
        return not_wrong(touch, cell.answer(since, ANSWER_S))
    cell.hand.touches.get_nowait()
    return by_hand(cell)


def test_processor_loaded(box: Cell, count: Count, note: Note):
    """Four programs that use all of the processor: each sweep is answered, losses are counted, no
    answer is wrong.

    The guest has only one processor during this test. Before release 8.1, QEMU with counted
    instructions ran the second only when the first was idle, so processes on it stood still for
    minutes (QEMU's commit 83ecdb18eb).
    """
    silent = "skin: the skin is there but sent no frame for"
    lost, logged = int(state(box)["lost"]), journal_count(box, silent)
    hogs = "for n in 1 2 3 4; do systemd-run -q --unit hog$n sh -c 'while :; do :; done'; done"
    box.machine.run(SECOND.format(0), timeout_s=START_S, check=True)
    try:
        box.machine.run(hogs, timeout_s=START_S, check=True)
        answers = Counter(swept(box) for _ in range(count(1, 8)))
    finally:
        box.machine.run(
            f"systemctl stop 'hog*' && {SECOND.format(1)}", timeout_s=START_S, check=True
        )
    # without a turn for half a second it takes the skin for silent, and starts it again
    assert answers.keys() <= {"recorded", "no-contact", "gap", "sensor-lost"}, box.journal(40)
    assert answers["sensor-lost"] <= journal_count(box, silent) - logged
    sound(box)
    more = int(state(box)["lost"]) - lost
    note(
        "four busy loops on one core",
        f"answered {dict(answers)}, {more} frames lost",
        answers.total(),
    )


def test_permission_lost(box: Cell, note: Note):
    """Skin and folder taken from the service: named; given back, used again."""
    guest = box.machine
    guest.run("chmod 000 /dev/bus/usb/*/*", check=True)
    sound(box)  # open files stay open
    guest.run(f"mv {RULES} /root/rules && udevadm control --reload", check=True)
    try:
        box.unplug()
        box.plug()
        until_state(box, "denied")
        assert box.lines.wait("FAULT", True, 10)
        assert by_hand(box) == "not-ready"
        until_logged(
            box,
            "skin may not be opened by this user (errno 13); "
            "install the udev rule, join group plugdev",
        )
    finally:
        guest.run(
            f"mv /root/rules {RULES} && udevadm control --reload && udevadm trigger -c add -s usb",
            check=True,
        )
    box.until_ready()
    before = files(box)
    guest.run(f"chown root {KEPT}", check=True)
    answer = sound(box)
    assert (
        journal_count(
            box,
            f"record: sweep {answer.sweep} is not stored: Permission denied; "
            f"see that {KEPT} may be",
        )
        == 1
    )
    assert files(box) == before
    guest.run(f"chown palpate {KEPT}", check=True)
    sound(box)
    assert files(box).items() > before.items()
    note(
        "permission lost: device node, folder",
        "denied and not-ready, or logged; used again when given back",
        3,
    )


@needs_time
def test_memory_limit(box: Cell, note: Note):
    """Memory cut to nothing: killed, started again, READY once it has memory."""
    restarts = "systemctl show -P NRestarts palpate"
    before, streamed = int(box.machine.run(restarts).out), journal_count(box, "skin: streaming")
    limit = "systemctl set-property --runtime palpate MemoryMax="
    box.machine.run(limit + "4M", timeout_s=120)
    until_logged(box, "oom-kill")
    box.machine.run(limit + "256M", timeout_s=120, check=True)
    until_logged(box, "skin: streaming", streamed)
    box.until_ready()
    sound(box)
    assert int(box.machine.run(restarts).out) > before
    note("memory limit reached", "killed, started again, READY", 1)


@needs_time
def test_settings_and_bundle_broken(box: Cell, note: Note):
    """A misspelt key, a cut bundle: named, READY low, no restart; mended, it comes up."""
    guest, again = box.machine, "systemctl restart --no-block palpate"
    settings = guest.get(SITE)
    guest.run(f"cp -r {BUNDLE} /run/bundle && truncate -s 1000 /run/bundle/model.onnx", check=True)
    guest.put(SITE, settings + b'\n[classifier]\nbundel = "/run/bundle"\n')
    guest.run(again, check=True)
    assert box.lines.wait("READY", False, 60)
    until_logged(box, f"{SITE}: classifier.bundel is unknown; did you mean classifier.bundle?")
    recording = guest.get(DROP_IN)
    runs_with(guest, "run")  # recording needs no bundle
    guest.put(SITE, settings + b'\n[classifier]\nbundle = "/run/bundle"\nallow_unsigned = true\n')
    guest.run(again, check=True)
    until_logged(box, "/run/bundle: model.onnx was altered")
    assert not box.lines.levels["READY"]
    guest.run(f"cp {BUNDLE}/model.onnx /run/bundle && {again}", check=True)
    box.until_ready(START_S)
    check_recovers(box)
    guest.put(SITE, settings)
    guest.put(DROP_IN, recording)
    guest.run(f"systemctl daemon-reload && {again}", check=True, timeout_s=60)
    box.until_ready(START_S)
    note(
        "settings with a misspelt key; bundle cut short",
        "named; exit 78, no loop; READY once mended and started",
        2,
    )


def test_bundle_files_broken(box: Cell, note: Note):
    """Cut, empty, missing, altered by one bit: a BundleError names each file."""
    logged = box.machine.run(
        "cd / && /opt/palpate/bin/python -I -", stdin=DAMAGE.encode(), timeout_s=200, check=True
    ).out
    lines = logged.splitlines()
    assert len(lines) >= 12
    for line in lines:
        name, _, what, why = line.split(" ", 3)
        assert what == "BundleError", line
        assert name.removesuffix(".json") in why or "no bundle at" in why, line
    note(
        "each file of a bundle cut, empty, missing, altered",
        "BundleError that names it",
        len(lines),
    )

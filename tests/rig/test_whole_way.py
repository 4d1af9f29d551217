"""The whole way on a real kernel: skin, edges, sentences, as a service on arm64."""

import statistics

from palpate.bundle import bundle
from tests.rig.cell import Cell
from tests.rig.kept import checked
from tests.rig.notes import Note

LABELS = bundle.load(bundle.DEFAULT).manifest.labels


def test_sweeps_become_sentences_and_codes(cell: Cell, note: Note):
    """Each start edge has one answer, right or with a reason; no frame is lost."""
    cell.packet_frames = 6
    cell.restore()
    before, ms, right = cell.state(), [], 0
    for _ in range(6):
        touch, answer = cell.sweep()
        heard_ns = next(t for t, line in reversed(cell.serial.heard) if ",RES," in line)
        ms.append((heard_ns - touch.stop_ns) / 1e6)
        assert cell.lines.wait("RESULT-VALID", True, 10)
        # `gap`: an emulator that lags brought frames more than late_ms after the stop edge, or
        # edges as late to its kernel
        assert answer.status in ("ok", "unsure", "unknown", "gap")
        if answer.status == "ok":
            assert answer.label == touch.act.label
            right += 1
        assert cell.lines.code() == (LABELS.index(answer.label) + 1 if answer.status == "ok" else 0)
    after = cell.state()
    assert int(after[3]) - int(before[3]) == 6, "answers"
    assert after[5] == before[5], "frames lost"
    assert after[7] == before[7], "enumerations"
    assert right
    note(
        "none",
        f"{right} right, others said why not; {statistics.median(ms):.0f} ms median from edge to "
        "sentence",
        6,
    )


def test_the_golden_sweeps_are_the_same_on_arm64(cell: Cell):
    """TEST: the network gives the same logits in the guest as on the desktop."""
    answer = cell.serial.ask("$PPLP,TEST", 30)
    assert ",TEST,ok," in answer
    assert float(answer.split("differ by ")[1].split("*")[0]) <= bundle.GOLDEN_TOLERANCE


def test_the_service_has_no_more_rights_than_it_needs(cell: Cell):
    """No capability, nodes by group, /etc out of reach; all of the unit applied."""
    run = cell.machine.run
    pid = cell.machine.out("systemctl show -P MainPID palpate")
    about = dict(
        line.split(":\t", 1)
        for line in run(f"cat /proc/{pid}/status").out.splitlines()
        if ":\t" in line
    )
    palpate = cell.machine.out("id -u palpate")
    assert set(about["Uid"].split()) == {palpate}
    assert {about[kind] for kind in ("CapEff", "CapPrm", "CapBnd", "CapAmb")} == {"0" * 16}
    assert about["NoNewPrivs"] == "1"
    held = run(f"ls -l /proc/{pid}/fd").out
    for node in ("/dev/bus/usb/", "gpio-line", "/dev/ttyS"):
        assert node in held
    assert run(f"nsenter -t {pid} -m -S {palpate} -- touch /etc/palpate/mine").rc != 0


def test_check_names_each_part(cell: Cell):
    """`palpate check` in place of the service: every part is there."""
    assert "FAIL" not in checked(cell)


def test_the_skin_has_its_name(cell: Cell):
    """udev calls the skin's node by its name."""
    assert cell.machine.out("readlink -f /dev/palpate-skin").startswith("/dev/bus/usb/")

"""The command as a person or a script uses it: output, end, exit codes."""

from __future__ import annotations

import argparse
import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import termios
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Early
from palpate.cli import devices as cli_devices
from palpate.cli import main as main_module
from palpate.cli import parser
from palpate.cli.main import main
from palpate.core import config, statistics, storage
from palpate.core.clock import SystemClock
from palpate.core.devices import Devices
from palpate.core.errors import (
    ApplianceError,
    BundleError,
    ConfigError,
    FormatError,
    LineError,
    SensorError,
)
from palpate.core.types import Frames, Status, Sweep, save
from palpate.inference.classifier import Classifier
from palpate.io import packets
from palpate.sim import skin
from palpate.tools import pseudo_terminal
from tests.factories import terminals, toy_bundle
from tests.factories.paths import ROOT

VIRTUAL = ["--virtual", "--sweeps", "3", "--seed", "7"]


def test_run_prints_sentences_and_ends_with_its_script(capsysbinary: pytest.CaptureFixture[bytes]):
    """Without a serial port the sentences are printed, and say that they are simulated."""
    assert main(["run", "--sim", "skin", *VIRTUAL]) == 0
    lines = capsysbinary.readouterr().out.decode("ascii").split("\r\n")
    results = [line for line in lines if ",RES," in line]
    assert len(results) == 3
    assert all(",sim," in line for line in results)


def test_numpy_starts_no_threads_in_a_command():
    """OpenBLAS threads of a process that has run a command and imported numpy: none. In an emulated
    box a product in the loop once waited for one until the watchdog ended the service."""
    code = (
        "import os; from palpate.cli.main import main; main(['check', '--settings']); "
        "import numpy; "
        "print(len(os.listdir('/proc/self/task')))"
    )
    env = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=env, capture_output=True, timeout=120
    )
    assert done.stdout.split()[-1] == b"1"


@pytest.mark.slow
def test_run_ends_at_sigterm():
    """SIGTERM: exit code 0, in real time with a streaming skin."""
    with subprocess.Popen(
        [sys.executable, "-m", "palpate", "run", "--sim", "skin"], stdout=subprocess.PIPE
    ) as run:
        while b",streaming," not in run.stdout.readline():
            pass
        run.send_signal(signal.SIGTERM)
        run.stdout.read()
        assert run.wait(timeout=60) == 0


@pytest.mark.slow
def test_run_on_a_serial_port():
    """With serial.port set the sentences come out there, and standard output stays empty."""
    with pseudo_terminal.pair() as (far, name):
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "palpate",
                "run",
                "--sim",
                "skin",
                *VIRTUAL,
                "--set",
                f"serial.port={name}",
            ],
            capture_output=True,
            check=True,
            timeout=120,
        )
        assert done.stdout == b""
        assert os.read(far, 65536).count(b",RES,") == 3


def test_kept_and_captured_sweeps_are_replayed(
    tmp_path: Path, capsysbinary: pytest.CaptureFixture[bytes]
):
    """`run --capture` with a black box, then `replay` of either, and of the same sweeps recorded
    without a bundle: the same labels and probabilities."""
    kept = ["--set", f"store.folder={tmp_path}", "--set", "store.black_box=9"]
    assert main(["run", "--sim", "skin", *VIRTUAL, "--capture", str(tmp_path / "c"), *kept]) == 0

    def output() -> list[list[bytes]]:
        return [
            line.split(b",")[4:8]
            for line in capsysbinary.readouterr().out.splitlines()
            if b",RES," in line
        ]

    first = output()
    assert main(["replay", str(tmp_path / "c")]) == 0
    assert output() == first
    assert main(["replay", str(tmp_path / "black-box")]) == 0
    assert output() == first
    recorded = ["--out", str(tmp_path / "sweeps"), "--capture", str(tmp_path / "d")]
    assert main(["record", "--sim", "skin", *VIRTUAL, *recorded]) == 0
    assert {status for status, *_ in output()} == {b"recorded"}
    for what in ("sweeps", "d"):
        assert main(["replay", str(tmp_path / what)]) == 0
        assert output() == first


def test_a_full_disk_costs_the_recording_never_the_classifying(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    """Neither sweeps nor capture can be written: each failure is logged, every sweep is answered,
    and the exit code is 0."""

    def full(*args: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("palpate.core.storage.write", full)
    assert (
        main(
            ["record", "--sim", "skin", *VIRTUAL, "--out", str(tmp_path), "--capture", "/dev/full"]
        )
        == 0
    )
    output = capfd.readouterr()
    assert output.out.count(",RES,") == 3
    assert output.out.count(",full,0,,,,No space left on device*") == 3
    assert output.err.count("not stored: No space left on device") == 1
    assert output.err.count("capture: /dev/full cannot be written: No space left on device") == 1


@pytest.mark.slow
def test_a_log_on_a_full_disk_costs_the_log_alone():
    """Without a standard error that can be written, sweeps are answered, and the exit code is 0."""
    command = [
        sys.executable,
        "-m",
        "palpate",
        "run",
        "--sim",
        "skin",
        *VIRTUAL,
        "--capture",
        "/dev/full",
    ]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=full, text=True, timeout=60, check=False
        )
    assert done.returncode == 0
    assert done.stdout.count("$PPLP,RES,") == 3


def test_replay_of_a_sweep_set(
    tmp_path: Path, capsysbinary: pytest.CaptureFixture[bytes], default_bundle: bundle.Bundle
):
    """`run --sim replay:FILE`: each window of a set, over the wire, gets the verdict that the
    window itself gets."""
    samples = np.concatenate([default_bundle.golden, default_bundle.golden[::-1]])
    np.savez(
        tmp_path / "set.npz",
        samples=samples,
        labels=np.zeros(len(samples), int),
        materials=np.array(["a", "b"]),
        rate_hz=750.0,
        group_recording=np.repeat(np.arange(2), len(default_bundle.golden)),
    )
    fused = ["--set", "classifier.conflict=fuse"]  # the golden sweeps are of several materials
    assert main(["run", "--sim", f"replay:{tmp_path / 'set.npz'}", "--virtual", *fused]) == 0
    results = [r.split(b",") for r in capsysbinary.readouterr().out.splitlines() if b",RES," in r]
    assert [int(r[8]) for r in results] == [*range(1, len(default_bundle.golden) + 1)] * 2
    assert all(r[12] == b"replay" for r in results)
    want = [default_bundle.manifest.labels[k] for k in default_bundle.golden_logits.argmax(1)]
    assert results[0][5].decode() == want[0]
    assert results[len(want)][5].decode() == want[-1]


def known_sweeps(whole: bundle.Bundle) -> list[tuple[float, np.ndarray]]:
    """Simulated sweeps that the box names, each after its probability."""
    box, named = Classifier(whole, SystemClock()), []
    for i, counts in enumerate(skin.sweep_set("T-REAL", 2000, 2)[0]):
        n = np.arange(len(counts))
        verdict = box(Sweep(i, 0, 0, Status.OK, Frames(n, n, counts)))
        named += [(verdict.probability, counts)] if verdict.status is Status.OK else []
    return named


@pytest.mark.slow
def test_the_sequential_test_is_configured(
    tmp_path: Path, capsysbinary: pytest.CaptureFixture[bytes], default_bundle: bundle.Bundle
):
    """classifier.min_probability and classifier.max_sweeps reach the classifier, in `run` and in
    `replay`."""
    least_sure = min(known_sweeps(default_bundle), key=lambda named: named[0])
    samples = least_sure[1][None].repeat(3, axis=0)
    np.savez(
        tmp_path / "set.npz",
        samples=samples,
        labels=np.zeros(3, int),
        materials=np.array(["a"]),
        rate_hz=750.0,
        group_recording=np.zeros(3, int),
    )
    never = [
        "--set",
        "classifier.min_probability=1",
        "--set",
        "classifier.max_sweeps=2",
        "--set",
        "classifier.fuse=product",
    ]
    played = ["run", "--sim", f"replay:{tmp_path / 'set.npz'}", "--virtual"]
    kept = [
        "--capture",
        str(tmp_path / "c"),
        "--set",
        f"store.folder={tmp_path}",
        "--set",
        "store.black_box=9",
    ]

    def output() -> list[bytes]:
        return [
            r.split(b",")[4] for r in capsysbinary.readouterr().out.splitlines() if b",RES," in r
        ]

    assert least_sure[0] < 0.9999, "take more sweeps, so that one is less sure"
    assert main([*played, *never, *kept]) == 0
    assert output()[:2] == [b"unsure", b"undecided"]
    assert main(["replay", str(tmp_path / "c"), *never]) == 0
    assert output()[:2] == [b"unsure", b"undecided"]
    assert main(["replay", str(min((tmp_path / "black-box").glob("*.npy"))), *never]) == 0
    assert output() == [b"unsure"]
    assert main(played) == 0
    assert output() == [b"ok"] * 3


def test_early_needs_a_bundle_that_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """classifier.early with a bundle without early heads ends before the first sweep; `check` names
    it."""
    folder = Path(shutil.copytree(bundle.DEFAULT, tmp_path / "bundle"))
    manifest = json.loads((folder / bundle.MANIFEST).read_text()) | {"early": None}
    (folder / bundle.MANIFEST).write_text(json.dumps(manifest))
    which = ["--set", "classifier.early=true", "--set", f"classifier.bundle={folder}"]
    assert main(["run", "--sim", "skin", *VIRTUAL, *which]) == BundleError.exit_code
    output = capsys.readouterr()
    assert "has no early heads" in output.err
    assert output.out == ""
    assert main(["check", "--sim", "skin", "--virtual", *which]) == 1
    assert "FAIL  golden sweeps" in capsys.readouterr().out


def test_a_sweep_that_was_answered_early_is_replayed_so(
    tmp_path: Path, capsysbinary: pytest.CaptureFixture[bytes]
):
    """A replay stops at the step at which this bundle decides; another bundle is named."""
    frames = Frames(np.arange(10), np.arange(10), toy_bundle.window(1, 0)[:10])
    save(tmp_path / "s.npy", Sweep(1, 0, 0, Status.OK, frames, share=0.5), toy_bundle.FORMAT)
    for least, code in ((0.5, 0), (2.0, 1)):
        made = toy_bundle.files(
            early=Early((least,) * 3, 1), outputs=("logits", "embedding", "early")
        )
        folder = toy_bundle.put(tmp_path / f"b{least}", made)
        assert (
            main(["replay", str(tmp_path / "s.npy"), "--set", f"classifier.bundle={folder}"])
            == code
        )
    output = capsysbinary.readouterr()
    assert output.out.count(b",RES,1,") == 1
    assert b",ok,a," in output.out
    assert b"answered early, which this bundle does not do" in output.out


def test_check_says_ok_part_by_part(capsys: pytest.CaptureFixture[str]):
    """On the rig all devices are present."""
    assert main(["check", "--sim", "skin", "--virtual"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["ok"] * 5
    assert "SIM0001" in lines[3]


@pytest.mark.slow
def test_check_names_what_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """On a machine without devices: the bundle is fine, the devices are not, each with its own
    line, and exit code 1."""
    code = main(
        [
            "check",
            "--board",
            "rpi5",
            "--set",
            f"serial.port={tmp_path}/none",
            "--set",
            "skin.usb=1209:0001",
        ]
    )
    lines = {line[6:20].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert code == 1
    assert lines["bundle"].startswith("ok")
    assert lines["golden sweeps"].startswith("ok")
    assert all(lines[part].startswith("FAIL") for part in ("skin", "gpio lines", "serial port"))
    assert main(["check", "--set", f"classifier.bundle={tmp_path}"]) == 1
    assert "FAIL  bundle" in capsys.readouterr().out


def test_check_needs_no_bundle(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The skin is checked without a bundle. A bundle for another skin is named with both formats
    and the remedy."""
    skin_and_no_bundle = [
        "check",
        "--sim",
        "skin",
        "--virtual",
        "--set",
        f"classifier.bundle={tmp_path / 'none'}",
    ]
    assert main(skin_and_no_bundle) == 1
    assert [line[:20].split()[:2] for line in capsys.readouterr().out.splitlines()] == [
        ["FAIL", "bundle"],
        ["ok", "skin"],
        ["ok", "gpio"],
    ]
    other = toy_bundle.put(tmp_path / "toy", toy_bundle.files())
    assert main(["check", "--sim", "skin", "--virtual", "--set", f"classifier.bundle={other}"]) == 1
    (fail,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL")]
    assert "4x4 uint8 at 750 Hz, 750 frames in 1.0 s, 0 lost, " in fail
    assert " % of a core; the bundle wants 2x2 int16 at 100 Hz" in fail
    assert "palpate record" in fail


def test_check_of_commands_without_a_serial_port(capsys: pytest.CaptureFixture[str]):
    """START and STOP as commands need a port: the trigger fails, as `run` would."""
    assert main(["check", "--sim", "skin", "--virtual", "--set", "trigger.mode=serial"]) == 1
    assert "FAIL  trigger        serial: START and STOP come over serial.port" in (
        capsys.readouterr().out
    )


def test_folders_and_files_that_are_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A folder of settings that does not exist is an error; the message names a file that is no
    set, without advice on pickles; a result that could not be written is refused before the
    work."""
    assert main(["check", "--settings", "--config-dir", str(tmp_path / "none")]) == 78
    assert f"--config-dir {tmp_path / 'none'}: no such folder" in capsys.readouterr().err
    assert main(["run", "--sim", "replay:/etc/passwd", "--set", "store.runtime="]) == 65
    told = capsys.readouterr().err
    assert "passwd: not a sweep set (an .npz of samples, labels, materials, rate_hz)" in told
    assert "pickle" not in told
    for path, why in ((tmp_path, "it is a folder"), (tmp_path / "no" / "x.json", "no folder")):
        assert main(["check", "--bench", "--json", str(path)]) == 78
        assert why in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_a_box_without_rights_names_the_service_s(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """Whoever may not read the deployed bundle is told to use the service's rights, by each
    command."""

    def refused(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "/var/lib/palpate/state.json")

    monkeypatch.setattr("palpate.runtime.assembly.running", refused)
    assert main(["check", "--sim", "skin", "--virtual"]) == 1
    assert "FAIL  bundle" in (told := capsys.readouterr().out)
    assert "/var/lib/palpate/state.json: this user may not read" in told
    assert "sudo -u palpate palpate" in told


def test_a_full_disk_names_the_file_and_leaves_none(tmp_path: Path):
    """An error of a write has the name of its file, and no part of it stays."""
    target = tmp_path / "figures.json"
    with (
        mock.patch("os.fsync", side_effect=OSError(28, "No space left on device")),
        pytest.raises(OSError, match=r"figures\.json"),
    ):
        storage.put(target, b"{}")

    def half() -> None:
        with storage.file(tmp_path / "set.npz") as f:
            f.write(b"half")
            raise OSError(28, "No space left on device")

    def half_a_folder(name: str | None) -> None:
        with storage.folder(tmp_path / "bundle") as folder:
            (folder / "half").write_text("half")
            raise OSError(28, "No space left on device", name and str(folder / name))

    with pytest.raises(OSError, match=r"set\.npz"):
        half()
    for name in (None, "half"):
        with pytest.raises(OSError, match=r"bundle'"):
            half_a_folder(name)
    assert not list(tmp_path.iterdir())
    with storage.file(target) as f:
        f.write(b"whole")
    assert target.read_bytes() == b"whole"


@pytest.mark.parametrize("mode", ["key", "timed"])
def test_check_of_a_trigger_without_lines(mode: str, capsys: pytest.CaptureFixture[str]):
    """No line is asked for."""
    assert main(["check", "--sim", "skin", "--virtual", "--set", f"trigger.mode={mode}"]) == 0
    assert f"ok    trigger        {mode}, no lines" in capsys.readouterr().out


@pytest.mark.parametrize("form", ["", "4x4:uint8:750"])
def test_record_on_a_machine_without_gpio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], form: str
):
    """A PC without wired lines, gpiod and bundle: sweeps by the clock are recorded, in the
    announced or the described format."""
    simulated = cli_devices.simulated(
        "skin", None, argparse.Namespace(seed=1, sweeps=None, virtual=True), config.load(None)
    )
    plain = Devices(simulated.clock, None, simulated.backend, "sim")
    monkeypatch.setattr(cli_devices, "Devices", lambda clock: plain)
    monkeypatch.setitem(sys.modules, "gpiod", None)
    monkeypatch.setattr("palpate.runtime.assembly.running", None)
    if form:
        monkeypatch.setattr("palpate.io.skins.announced", None)
    described = ["--format", form] if form else []
    code = main(
        [
            "record",
            "--every",
            "4",
            "--sweeps",
            "3",
            "--out",
            str(tmp_path),
            "--material",
            "wood",
            *described,
        ]
    )
    assert code == 0
    assert len([*tmp_path.glob("*.npy")]) == 3
    about = json.loads((tmp_path / "sweep-000001.json").read_text())
    assert about["trigger"] == {"mode": "timed", "times": "clock of the box"}
    assert about["format"] == skin.FORMAT.json()
    assert about["verdict"]["status"] == "recorded"
    output = capsys.readouterr()
    assert output.out.count(",RES,") == 3
    assert "palpate: start: slide for 3 s" in output.err


def test_record_takes_a_set_of_any_form(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """`record --sim replay:SET` of a skin without a bundle: each recorded window equals the window
    of the set."""
    samples = np.random.default_rng(1).integers(100, 4000, (3, 40, 5, 3)).astype(np.int16)
    np.savez(
        tmp_path / "s.npz", samples=samples, labels=[0, 0, 1], materials=["a", "b"], rate_hz=50.0
    )
    assert (
        main(
            [
                "record",
                "--sim",
                f"replay:{tmp_path / 's.npz'}",
                "--virtual",
                "--out",
                str(tmp_path / "kept"),
            ]
        )
        == 0
    )
    kept = [np.load(path)["taxels"] for path in sorted((tmp_path / "kept").glob("*.npy"))]
    assert np.array_equal(kept, samples)
    output = capsys.readouterr()
    assert output.out.count(",recorded,") == 3
    assert "record: 40 frames in a window, at 50 Hz" in output.err  # too slow for textures


@pytest.mark.slow
def test_the_space_bar_in_a_real_terminal(tmp_path: Path):
    """`palpate record --trigger key` as a person uses it: lines and no sentences; Ctrl-C ends it,
    the terminal is as before."""
    far, near = os.openpty()
    before = termios.tcgetattr(near)
    command = [
        sys.executable,
        "-m",
        "palpate",
        "record",
        "--sim",
        "skin",
        "--trigger",
        "key",
        "--material",
        "wood",
    ]
    with subprocess.Popen(
        [*command, "--out", str(tmp_path)],
        stdin=near,
        stdout=near,
        stderr=near,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(near, termios.TIOCSCTTY, 0),
    ) as run:
        shown = b""
        for until, key in (
            (b"streaming", b" "),
            (b"bar stops the sweep", b" "),
            (b"no answer, short", b"\x03"),
        ):
            before_it = shown
            shown += terminals.read(
                far, run, lambda more, before=before_it, until=until: until in before + more
            )
            assert until in shown
            os.write(far, key)
        assert terminals.ended(run, shown) == 130
    assert termios.tcgetattr(near) == before
    os.close(near)
    os.close(far)
    assert b"$PPLP" not in shown
    assert b"the space bar starts a sweep and stops it" in shown


def test_config_names_sources(capsys: pytest.CaptureFixture[str]):
    """Each value with the file it comes from."""
    assert main(["check", "--settings", "--board", "rpi5", "--set", "sweep.max_duration_s=9"]) == 0
    out = capsys.readouterr().out
    assert "# --set" in next(
        line for line in out.splitlines() if line.startswith("sweep.max_duration_s")
    )
    assert "board-rpi5.toml" in out


@pytest.mark.parametrize(
    ("args", "trouble", "hint"),
    [
        (["run"], ConfigError, "trigger.start has no GPIO line"),
        (
            ["run", "--set", "trigger.start=A", "--set", "trigger.mode=two-lines"],
            ConfigError,
            "trigger.stop has no GPIO line",
        ),
        (["run", "--virtual"], ConfigError, "--virtual needs --sim"),
        (["run", "--sim", "world"], ConfigError, "--sim world is unknown"),
        (["run", "--board", "toaster"], ConfigError, "rpi5"),
        (["run", "--set", "sweep.max_durtion_s=1"], ConfigError, "max_duration_s"),
        (
            ["run", "--sim", "skin", "--set", "classifier.bundle=/nowhere"],
            BundleError,
            "no bundle at /nowhere",
        ),
        (["run", "--sim", "replay:/nowhere.npz"], FormatError, "nowhere.npz: not a sweep set"),
        (["run", "--board", "rpi5"], LineError, "gpiochip"),
        (["replay", "/nowhere"], FormatError, "cannot be read"),
        (["replay", "/nowhere.npy"], FormatError, "not a recorded sweep"),
        (
            ["record", "--sim", "skin", "--virtual", "--out", "/proc/x"],
            ConfigError,
            "--out /proc/x",
        ),
        (
            ["record", "--material", "wood"],
            SensorError,
            "or name its format with --format 4x4:uint8:750",
        ),
        (
            ["skin", "show"],
            SensorError,
            "or name another skin with --skin; `palpate skin detect` says which",
        ),
        (
            ["skin", "show", "--skin", "no.toml"],
            ConfigError,
            "no.toml: no such file; check the path",
        ),
        (
            ["record", "--format", "4x4:uint8:750", "--out", "OUT"],
            ConfigError,
            "--trigger serial, key or timed",
        ),
        (
            ["record", "--format", "4:uint8"],
            ConfigError,
            "--format 4:uint8: not understood; give rows x columns",
        ),
        (
            ["record", "--format", "4x4:uint9:10"],
            ConfigError,
            "--format 4x4:uint9:10: data type 'uint9' is unknown",
        ),
        (
            ["record", "--format", "4x4:uint8:10", "--window", "13"],
            ConfigError,
            "use a shorter --window",
        ),
        (
            ["record", "--sim", "skin", "--virtual", "--skin", "anyskin"],
            ConfigError,
            "anyskin",
        ),
        (
            ["record", "--sim", "skin", "--format", "2x2:uint8:10"],
            FormatError,
            "2x2 uint8 at 10 Hz",
        ),
        (["run", "--trigger", "serial"], ConfigError, "serial.port is not set"),
        (["run", "--trigger", "key"], ConfigError, "standard input is not a terminal"),
        (
            ["run", "--trigger", "key", "--every", "3"],
            ConfigError,
            "--every and --sweep are for --trigger timed",
        ),
        (["run", "--every", "3"], ConfigError, "a sweep of 3 s every 3 s leaves no pause"),
        (
            ["run", "--sim", "skin", "--virtual", "--capture", "/proc/x"],
            ConfigError,
            "--capture /proc/x",
        ),
    ],
)
def test_exit_codes(
    args: list[str],
    trouble: type[ApplianceError],
    hint: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """Each kind of trouble has its exit code and one line that says what to do."""
    if "rpi5" in args and trouble is LineError and any(Path("/dev").glob("gpiochip*")):
        pytest.skip("this machine has gpio chips")
    monkeypatch.setattr("sys.stdin", None)
    assert main([str(tmp_path) if arg == "OUT" else arg for arg in args]) == trouble.exit_code
    err = [line for line in capsys.readouterr().err.splitlines() if ": record: 4x4" not in line]
    assert hint in err[0]
    assert len(err) == 1


@pytest.mark.parametrize("text", ["0", "-2", "nan", "inf", "long"])
def test_a_window_is_a_length_of_time(text: str, capsys: pytest.CaptureFixture[str]):
    """Other values are wrong arguments."""
    with pytest.raises(SystemExit) as ended:
        main(["record", "--sim", "skin", "--virtual", "--window", text])
    assert ended.value.code == 2
    assert (
        f"argument --window: {text} is not a number of seconds; use 0.01 to 3600"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("key", ["samples", "labels", "materials", "rate_hz"])
def test_sets_that_lack_something(tmp_path: Path, key: str, capsys: pytest.CaptureFixture[str]):
    """If a sweep set lacks an array, the error names the set and the array."""
    arrays = {
        "samples": np.zeros((2, 5, 4, 4), np.uint8),
        "labels": [0, 0],
        "materials": ["a"],
        "rate_hz": 750.0,
    }
    np.savez(tmp_path / "s.npz", **{k: v for k, v in arrays.items() if k != key})
    assert (
        main(["run", "--sim", f"replay:{tmp_path / 's.npz'}", "--virtual"]) == FormatError.exit_code
    )
    assert key in capsys.readouterr().err


def test_a_set_of_another_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A set of another format is refused, with both formats."""
    np.savez(
        tmp_path / "s.npz",
        samples=np.zeros((2, 5, 3, 3), np.int16),
        labels=[0, 0],
        materials=["a"],
        rate_hz=100.0,
    )
    assert (
        main(["run", "--sim", f"replay:{tmp_path / 's.npz'}", "--virtual"]) == FormatError.exit_code
    )
    err = capsys.readouterr().err
    assert "3x3 int16 at 100 Hz" in err
    assert "4x4 uint8 at 750 Hz" in err


@pytest.mark.parametrize("words", [[], ["--help"], ["skin", "--help"], ["stauts"]])
def test_help_loads_neither_numpy_nor_devices(words: list[str]):
    """Help and advice answer at once, because nothing slow is imported for them."""
    code = (
        "import contextlib, sys\n"
        "from palpate.__main__ import main\n"
        f"with contextlib.suppress(SystemExit): main({words})\n"
        "print([m for m in ('numpy', 'onnxruntime', 'usb', 'serial', 'gpiod') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_each_command_has_a_function():
    """Each command and action names a function that exists."""
    for command in parser.COMMANDS.values():
        for one in command.actions.values() or [command]:
            assert callable(main_module._function(one.run))


def test_status_imports_little():
    """`palpate status` prints a file: neither numpy nor the network's runtime is loaded for it."""
    code = (
        "import sys; from palpate.__main__ import main; main(['status']); "
        "print({'numpy', 'onnxruntime', 'dataclasses', 'logging', 'msgspec'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.splitlines()[-1] == "set()"


def test_unknown_arguments_are_usage_errors():
    """argparse's own exit code, for commands and options alike."""
    for words in (["fly"], ["run", "--fly"], ["bundles", "fly"], ["skin"], ["bundles", "verify"]):
        with pytest.raises(SystemExit) as e:
            main(words)
        assert e.value.code == 2


@pytest.mark.slow
def test_output_that_nobody_reads():
    """`palpate … | head` ends without a traceback."""
    command = f"{sys.executable} -m palpate run --sim skin --virtual --sweeps 30 | head -n 1"
    done = subprocess.run(
        ["sh", "-c", command], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.startswith("$PPLP")
    assert "Traceback" not in done.stderr


def test_skin_format_is_the_default_bundles(default_bundle: bundle.Bundle):
    """The default bundle was trained for the simulated skin."""
    assert default_bundle.format == skin.FORMAT
    assert set(default_bundle.manifest.labels) == set(skin.MATERIALS)


def test_wilson():
    """The paper's 55 of 60 has the interval that is known for it."""
    assert statistics.wilson(55, 60) == pytest.approx([0.819, 0.964], abs=5e-4)


def test_skin_check_prints_a_verdict_for_each_part(capsys: pytest.CaptureFixture[str]):
    """`palpate skin check` on the simulated board: all ok, exit code 0, and no bundle is loaded."""
    no_bundle = ["--set", "classifier.bundle=/nowhere"]
    assert main(["skin", "check", "--sim", "skin", "--virtual", *no_bundle]) == 0
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert len(lines) == 12
    assert (
        "listening to frames for 10 s" in told.err
    )  # the duration is known before the first result
    assert all(line.startswith("ok       ") for line in lines)


def test_skin_check_fails_with_a_part(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """One line says FAIL and what to do; exit code 1."""
    monkeypatch.setattr(
        packets, "pack", lambda *args, right=packets.pack: right(*args)[:-4] + bytes(4)
    )
    assert main(["skin", "check", "--sim", "skin", "--virtual"]) == 1
    assert "FAIL     crc       " in (out := capsys.readouterr().out)
    assert "the CRC is 0; compute CRC-32" in out


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--seconds", "0"], 2, "0 is not a number of seconds; use 1 to 3600"),
        (["--seconds", "long"], 2, "long is not a number of seconds"),
        (
            ["--set", "skin.link=serial", "--set", "skin.port=/dev/none"],
            69,
            "no port /dev/none",
        ),
        (["--skin", "anyskin", "--port", "/dev/none"], 69, "no port /dev/none"),
    ],
)
def test_skin_check_refuses(
    options: list[str], code: int, words: str, capsys: pytest.CaptureFixture[str]
):
    """Arguments out of range and missing boards are refused."""
    try:
        ended: object = main(["skin", "check", *options])
    except SystemExit as e:
        ended = e.code
    assert ended == code
    assert words in capsys.readouterr().err

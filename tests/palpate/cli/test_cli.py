"""The command as a person or a script uses it: output, end, exit codes."""

from __future__ import annotations

import argparse
import errno
import fcntl
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import termios
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.cli import devices as cli_devices
from palpate.cli import parser
from palpate.cli.main import main
from palpate.core import config, runtime_folder, storage
from palpate.core.clock import SystemClock
from palpate.core.devices import Devices
from palpate.core.errors import BundleError, ConfigError, FormatError, LineError, SensorError
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate.tools import pseudo_terminal
from tests.factories import terminals, toy_bundle
from tests.factories.paths import ROOT

PALPATE = [sys.executable, "-m", "palpate"]
VIRTUAL = ["--virtual", "--sweeps", "3", "--seed", "7"]
RUN = ["run", "--sim", "skin", *VIRTUAL]
CHECK = ["check", "--sim", "skin", "--virtual"]
RECORD = ["record", "--sim", "skin", "--virtual"]


def with_sets(*sets: str) -> list[str]:
    """The words that set these values."""
    return [word for one in sets for word in ("--set", one)]


def results(captured: pytest.CaptureFixture[str]) -> list[list[str]]:
    """The fields of each RES sentence since the last call."""
    lines = captured.readouterr().out.splitlines()
    return [line.split(",") for line in lines if ",RES," in line]


def sweep_set(path: Path, samples: np.ndarray, **more: Any) -> str:
    """A set of these sweeps as a file, as --sim takes it."""
    n = len(samples)
    arrays = {"labels": np.zeros(n, int), "materials": np.array(["a", "b"]), "rate_hz": 750.0}
    np.savez(path, samples=samples, **(arrays | more))
    return f"replay:{path}"


def python(code: str, **more: Any) -> str:
    """The last line that a fresh process prints for this code."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
        **more,
    )
    return done.stdout.splitlines()[-1]


def test_run_prints_sentences_and_ends_with_its_script(capsys):
    """Without a serial port the sentences are printed, and say that they are simulated."""
    assert main(RUN) == 0
    assert [fields[12] for fields in results(capsys)] == ["sim"] * 3


def test_numpy_starts_no_threads_in_a_command():
    """In an emulated box a thread of OpenBLAS once let the watchdog end it."""
    code = (
        "import os; from palpate.cli.main import main; main(['check', '--settings']);"
        "import numpy; print(len(os.listdir('/proc/self/task')))"
    )
    env = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    assert python(code, env=env) == "1"


@pytest.mark.slow
def test_run_ends_at_sigterm():
    """SIGTERM: exit code 0, in real time with a streaming skin."""
    with subprocess.Popen([*PALPATE, "run", "--sim", "skin"], stdout=subprocess.PIPE) as run:
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
            [*PALPATE, *RUN, *with_sets(f"serial.port={name}")],
            capture_output=True,
            check=True,
            timeout=120,
        )
        assert done.stdout == b""
        heard = b""
        while select.select([far], [], [], 0)[0]:
            heard += os.read(far, 65536)
        assert heard.count(b",RES,") == 3


@pytest.mark.slow
def test_kept_and_captured_sweeps_are_replayed(tmp_path, capsys):
    """A black box, a capture, and recorded sweeps: the same labels."""

    def output() -> list[list[str]]:
        return [fields[4:8] for fields in results(capsys)]

    kept = with_sets(f"store.folder={tmp_path}", "store.black_box=9")
    assert main([*RUN, "--capture", str(tmp_path / "c"), *kept]) == 0
    first = output()
    out = ["--out", str(tmp_path / "sweeps"), "--capture", str(tmp_path / "d")]
    assert main(["record", *RUN[1:], *out]) == 0
    assert {status for status, *_ in output()} == {"recorded"}
    for what in ("c", "black-box", "sweeps", "d"):
        assert main(["replay", str(tmp_path / what)]) == 0
        assert output() == first


def test_a_full_disk_costs_the_recording_never_the_classifying(tmp_path, monkeypatch, capfd):
    """Neither sweeps nor capture can be written: each is logged once, every sweep is answered."""
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr("palpate.core.storage.write", mock.Mock(side_effect=full))
    words = ["record", *RUN[1:], "--out", str(tmp_path), "--capture", "/dev/full"]
    assert main(words) == 0
    output = capfd.readouterr()
    assert output.out.count(",RES,") == output.out.count(",full,") == 3
    assert output.err.count("not stored: No space") == 1
    assert output.err.count("capture: /dev/full") == 1


@pytest.mark.slow
def test_a_log_on_a_full_disk_costs_the_log_alone():
    """Without a standard error that can be written, sweeps are answered, and the exit code is 0."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PALPATE, *RUN, "--capture", "/dev/full"],
            stdout=subprocess.PIPE,
            stderr=full,
            timeout=120,
        )
    assert (done.returncode, done.stdout.count(b"$PPLP,RES,")) == (0, 3)


def test_replay_of_a_sweep_set(tmp_path, capsys, default_bundle):
    """`run --sim replay:FILE`: each window, over the wire, gets its own verdict."""
    golden, n = default_bundle.golden, len(default_bundle.golden)
    both = np.concatenate([golden, golden[::-1]])
    sim = sweep_set(tmp_path / "set.npz", both, group_recording=np.repeat(np.arange(2), n))
    # the golden sweeps are of several materials
    assert main(["run", "--sim", sim, "--virtual", *with_sets("classifier.conflict=fuse")]) == 0
    found = results(capsys)
    assert [int(r[8]) for r in found] == [*range(1, n + 1)] * 2
    assert all(r[12] == "replay" for r in found)
    want = [default_bundle.manifest.labels[k] for k in default_bundle.golden_logits.argmax(1)]
    assert (found[0][5], found[n][5]) == (want[0], want[-1])


@pytest.mark.slow
def test_the_sequential_test_is_configured(tmp_path, capsys, default_bundle):
    """min_probability and max_sweeps reach the classifier, in `run` and `replay`."""
    box, known = Classifier(default_bundle, SystemClock()), []
    for counts in skin.sweep_set("T-REAL", 2000, 2)[0]:
        verdict = box(toy_bundle.sweep_of(counts))
        known += [(verdict.probability, counts)] if verdict.status is Status.OK else []
    probability, counts = min(known, key=lambda one: one[0])
    assert probability < 0.9999, "take more sweeps, so that one is less sure"
    sim = sweep_set(
        tmp_path / "set.npz", counts[None].repeat(3, axis=0), group_recording=np.zeros(3, int)
    )
    names = ("min_probability=1", "max_sweeps=2", "fuse=product")
    never = with_sets(*(f"classifier.{name}" for name in names))
    kept = with_sets(f"store.folder={tmp_path}", "store.black_box=9")
    capture, played = str(tmp_path / "c"), ["run", "--sim", sim, "--virtual"]
    assert main([*played, *never, *kept, "--capture", capture]) == 0
    assert [r[4] for r in results(capsys)][:2] == ["unsure", "undecided"]
    assert main(["replay", capture, *never]) == 0
    assert [r[4] for r in results(capsys)][:2] == ["unsure", "undecided"]
    assert main(["replay", str(min((tmp_path / "black-box").glob("*.npy"))), *never]) == 0
    assert [r[4] for r in results(capsys)] == ["unsure"]
    assert main(played) == 0
    assert [r[4] for r in results(capsys)] == ["ok"] * 3


def test_early_needs_a_bundle_that_can(tmp_path, capsys):
    """Without early heads it ends before the first sweep; `check` names it."""
    folder = Path(shutil.copytree(bundle.DEFAULT, tmp_path / "bundle"))
    manifest = json.loads((folder / bundle.MANIFEST).read_text()) | {"early": None}
    (folder / bundle.MANIFEST).write_text(json.dumps(manifest))
    which = with_sets("classifier.early=true", f"classifier.bundle={folder}")
    assert main([*RUN, *which]) == BundleError.exit_code
    output = capsys.readouterr()
    assert ("early" in output.err, output.out) == (True, "")
    assert main([*CHECK, *which]) == 1
    assert "FAIL  golden sweeps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("sets", "code", "parts"),
    [
        ([], 0, {"skin": "SIM0001"}),
        (["trigger.mode=key"], 0, {"trigger": "key, no lines"}),
        (["trigger.mode=timed"], 0, {"trigger": "timed, no lines"}),
        (["trigger.mode=serial"], 1, {"trigger": "serial.port"}),
    ],
)
def test_check_says_ok_part_by_part(capsys, sets, code, parts):
    """All devices are present; other triggers need no line, commands need a port."""
    assert main([*CHECK, *with_sets(*sets)]) == code
    lines = {line[6:20].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert len(lines) == 5
    assert {part for part, line in lines.items() if not line.startswith("ok")} == (
        {"trigger"} if code else set()
    )
    assert all(words in lines[part] for part, words in parts.items())


@pytest.mark.slow
def test_check_names_what_fails(tmp_path, capsys):
    """Without devices: the bundle is fine, each device has its line, exit code 1."""
    gone = with_sets(f"serial.port={tmp_path}/none", "skin.usb=1209:0001")
    assert main(["check", "--board", "rpi5", *gone]) == 1
    lines = {line[6:20].strip(): line[:4] for line in capsys.readouterr().out.splitlines()}
    assert lines["bundle"] == lines["golden sweeps"] == "ok  "
    assert all(lines[part] == "FAIL" for part in ("skin", "gpio lines", "serial port"))
    assert main(["check", *with_sets(f"classifier.bundle={tmp_path}")]) == 1
    assert "FAIL  bundle" in capsys.readouterr().out


def test_check_needs_no_bundle(tmp_path, capsys):
    """The skin is checked; a bundle for another skin is named with both formats."""
    assert main([*CHECK, *with_sets(f"classifier.bundle={tmp_path / 'none'}")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [
        ["FAIL", "bundle"],
        ["ok", "skin"],
        ["ok", "gpio"],
    ]
    other = toy_bundle.put(tmp_path / "toy", toy_bundle.files())
    assert main([*CHECK, *with_sets(f"classifier.bundle={other}")]) == 1
    (fail,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL")]
    for words in ("4x4 uint8 at 750 Hz", "0 lost", "2x2 int16 at 100 Hz", "palpate record"):
        assert words in fail


def test_folders_and_files_that_are_not_there(tmp_path, capsys):
    """Nothing is begun."""
    none = str(tmp_path / "none")
    for words, code, said in (
        (["check", "--settings", "--config-dir", none], 78, none),
        (
            ["run", "--sim", "replay:/etc/passwd", *with_sets("store.runtime=")],
            65,
            "not a sweep set",
        ),
    ):
        assert main(words) == code
        told = capsys.readouterr().err
        assert said in told
        assert "pickle" not in told


def test_a_box_without_rights_names_the_service_s(capsys, monkeypatch):
    """A user without rights to the deployed bundle hears how to use the service's rights."""
    refused = mock.Mock(side_effect=PermissionError(13, "denied", "/var/lib/palpate/state.json"))
    monkeypatch.setattr("palpate.runtime.assembly.running", refused)
    assert main(CHECK) == 1
    told = capsys.readouterr().out
    assert "FAIL  bundle" in told
    assert "/var/lib/palpate/state.json" in told
    assert "palpate" in told


def test_a_full_disk_names_the_file_and_leaves_none(tmp_path):
    """An error of a write has the name of its file, and no part of it stays."""
    target, full = tmp_path / "figures.json", OSError(28, "No space left on device")

    def half_a_file() -> None:
        with storage.file(tmp_path / "set.npz") as f:
            f.write(b"half")
            raise OSError(28, "No space left on device")

    def half_a_folder(name: str | None) -> None:
        with storage.folder(tmp_path / "bundle") as folder:
            (folder / "half").write_text("half")
            raise OSError(28, "No space left on device", name and str(folder / name))

    with mock.patch("os.fsync", side_effect=full), pytest.raises(OSError, match=r"figures\.json"):
        storage.put(target, b"{}")
    with pytest.raises(OSError, match=r"set\.npz"):
        half_a_file()
    for name in (None, "half"):
        with pytest.raises(OSError, match=r"bundle'"):
            half_a_folder(name)
    assert not list(tmp_path.iterdir())
    with storage.file(target) as f:
        f.write(b"whole")
    assert target.read_bytes() == b"whole"


@pytest.mark.parametrize("form", ["", "4x4:uint8:750"])
def test_record_on_a_machine_without_gpio(tmp_path, monkeypatch, capsys, form):
    """Sweeps by the clock, in the announced or the described format."""
    how = argparse.Namespace(seed=1, sweeps=None, virtual=True)
    simulated = cli_devices.simulated("skin", None, how, config.load(None))
    plain = Devices(simulated.clock, None, simulated.backend, "sim")
    monkeypatch.setattr(cli_devices, "Devices", lambda clock: plain)
    monkeypatch.setitem(sys.modules, "gpiod", None)
    monkeypatch.setattr("palpate.runtime.assembly.running", None)
    if form:
        monkeypatch.setattr("palpate.io.skins.announced", None)
    words = ["record", "--every", "4", "--sweeps", "3", "--out", str(tmp_path)]
    assert main([*words, "--material", "wood", *(["--format", form] if form else [])]) == 0
    assert len([*tmp_path.glob("*.npy")]) == len(results(capsys)) == 3
    about = json.loads((tmp_path / "sweep-000001.json").read_text())
    assert about["trigger"] == {"mode": "timed", "times": "clock of the box"}
    assert about["format"] == skin.FORMAT.json()
    assert about["verdict"]["status"] == "recorded"


def test_record_takes_a_set_of_any_form(tmp_path, capsys):
    """Each recorded window equals the set's, after a warning of a slow skin."""
    samples = np.random.default_rng(1).integers(100, 4000, (3, 40, 5, 3)).astype(np.int16)
    sim = sweep_set(tmp_path / "s.npz", samples, rate_hz=50.0)
    assert main(["record", "--sim", sim, "--virtual", "--out", str(tmp_path / "kept")]) == 0
    kept = [np.load(path)["taxels"] for path in sorted((tmp_path / "kept").glob("*.npy"))]
    assert np.array_equal(kept, samples)
    output = capsys.readouterr()
    assert output.out.count(",recorded,") == 3
    assert "frames" in output.err


@pytest.mark.slow
def test_the_space_bar_in_a_real_terminal(tmp_path):
    """As a person uses it: lines, no sentences; the terminal is as before."""
    far, near = os.openpty()
    before = termios.tcgetattr(near)
    words = ["record", "--sim", "skin", "--trigger", "key", "--material", "wood"]
    with subprocess.Popen(
        [*PALPATE, *words, "--out", str(tmp_path)],
        stdin=near,
        stdout=near,
        stderr=near,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(near, termios.TIOCSCTTY, 0),
    ) as run:
        shown = b""
        for until, key in (
            (b"Ctrl-C ends", b""),  # then it reads keys
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


FORM = ["record", "--format"]


@pytest.mark.parametrize(
    ("args", "trouble", "hint"),
    [
        (["run"], ConfigError, "trigger.start"),
        (
            ["run", *with_sets("trigger.start=A", "trigger.mode=two-lines")],
            ConfigError,
            "trigger.stop",
        ),
        (["run", "--virtual"], ConfigError, "--virtual needs --sim"),
        (["run", "--sim", "world"], ConfigError, "--sim world"),
        (["run", "--board", "toaster"], ConfigError, "rpi5"),
        (["run", *with_sets("sweep.max_durtion_s=1")], ConfigError, "max_duration_s"),
        (
            ["run", "--sim", "skin", *with_sets("classifier.bundle=/no")],
            BundleError,
            "bundle at /no",
        ),
        (["run", "--sim", "replay:/nowhere.npz"], FormatError, "nowhere.npz"),
        (["run", "--board", "rpi5"], LineError, "gpiochip"),
        (["replay", "/nowhere"], FormatError, "/nowhere"),
        (["replay", "/nowhere.npy"], FormatError, "/nowhere.npy"),
        ([*RECORD, "--out", "/proc/x"], ConfigError, "--out /proc/x"),
        (["record", "--material", "wood"], SensorError, "--format 4x4:uint8:750"),
        (["skin", "show"], SensorError, "palpate skin detect"),
        (["skin", "show", "--skin", "no.toml"], ConfigError, "no.toml"),
        ([*FORM, "4x4:uint8:750", "--out", "OUT"], ConfigError, "--trigger serial"),
        ([*FORM, "4:uint8"], ConfigError, "--format 4:uint8"),
        ([*FORM, "4x4:uint9:10"], ConfigError, "'uint9'"),
        ([*FORM, "4x4:uint8:10", "--window", "13"], ConfigError, "shorter --window"),
        ([*RECORD, "--skin", "anyskin"], ConfigError, "anyskin"),
        (["record", "--sim", "skin", "--format", "2x2:uint8:10"], FormatError, "2x2 uint8"),
        (["run", "--trigger", "serial"], ConfigError, "serial.port"),
        (["run", "--trigger", "key"], ConfigError, "needs a terminal"),
        (["run", "--trigger", "key", "--every", "3"], ConfigError, "--trigger timed"),
        (["run", "--every", "3"], ConfigError, "every 3 s"),
        (["run", "--sim", "skin", "--virtual", "--capture", "/proc/x"], ConfigError, "/proc/x"),
    ],
)
def test_exit_codes(args, trouble, hint, capsys, tmp_path, monkeypatch):
    """Each kind of trouble has its exit code and one line that says what to do."""
    if trouble is LineError and any(Path("/dev").glob("gpiochip*")):
        pytest.skip("this machine has gpio chips")
    monkeypatch.setattr("sys.stdin", None)
    assert main([str(tmp_path) if arg == "OUT" else arg for arg in args]) == trouble.exit_code
    (err,) = [line for line in capsys.readouterr().err.splitlines() if ": record: 4x4" not in line]
    assert hint in err


@pytest.mark.parametrize("text", ["0", "-2", "nan", "inf", "long"])
@pytest.mark.parametrize("words", [[*RECORD, "--window"], ["skin", "check", "--seconds"]])
def test_a_window_is_a_length_of_time(words, text, capsys):
    """Other values are wrong arguments."""
    with pytest.raises(SystemExit, match="2"):
        main([*words, text])
    assert f"{words[-1]}: {text} is not" in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["--skin", "anyskin"]])
def test_a_missing_port_is_named(words, capsys):
    """`skin check` on a port that is not there: exit code 69."""
    port = words and ["--port", "/dev/none"]
    link = with_sets("skin.link=serial", "skin.port=/dev/none")
    assert main(["skin", "check", *words, *(port or link)]) == 69
    assert "/dev/none" in capsys.readouterr().err


@pytest.mark.parametrize("lacking", ["samples", "labels", "materials", "rate_hz", ""])
def test_sets_that_cannot_be_played(tmp_path, lacking, capsys):
    """An array that is missing is named, and of another format both formats."""
    sim = sweep_set(tmp_path / "s.npz", np.zeros((2, 5, 3, 3), np.int16), rate_hz=100.0)
    if lacking:
        with np.load(tmp_path / "s.npz") as whole:
            np.savez(tmp_path / "s.npz", **{k: whole[k] for k in whole.files if k != lacking})
    assert main(["run", "--sim", sim, "--virtual"]) == FormatError.exit_code == 65
    err = capsys.readouterr().err
    assert all(one in err for one in ([lacking] if lacking else ["3x3", "4x4"]))


@pytest.mark.parametrize("words", [[], ["--help"], ["skin", "--help"], ["stauts"], ["status"]])
def test_help_and_status_load_little(words):
    """They answer at once, because nothing slow is imported for them; `status` prints a file."""
    slow = {"numpy", "onnxruntime", "usb", "serial", "gpiod"}
    slow |= {"dataclasses", "logging", "argparse", "tomllib"} if words == ["status"] else set()
    code = (
        "import contextlib, sys\n"
        "from palpate.__main__ import main\n"
        f"with contextlib.suppress(SystemExit): main({words})\n"
        f"print({slow} & set(sys.modules))"
    )
    assert python(code) == "set()"


def test_status_finds_another_runtime_folder(tmp_path, monkeypatch, capsys):
    """A settings file that names store.runtime is read, and a missing one is not needed."""
    monkeypatch.setattr(runtime_folder, "CHECKOUT", str(tmp_path))
    (tmp_path / "skin.toml").write_text("skin.rate_hz = 100.0\n")
    assert main(["status"]) == 1
    assert runtime_folder.RUNTIME in capsys.readouterr().out
    (tmp_path / "skin.toml").write_text(f'store.runtime = "{tmp_path}"\n')
    assert main(["status"]) == 1
    assert str(tmp_path) in capsys.readouterr().out


def test_each_command_has_a_function_and_unknown_ones_an_error():
    """argparse's own exit code, for commands and options alike."""
    for command in parser.COMMANDS.values():
        for one in command.actions.values() or [command]:
            module, _, function = one.run.rpartition(".")
            assert callable(getattr(import_module(f"palpate.{module}"), function))
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


def test_skin_check_prints_a_verdict_for_each_part(capsys):
    """All ok without a bundle."""
    words = ["skin", "check", "--sim", "skin", "--virtual"]
    assert main([*words, *with_sets("classifier.bundle=/nowhere")]) == 0
    told = capsys.readouterr()
    assert [line[:9] for line in told.out.splitlines()] == ["ok       "] * 12
    assert "frames" in told.err  # the duration is known before the first result

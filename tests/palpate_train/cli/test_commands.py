"""The command palpate-train: options, messages and exit codes."""

import argparse
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.errors import FormatError
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.cli import bundles, fit
from palpate_train.cli.main import PROGRAM, main
from palpate_train.data import pull, sets
from palpate_train.metrics.score import Answers
from palpate_train.models.recipe.fitted import Fit
from tests.factories.sweep_sets import easy


@pytest.mark.slow
def test_the_next_commands_name_the_sweeps_of_the_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """They rename and select as the fit did; sweeps of a shorter window have no set."""
    sweeps = easy(20)
    sweeps.save(tmp_path / "easy.npz")
    args = f"fit --set {tmp_path}/easy.npz --seed 1 --size bands --out {tmp_path}/fit.npz".split()
    chosen = ["--rename", f"{sweeps.materials[0]}=first one", "--only", "speed<=2"]
    assert main([*args, *chosen]) == 0
    said = capsys.readouterr().out.partition("next:\n")[2].splitlines()
    for line in said[:2]:
        assert main(shlex.split(line)[1:]) == 0
    assert "first one" in capsys.readouterr().out
    assert all(shlex.join(chosen) in line for line in said[1:])
    assert fit._next_commands(Path("a.npz"), [])[2:] == []


@pytest.mark.slow
def test_the_command_splits_and_keeps_the_rest(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Whole recordings; training, held-out and written are all."""
    easy(20, pieces=2).save(tmp_path / "easy.npz")
    args = f"fit --set {tmp_path / 'easy.npz'} --seed 1 --stages 4 --only speed<=2".split()
    args += (
        f"--split recording:0.7 --rest {tmp_path / 'rest.npz'} --out {tmp_path / 'new' / 'fit.npz'}"
    ).split()
    assert main(args) == 0
    made, rest = Fit.load(tmp_path / "new" / "fit.npz"), sets.load(str(tmp_path / "rest.npz"))
    parts = [set(s.groups["recording"]) for s in (made.train, made.held, rest)]
    whole = easy(20, pieces=2).select(["speed<=2"])
    assert (
        sum(map(len, parts)) == len(set.union(*parts)) == len(np.unique(whole.groups["recording"]))
    )
    assert len(made.train) + len(made.held) + len(rest) == len(whole)
    out = capsys.readouterr().out
    figure = r"\d+\.\d % \[\d+\.\d, \d+\.\d\] of \d+"
    assert re.search(f"speed, as the box .*: {figure}; ", out)
    assert re.search(f"speed, network .*: {figure}\n", out)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("--set none.npz", "none.npz"),
        ("--set sim:T-LAB:1:1 --only force=1", "'force'"),
        ("--set sim:T-LAB:1:1 --split recording", "'recording'"),
        ("--set sim:T-LAB:1:1 --rest rest.npz", "--rest"),
        ("--set sim:T-LAB:1:1 --seed -1", "number from 0"),
        ("--set sim:T-LAB:1:1 --stages -1", "--stages -1"),
        ("--set sim:T-LAB:1:1 --stages x", "--stages x"),
        ("--set sim:T-LAB:1:1 --out /proc/none/fit.npz", "cannot be written there"),
        ("--set sim:T-LAB:1:1 --out /", "--out / "),
        ("--set sim:T-LAB:1:1 --out f.csv", "f.csv"),
        ("--set x.npz --split recording:0.5 --rest r.pdf", "r.pdf"),
        ("--set sim:T-LAB:1:1 --rename wood", "'wood'"),
        ("--set sim:T-LAB:1:1 --rename wod=oak", "'wod'"),
        ("--set sim:T-LAB:1:1 --rename wood=a --rename wood=b", "'a' and 'b'"),
        (
            "--set sim:T-LAB:1:1 --rename wood=a,b --rename foam=fffffffffffffffffffffffffffffffff",
            "charac",
        ),
        (
            "--set sim:T-LAB:1:1 --rename wood=a,b --rename foam=fffffffffffffffffffffffffffffffff",
            r"(33 characters); a label",
        ),
    ],
)
def test_an_error_of_the_project_is_one_line(
    args: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A FormatError gives its exit code, and its message on the error stream."""
    assert (
        main(["fit", "--seed", "1", "--out", str(tmp_path / "fit.npz"), *args.split()])
        == FormatError.exit_code
    )
    err = capsys.readouterr().err
    assert err.startswith("palpate-train: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.thorough  # starts a process for each command
def test_a_reader_that_closes_the_pipe_ends_the_command_quietly():
    """`palpate-train evaluate --list | head -1`: exit code 1, nothing on the error stream."""
    command = [sys.executable, "-m", "palpate_train", "evaluate", "--list"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        error = process.stderr.read()
    assert (process.returncode, error) == (1, "")


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("fit --set none --seed 1 --out /proc/none/b.npz", "/proc/none/b.npz"),
        ("export none.npz --out /proc/none/b --name b --version 1", "/proc/none/b"),
        ("fit --set none --seed 1 --out b.npz --method magic", "'magic'"),
        ("fit --set none --seed 1 --out b.npz --method H-svm --size bands", "--size"),
        ("score none --set none.npz --json /proc/none/x.json", "/proc/none/x.json"),
        ("evaluate --set none --protocol random:2 --method H-svm --jobs 0", "--jobs 0"),
        ("evaluate --set none --protocol random:2 --method H-svm --effort 0", "--effort 0"),
        ("evaluate --set none --protocol random:2 --method magic", "'magic'"),
    ],
)
def test_what_cannot_be_written_or_computed_is_refused_first(
    args: str, message: str, capsys: pytest.CaptureFixture[str]
):
    """Wrong options are refused before a set is read: the sets named here do not exist."""
    assert main(args.split()) != 0
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("fit --set x --seed 1 --out fit.npz", "goes on where it was"),
        (f"score {bundle.DEFAULT} --set x", "begins anew"),
        ("evaluate --set x --protocol random:2 --method H-svm", "goes on where it was"),
        ("pull user@box --out here", "goes on where it was"),
    ],
)
def test_an_interrupted_command_says_what_becomes_of_it(
    args: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """Ctrl-C gives exit code 130 and one line, which says whether the next call begins anew."""

    def interrupt(*args: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sets, "load", interrupt)
    monkeypatch.setattr(pull, "pull", interrupt)
    assert main(args.split()) == 130
    said = capsys.readouterr().err
    assert said.startswith("palpate-train: inter")
    assert said.endswith(f"{message}\n")


@pytest.mark.parametrize(("labels", "told"), [(15, False), (16, True)])
def test_more_labels_than_the_boards_wire_are_told_with_the_bundle(
    default_bundle: Bundle, capsys: pytest.CaptureFixture[str], labels: int, told: bool
):
    """Four GPIO lines have fifteen codes; one label more needs another line."""
    manifest = replace(default_bundle.manifest, labels=tuple(f"m{i}" for i in range(labels)))
    bundles._print(manifest, bundle.DEFAULT)
    line = (
        "answers on GPIO lines: 16 labels need 5 of output.class_bits; rpi4 wires 4, rpi5 wires 4"
    )
    assert (line in capsys.readouterr().out) == told


def test_each_command_has_options_of_its_own(capsys: pytest.CaptureFixture[str]):
    """Help needs no imports; each has its parser and function; others are refused."""
    parser = PROGRAM.parser(*PROGRAM.commands)
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    assert {*commands.choices} == {*PROGRAM.commands}
    assert len(PROGRAM.commands) == 9
    assert all(one.get_default("run") for one in commands.choices.values())
    for words, code in (([], 0), (["widen", "b"], 2)):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == code
    said = capsys.readouterr()
    assert all(name in said.out for name in PROGRAM.commands)
    assert "'widen'" in said.err


def test_signing_does_without_the_imports_of_training():
    """`sign` imports no training library, which its machine may lack."""
    code = "import sys; from palpate_train.cli.main import main; main(['sign', '--help'])"
    code = f"import sys\ntry:\n    {code}\nexcept SystemExit:\n    print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert "palpate-train sign" in done.stdout
    assert not {"sklearn", "scipy", "torch", "onnx", "pandas", "matplotlib"} & {
        *done.stdout.split()
    }


def test_a_command_computes_on_one_thread():
    """Beside it, threads of OpenBLAS would only wait, and sum in another order elsewhere."""
    code = (
        "import os; from palpate_train.cli.main import main; main(['sets']);"
        "import numpy; print(len(os.listdir('/proc/self/task')))"
    )
    env = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=120
    )
    assert done.stdout.splitlines()[-1] == "1", done.stderr


def few(tmp_path: Path) -> Path:
    """A set with a material of one recording, a material without any, and a constant taxel."""
    whole = easy(6)
    held = whole.take((whole.labels < 2) | (np.arange(len(whole)) == 12))
    held.samples[:, :, 0, 1] = 7
    replace(held, materials=(*held.materials, "ghost")).save(file := tmp_path / "few.npz")
    return file


@pytest.mark.parametrize("only", [[], ["--only", "material=low,middle"]])
def test_what_a_set_lacks_is_told_by_each_command_that_reads_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], only: list[str]
):
    """Materials without sweeps and constant taxels; not what --only leaves out."""
    args = f"evaluate --set {few(tmp_path)} --method L-svm --protocol leave:speed --jobs 1".split()
    assert main([*args, "--cache", str(tmp_path), *only]) == 0
    err = capsys.readouterr().err
    assert "1.2" in err
    assert ("ghost;" in err) == (not only)


@pytest.mark.slow
def test_a_material_of_one_recording_is_told_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Too few sweeps to judge with: said by fit, by export, and by evaluate."""
    args = ["--set", str(few(tmp_path)), "--only", "material=low,high"]
    why = "split by 'recording' leaves one sweep of 'high'; record more of it"
    fit = str(tmp_path / "fit.npz")
    assert main(["fit", *args, "--seed", "1", "--out", fit]) == 0
    assert f"few.npz: {why}" in capsys.readouterr().out
    assert (
        main(["export", fit, "--out", str(tmp_path / "b"), "--name", "b", "--version", "1"]) == 65
    )
    assert why in capsys.readouterr().err
    assert main(["evaluate", *args, "--method", "L-svm", "--protocol", "random:2"]) == 65
    assert "'high'" in capsys.readouterr().err
    args[3] = "material=low,middle"
    assert main(["evaluate", *args, "--method", "L-svm", "--protocol", "random:9"]) == 65
    assert "'low'" in capsys.readouterr().err


def test_an_error_of_a_library_without_a_file_is_told_in_its_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The message has a cause instead of "None: None"."""

    def fails(*args: object) -> None:
        raise OSError("the disk is on fire")

    monkeypatch.setattr(sets, "load", fails)
    assert main(["evaluate", "--set", "x", "--protocol", "random:2", "--method", "H-svm"]) == 1
    assert capsys.readouterr().err.endswith(": the disk is on fire\n")


def test_too_little_memory_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """A message with cause and remedy, and no traceback."""

    def load(*_: object) -> None:
        raise MemoryError("Unable to allocate 9.00 TiB")

    monkeypatch.setattr("palpate_train.data.sets.load", load)
    assert main(["sets", "describe", "sim:T-LAB:1:1"]) == 1
    said = capsys.readouterr().err
    assert "9.00 TiB; use fewer" in said
    assert said.count("\n") == 1


@pytest.mark.slow
def test_a_fit_names_groups_of_one_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Not named: several values, and groups that say where sweeps come from."""
    tubes = sets.load("sim:T-REAL/level-blind:1:2").select(["position<=2"])
    tubes = replace(tubes, groups=tubes.groups | {"direction": np.zeros(len(tubes), int)})
    source = tmp_path / "set.npz"
    tubes.save(source)
    words = "--seed 1 --size bands --out"
    assert main(["fit", "--set", str(source), *words.split(), str(tmp_path / "fit.npz")]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if "expect less" in line]
    (line,) = told
    assert "direction" in line


@pytest.mark.slow
def test_a_fit_teaches_no_sweep_of_other_things(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Sweeps that a box has recorded as `not this` move the limits, which fit and export tell."""
    source, made = str(tmp_path / "set.npz"), str(tmp_path / "fit.npz")
    sweeps = easy(40)
    replace(sweeps, materials=(*sweeps.materials[:2], NOT_THIS)).save(tmp_path / "set.npz")
    assert main(["fit", "--set", source, "--seed", "1", "--size", "bands", "--out", made]) == 0
    assert f"of 40 sweeps of {NOT_THIS!r}" in capsys.readouterr().out
    out = ["--out", str(tmp_path / "bundle"), "--name", "b", "--version", "1"]
    assert main(["export", made, *out]) == 0
    assert f"of 40 sweeps of {NOT_THIS!r}" in capsys.readouterr().out
    assert bundle.load(tmp_path / "bundle").manifest.labels == sweeps.materials[:2]


@pytest.mark.parametrize(
    ("group", "wrong", "told"),
    [
        ("speed", 2, ["worst speed: 3 mm/s, 75 % of 8; outermost"]),
        ("speed", 1, ["worst speed: 2 mm/s, 75 % of 8"]),
        ("position", 2, ["worst position: 3, 75 % of 8"]),
        ("who", 0, ["worst who: v1, 75 % of 8"]),
        ("recording", 0, []),
        ("speed", None, []),
    ],
)
def test_a_fit_tells_its_worst_value(group: str, wrong: int | None, told: list[str]):
    """Of each condition, unless all are right; names have no order."""
    values = np.repeat([1, 2, 3], 8)
    held = easy(8)
    held = replace(held, units={"speed": "mm/s"} if group == "speed" else {})
    named = np.char.add("v", values.astype(str)) if group == "who" else values
    held = replace(held, groups={group: named})
    given = held.labels.copy()
    if wrong is not None:
        given[8 * wrong : 8 * wrong + 2] += 1
    answers = Answers(given, np.ones(24, bool), given, given)
    by = SimpleNamespace(numbers=np.arange(1, 25), answers=lambda of: answers)
    calibration = SimpleNamespace(held={group: by})
    made = SimpleNamespace(train=held.take(np.arange(1)), held=held, calibration=calibration)
    made.worst_values = lambda: Fit.worst_values(made)
    lines = list(fit._worst(made))
    assert [line.partition(":")[0] for line in lines] == [one.partition(":")[0] for one in told]
    for line, one in zip(lines, told, strict=True):
        assert line.startswith(one)
        assert ("outermost" in line) is ("outermost" in one)

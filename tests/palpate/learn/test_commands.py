"""`palpate teach` as a command: what it refuses, and a whole session in simulation."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.cli import run_command, teach_command
from palpate.cli.common import load_settings
from palpate.cli.main import main
from palpate.cli.parser import arguments
from palpate.core import config
from palpate.learn import install
from palpate.runtime import assembly
from tests.factories import deliveries, install_scripts, lessons
from tests.factories.paths import ROOT
from tests.factories.sweep_sets import easy


@pytest.fixture
def options(tmp_path: Path) -> list[str]:
    """The settings of a box whose folders are below a temporary one."""
    (tmp_path / "store").mkdir()
    return ["--set", f"store.folder={tmp_path / 'store'}", "--set", f"store.keys={tmp_path}"]


def said(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and output of `palpate teach`."""
    code = main(["teach", *words])
    return code, "".join(capsys.readouterr())


def test_nothing_is_taught_without_leave_or_sweeps(options, capsys):
    """teach.allow = false, --sim without a folder, nothing recorded: no bundle."""
    for more in (["--use"], ["--label", "cork", "--sim", "skin"], ["--forget", "cork"]):
        code, text = said([*options, "--set", "teach.allow=false", *more], capsys)
        assert code == 78
        assert "teach.allow" in text
    code, text = said(["--label", "cork", "--sim", "skin"], capsys)
    assert code == 78
    assert "--sim" in text
    code, text = said(options, capsys)
    assert code == 1
    assert "cannot" in text
    assert "service" in text


def test_a_box_without_a_key_says_so_before_sweeps(options, tmp_path, capsys):
    """No sweep is made in vain. A box whose labels are enrolled elsewhere gets no key."""
    (tmp_path / "enrolment").mkdir()
    (tmp_path / "enrolment" / "signer").touch()
    code, text = said([*options, "--label", "cork", "--sim", "skin", "--virtual"], capsys)
    assert code == 78
    assert "install" in text


def test_materials_beyond_the_class_bits_are_refused_before_a_sweep(options, tmp_path, capsys):
    """Of two materials the single bit can show one; no sweep is recorded, of the first neither."""
    install_scripts.enrolment_key(tmp_path / "enrolment")
    bits = ["--set", 'output.class_bits=["GPIO5"]']
    words = ["--label", "cork", "--label", "pine", "--sim", "skin", "--virtual", *bits]
    code, text = said([*options, *words], capsys)
    assert code == 78
    assert "output.class_bits" in text
    assert not list((tmp_path / "store" / "sweeps").glob("*.npy"))


@pytest.mark.parametrize(
    ("words", "untaught"),
    [
        (["--skin", "flexitac"], True),
        (["--skin", "palpate"], False),
        (["--skin", "flexitac", "--set", "teach.allow=false"], False),
        (["--skin", "flexitac", "--sim", "skin"], False),
    ],
)
def test_a_box_without_a_bundle_for_its_skin_is_taught_first(words, untaught):
    """Only where the profile says that the packaged bundle is for another skin."""
    args = arguments("run", words)
    packaged = bundle.load(bundle.DEFAULT)
    assert run_command.untaught(args, load_settings(args), packaged) is untaught


@pytest.mark.parametrize(
    ("words", "mode"),
    [
        (["--web"], "serial"),
        (["--web", "--board", "rpi5"], "two-lines"),
        (["--web", "--trigger", "timed"], "timed"),
    ],
)
def test_the_page_triggers_where_no_line_is_wired(words, mode):
    """With lines, or another trigger by choice, the page waits for it."""
    args = arguments("teach", words)
    assert teach_command.without_lines(args, load_settings(args)).trigger.mode == mode


@pytest.mark.parametrize(("board", "mode"), [([], "serial"), (["--board", "rpi5"], "two-lines")])
def test_a_box_without_lines_waits_to_be_taught(board, mode, monkeypatch):
    """It does not end because no line can start a sweep: the page or a command does later."""
    modes = []
    monkeypatch.setattr(
        teach_command.TeachingProgram,
        "run",
        lambda self, *_: modes.append(self.settings.trigger.mode),
    )
    args = arguments("run", ["--skin", "flexitac", *board])
    assert teach_command.until_taught(args, load_settings(args)) == 0
    assert modes == [mode]


@deliveries.NEEDED
@pytest.mark.slow
@pytest.mark.thorough  # a fit with all checks of an export
def test_recorded_sweeps_become_the_bundle_of_the_box(options, tmp_path, capsys):
    """Signed, on trial, by whom; again the version counts up."""
    install_scripts.enrolment_key(tmp_path / "enrolment")
    lessons.write(tmp_path / "store" / "sweeps", easy(8))
    code, text = said([*options, "--use", "--by", "anna"], capsys)
    assert code == 0, text
    assert "installed" in text
    settings = config.load(None, [*options[1::2]], site=ROOT / "tests/factories/no-site.toml")
    running = assembly.store(settings).running()
    assert running.signer == "taught here"
    assert running.bundle.manifest.taught.startswith("taught here by anna, 20")
    assert install.version(assembly.store(settings)) == "2"
    left = {path.name for path in (tmp_path / "store").iterdir()}
    assert left == {"sweeps", "bundles", "bundles.json", "current"}

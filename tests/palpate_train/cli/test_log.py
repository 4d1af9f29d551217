"""Progress: a bar on a terminal, erased at the end, and occasional lines in a log."""

import os
import pty
import subprocess
import sys
from textwrap import dedent

import pytest

from palpate_train.arguments import options
from palpate_train.data.progress import ProgressLine, StageLine
from tests.factories import terminals
from tests.factories.paths import ROOT


@pytest.mark.slow
@pytest.mark.thorough  # trains on a terminal
def test_a_terminal_shows_a_bar_and_is_left_as_it_was():
    """The bar shows the share and the line, output stands above, the cursor comes back."""
    script = dedent("""
    import sys, time
    from palpate_train.arguments.options import Log
    from palpate_train.data.progress import Progress
    log = Log()
    progress = Progress(4, log)
    progress("the first [bold]fold[/bold]")
    time.sleep(0.3)
    log.keep("a line that stays")
    print("a result", flush=True)
    log("not counted {what}")
    time.sleep(0.3)
    sys.exit(3)
    """)

    def on_a_terminal(out_too: bool) -> tuple[str, str]:
        """The script's text on a terminal of 100 columns, and its output elsewhere."""
        far, near = pty.openpty()
        done = subprocess.Popen(
            [sys.executable, "-c", script],
            cwd=ROOT,
            stdin=near,
            stderr=near,
            stdout=near if out_too else subprocess.PIPE,
            env=os.environ | {"TERM": "xterm", "COLUMNS": "100", "LINES": "30"},
        )
        os.close(near)
        shown = terminals.read(far, done)
        os.close(far)
        printed = done.stdout.read().decode() if done.stdout else ""
        assert terminals.ended(done, shown) == 3
        return shown.decode(), printed

    shown, printed = on_a_terminal(out_too=False)
    for text in (
        "━",
        "1/4 done, ",
        "(the first [bold]fold[/bold])",
        "a line that stays",
        "not counted {what}",
    ):
        assert text in shown, text
    assert printed == "a result\n"
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")
    assert "a result" in on_a_terminal(out_too=True)[0]


def test_a_log_has_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """A log gets whole lines without escapes, none too early except those that are kept."""
    log = options.Log()
    log(ProgressLine.of(1, 2, 3.0, "early"))
    log.keep("kept")
    monkeypatch.setattr(options, "LOG_EVERY_S", -1)
    log(ProgressLine.of(1, 2, 3.0, "a fold"))
    kept, later = capsys.readouterr().err.splitlines()
    assert (kept, later) == ("kept", ProgressLine.of(1, 2, 3.0, "a fold"))


def test_a_stage_knows_how_much_is_done_and_stays_with_its_time(capsys: pytest.CaptureFixture[str]):
    """A training says its step; the end checks the last stage, once."""
    log = options.Log()
    for stage, what in ((1, "features of 9 sweeps"), (2, "choosing: a"), (2, "choosing: b")):
        log(StageLine.of(stage, 2, ("features", "choice")[stage - 1], what))
    log.end()
    log.end()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == ["features", "choice"]
    assert all(line.endswith(" 0 s") for line in lines)
    known = StageLine.of(3, 3, "training", "step 300/1200 loss 0.31, 9 s left")
    assert known.startswith("part 3 of 3, step")
    assert known.within == 0.25
    assert options._share(known) == {"completed": 2.25, "total": 3}
    assert options._share(StageLine.of(2, 3, "choice", "choosing: b"))["completed"] == 1

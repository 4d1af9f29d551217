"""The page of the library: its code runs from top to bottom, as a notebook."""

import re
from pathlib import Path

import pytest

from tests.factories.paths import ROOT


@pytest.mark.slow
@pytest.mark.thorough  # a fit, a peer and a bundle
def test_the_code_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Each block prints its result; new positions are far above chance."""
    page = (ROOT / "docs" / "tutorials" / "library.md").read_text()
    pytest.importorskip("aeon")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "build").mkdir()
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        exec(compile(block, "library.md", "exec"), names)
    (call,) = re.findall(r"`(cross_val_score\(.*)`", page)
    assert len(eval(call, names)) == 6
    out = capsys.readouterr().out
    assert "4x4 uint8 at 750 Hz" in out
    assert float(re.findall(r"new positions: ([\d.]+)", out)[0]) > 0.6
    assert "MiniRocket, 500" in out
    assert 'license: "CC0-1.0"' in out

"""Commands take the settings of one of several units."""

from __future__ import annotations

import pytest

from palpate.cli.main import main
from palpate.core import config


def test_status_is_of_the_unit_that_is_asked_for(tmp_path, monkeypatch, capsys):
    """It looks in the folder of the unit's own settings, else in one with the unit's name."""
    monkeypatch.setattr(config, "SITE", tmp_path / "palpate.toml")
    own = tmp_path / "left-runtime"
    (tmp_path / "left.toml").write_text(f'[store]\nruntime = "{own}"\n')
    (tmp_path / "right.toml").write_text("")
    for unit, folder in (("left", str(own)), ("right", "/run/palpate-right")):
        assert main(["status", "--unit", unit]) == 1
        said = capsys.readouterr()
        assert f"{folder}/" in said.out + said.err
    with pytest.raises(SystemExit):
        main(["status", "--unit"])

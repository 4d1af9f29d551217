"""Pseudo-terminals that stand for the serial line."""

from __future__ import annotations

import errno
import os
import re

from palpate.cli.main import main


def test_a_system_without_pseudo_terminals_is_said(monkeypatch, capsys):
    """The error names their folder and how to mount it."""

    def absent() -> tuple[int, int]:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    monkeypatch.setattr(os, "openpty", absent)
    assert main(["demo", "--virtual", "--sweeps", "1"]) == 69
    assert re.search("/dev/pts: .*; mount", capsys.readouterr().err)

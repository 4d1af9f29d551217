"""A box without a bundle hands over to the page of teaching, and says its address."""

from __future__ import annotations

import os
import re
import subprocess

import pytest

from palpate.cli import teach_command
from palpate.cli.common import load_settings
from palpate.cli.parser import arguments
from palpate.core.observer import Health
from palpate.learn import process, program
from palpate.learn.program import FILE, HandOver
from palpate.sim.rig import VirtualClock
from tests.factories.feeds import HEALTH
from tests.factories.paths import ROOT


def test_the_file_comes_once_between_two_sweeps(tmp_path):
    """Not before an installation has seen the service run, and not during a sweep."""
    clock = VirtualClock()
    one, quiet = HandOver(tmp_path, clock), HEALTH._replace(sweeping=False)
    sweeping: Health = HEALTH._replace(sweeping=True)
    one.turn(quiet)
    assert not (tmp_path / FILE).exists()
    clock.sleep_until(clock.now_ns() + program.AFTER_NS)
    one.turn(sweeping)
    assert not (tmp_path / FILE).exists()
    one.turn(quiet)
    assert (tmp_path / FILE).exists()
    (tmp_path / FILE).unlink()  # the page has taken it
    one.turn(quiet)
    assert not (tmp_path / FILE).exists()


def test_no_page_ends_nothing(tmp_path, logged, monkeypatch):
    """A file that cannot be written is said once; without libraries nothing is handed over."""
    clock = VirtualClock()
    one = HandOver(tmp_path / "nowhere", clock)
    clock.sleep_until(clock.now_ns() + program.AFTER_NS)
    for _ in range(2):
        one.turn(HEALTH._replace(sweeping=False))
    assert len(logged) == 1
    assert "itself" in logged[0]
    settings = load_settings(arguments("run", []))
    with monkeypatch.context() as patched:
        patched.setattr(process, "find_spec", lambda name: None)
        assert "palpate_train" in teach_command.page_address(settings)
    monkeypatch.setattr(teach_command, "find_spec", lambda name: None)
    assert "palpate[page]" in teach_command.page_address(settings)


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_the_units_name_the_file(tmp_path, kind):
    """The path unit waits for it; the page removes it before it starts. A service that was taken
    over could make something else of this name."""
    path = f"/run/palpate/{FILE}"
    assert f"PathExists={path}\n" in (ROOT / "systemd/palpate-teach.path").read_text()
    wants = re.search(r"(?m)^Wants=.*", (ROOT / "systemd/palpate.service").read_text())
    assert wants
    assert "palpate-teach.path" in wants[0]
    here, beside = tmp_path / FILE, tmp_path / "beside"
    beside.mkdir()
    (beside / "kept").touch()
    if kind == "file":
        here.touch()
    elif kind == "link":
        here.symlink_to(beside)
    else:
        (here / "inside").mkdir(parents=True)
    unit = (ROOT / "systemd/palpate-teach.service").read_text()
    remove = re.search(rf"(?m)^ExecStartPre=-(.*) {path}$", unit)
    assert remove
    subprocess.run([*remove[1].split(), here], check=True, timeout=120)
    assert not os.path.lexists(here)
    assert (beside / "kept").exists()


def test_the_service_alone_can_write_the_file():
    """Each unit with this folder runs as palpate; not its group."""
    units = [path.read_text() for path in (ROOT / "systemd").glob("*.service")]
    owners = [unit for unit in units if "\nRuntimeDirectory=palpate\n" in unit]
    assert len(owners) == 2
    for unit in owners:
        assert "\nRuntimeDirectoryMode=0755\n" in unit
        assert "\nUser=palpate\n" in unit


@pytest.mark.parametrize(
    ("more", "address"),
    [
        ([], "http://127.0.0.1:8138"),
        (["--set", 'watch.address="0.0.0.0"'], r"https://[^:/]+:8138"),
        (["--set", 'watch.address="box"'], r"no page \(watch\.address: 'box' is not an IP .*"),
        (["--set", "teach.allow=false"], r"no page \(teach\.allow = false forbids .*"),
    ],
    ids=["this machine", "network", "wrong", "forbidden"],
)
def test_the_address_is_known_without_the_token(more, address):
    """The service may not read the token; why there is no page is said in its place."""
    settings = load_settings(arguments("run", more))
    assert re.fullmatch(address, teach_command.page_address(settings))

"""`palpate bundles install` refuses a bundle for another skin than the skin that streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.manifest import SCHEMA, Manifest
from palpate.cli import bundle_commands
from palpate.cli.main import main
from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.errors import BundleError
from palpate.core.observer import Health
from palpate.deployment.store import Store
from palpate.service.status_file import StatusFile
from tests.factories import deliveries, feeds, toy_bundle
from tests.factories.deliveries import Delivery

RUNNING = bundle.load(bundle.DEFAULT)
HEALTH = feeds.HEALTH._replace(frames=5_000, lost_frames=0, bundle=RUNNING.id, ready=False)


@pytest.fixture
def settings(tmp_path: Path) -> Config:
    """Settings of a box without deliveries, which runs the packaged bundle."""
    store = (f"store.folder={tmp_path}", f"store.runtime={tmp_path}")
    return config.load(None, store, site=Path("/dev/null"))


def test_a_bundle_for_another_skin_is_refused_with_both_formats(settings):
    """Known by the bundle that runs; another window is accepted, any for an unknown skin."""

    def streaming(settings: Config, health: Health | None) -> object:
        """The format that an install learns from a service in this state; None without it."""
        if health:
            StatusFile(settings.store.status, SystemClock(), {}).turn(health)
        return bundle_commands.streaming(settings, Store(settings.store, lambda bundle: None))

    assert streaming(settings, None) is None
    assert streaming(settings, HEALTH) == RUNNING.format
    assert streaming(settings, HEALTH._replace(skin="mismatch", streams=False)) is None
    assert streaming(settings, HEALTH._replace(bundle="9f3c2a1b")) is None
    format = RUNNING.format
    other = replace(
        RUNNING,
        manifest=replace(RUNNING.manifest, format=replace(format, rows=5, cols=3, rate_hz=100.0)),
    )
    with pytest.raises(BundleError, match=r"5x3 .*4x4"):
        bundle_commands.suits(other, format)
    bundle_commands.suits(other, None)
    shorter = replace(
        RUNNING, manifest=replace(RUNNING.manifest, format=replace(format, window=750))
    )
    bundle_commands.suits(shorter, format)


@deliveries.NEEDED
def test_the_command_refuses_it_unless_it_is_told(tmp_path, capsys):
    """`bundles install` changes nothing; with `--other-skin` it is on trial."""
    box = Delivery(tmp_path)
    held = toy_bundle.files()
    held[bundle.MANIFEST] = replace(
        Manifest.parse(held[bundle.MANIFEST]), counter=1, schema=SCHEMA
    ).json()
    folder = box.copied(deliveries.signed(held, box.key))
    how = {"folder": box.how.folder, "keys": box.how.keys, "runtime": tmp_path}
    StatusFile(tmp_path / "status.json", SystemClock(), {}).turn(HEALTH)
    command = [
        "bundles",
        "install",
        str(folder),
        *(word for name in how for word in ("--set", f"store.{name}={how[name]}")),
    ]
    before = sorted(Path(box.how.folder).rglob("*"))
    assert main(command) == 78
    said = capsys.readouterr()
    assert "OTHER_SKIN=1" in said.err
    assert sorted(Path(box.how.folder).rglob("*")) == before
    assert main([*command, "--other-skin"]) == 0
    assert "installed" in capsys.readouterr().out


@deliveries.NEEDED
@pytest.mark.parametrize(
    ("sets", "named"),
    [([], ""), (["classifier.bundle=/own"], "classifier.bundle")],
    ids=["store", "box"],
)
def test_a_bundle_that_the_settings_name_stays(sets, named, tmp_path, capsys):
    """A setting of another bundle stays in force, and the message has its name."""
    box = Delivery(tmp_path)
    own, new = box.made(1), box.made(2)
    sets = [f"store.folder={box.how.folder}", f"store.keys={box.how.keys}", *sets]
    words = [word for one in sets for word in ("--set", one.format(own=own))]
    assert main(["bundles", "install", str(new), "--other-skin", *words]) == 0
    said = capsys.readouterr().out
    assert "installed" in said
    assert said.endswith(f": {named}\n") if named else "does not run" not in said

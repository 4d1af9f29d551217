"""From recorded sweeps to a bundle of the box, on a disk that is full at any moment."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.cli.main import main
from palpate.core import storage
from palpate.core.config import StoreConfig, load
from palpate.deployment.store import Store
from palpate.learn import install
from palpate.runtime import assembly
from tests.cuts.teaching import at_once
from tests.factories import deliveries, install_scripts, lessons
from tests.factories.paths import ROOT
from tests.factories.sweep_sets import easy

pytestmark = [deliveries.NEEDED, pytest.mark.slow]


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The settings of a box with recorded sweeps and a taught bundle in service."""
    install_scripts.enrolment_key(tmp_path / "enrolment")
    lessons.write(tmp_path / "store" / "sweeps", easy(1))
    monkeypatch.setattr(install, "_wait", at_once)
    sets = [f"store.folder={tmp_path / 'store'}", f"store.keys={tmp_path}"]
    words = [word for one in sets for word in ("--set", one)]
    assert main(["teach", "--use", *words]) == 0
    assert store(words).commit()
    return words


def store(words: list[str]) -> Any:
    """The store of the box."""
    return assembly.store(load(None, words[1::2], site=ROOT / "tests/factories/no-site.toml"))


def test_two_that_teach_at_once_share_no_folder(tmp_path):
    """The second is refused while the first has it; leftovers of a power cut are cleared."""
    (tmp_path / "teaching" / "old").mkdir(parents=True)
    place = Store(StoreConfig(folder=str(tmp_path)), prove=lambda bundle: None)
    with install._scratch(place) as first:
        assert not first.exists()
        (first / "bundle").mkdir(parents=True)
        with pytest.raises(install.TeachingFailed), install._scratch(place):
            pass
        assert (first / "bundle").exists()
    with install._scratch(place) as second:
        assert not second.exists()


def test_a_full_disk_leaves_the_bundle_in_service(box, tmp_path, monkeypatch, capsys):
    """Whichever write fails: a line, all sweeps, a whole bundle."""

    def full(act: Callable[..., Any], count: list[int], at: int) -> Callable[..., Any]:
        """A write that fails at its call number `at`."""

        def run(*args: Any, **more: Any) -> Any:
            count[0] += 1
            if count[0] == at:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "bundle")
            return act(*args, **more)

        return run

    # All by which a bundle gets into the store
    writes = ("put", "put_all", "write", "sync", "link", "exchange")
    sweeps, done, at = tmp_path / "store" / "sweeps", False, 0
    kept = sorted(path.read_bytes() for path in sweeps.iterdir())
    while not done:
        at, count = at + 1, [0]
        capsys.readouterr()
        with monkeypatch.context() as patched:
            for name in writes:
                patched.setattr(storage, name, full(getattr(storage, name), count, at))
            code = main(["teach", "--use", "--json", *box])
        done, last = count[0] < at, json.loads(capsys.readouterr().out.splitlines()[-1])
        assert (code == 0) is (last["type"] == "taught")
        if not done:
            assert last["type"] == "error" or store(box).running().bundle.manifest.version == "2"
            assert last["type"] != "error" or "device" in last["text"]
        assert sorted(path.read_bytes() for path in sweeps.iterdir()) == kept
        assert store(box).running().taught
        assert not (tmp_path / "store" / "teaching").exists()
    assert at > 5
    assert main(["teach", "--use", *box]) == 0

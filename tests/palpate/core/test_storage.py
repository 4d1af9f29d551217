"""Atomic writes: folders, syncs and errors. Cuts of the power are in tests/cuts."""

from __future__ import annotations

import errno
import os

import pytest

from palpate.core import storage


def test_folders_are_made_once_and_what_fails_is_said(tmp_path):
    """With missing parents; the system's own error."""
    for name in ("a", "b"):
        storage.put(tmp_path / "one" / "two" / name, name.encode(), parents=True)
    assert sorted(os.listdir(tmp_path / "one" / "two")) == ["a", "b"]
    with pytest.raises(FileNotFoundError) as e:
        storage.exchange(tmp_path, tmp_path / "none")
    assert (e.value.errno, e.value.filename) == (errno.ENOENT, str(tmp_path / "none"))


@pytest.mark.parametrize("durable", [True, False])
def test_only_a_durable_file_is_synced(tmp_path, monkeypatch, durable):
    """Each file and then its folder are synced, or nothing is."""
    synced = list[str]()
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(os.readlink(f"/proc/self/fd/{fd}")))
    storage.put_all({tmp_path / "a": b"1", tmp_path / "b": b"2"}, durable=durable)
    wanted = [f"{tmp_path}/a.part", f"{tmp_path}/b.part", str(tmp_path)]
    assert synced == (wanted if durable else [])

"""The backup of a box: onto another box whole, and each archive that may not be restored."""

from __future__ import annotations

import io
import json
import os
import tarfile
from contextlib import nullcontext
from pathlib import Path

import pytest

from palpate.cli import backup as command
from palpate.core.errors import ApplianceError, FormatError
from palpate.deployment import backup

SHA = "ab" * 32
SAVED = {
    "etc/palpate/palpate.toml": 'board = "rpi5"\n',
    "etc/palpate/allowed_signers": "anna ssh-ed25519 AAAA\n",
    "etc/palpate/enrolment/key": "private",
    "etc/palpate/watch/token-look": "1234",
    "var/lib/palpate/bundles.json": "{}",
    f"var/lib/palpate/bundles/{SHA}/manifest.json": "manifest",
    "var/lib/palpate/sweeps/sweep-000001.npy": "counts",
}


GIVE = backup._own


@pytest.fixture(autouse=True)
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Users of boxes do not exist here."""
    monkeypatch.setattr(backup, "_own", lambda path, member: None)


@pytest.mark.parametrize(("user", "given"), [(0, [(0, 0)]), (1000, [])])
def test_only_root_gives_files_to_others(tmp_path, monkeypatch, user, given):
    """To the user and the group of the same names; a name that is missing here is an error."""
    member, found = tarfile.TarInfo(), list[tuple[int, int]]()
    member.uname = member.gname = "root"
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(os, "chown", lambda path, *ids, **how: found.append(ids))
    GIVE(tmp_path, member)
    assert found == given
    member.uname = "nobody-of-this-box"
    with nullcontext() if user else pytest.raises(ApplianceError, match="nobody-of"):
        GIVE(tmp_path, member)


def box(root: Path, files: dict[str, str]) -> Path:
    """A box with these files, and the program's links."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    for folder in ("etc/palpate/skins", "var/lib/palpate/bundles", "var/lib/palpate/incoming"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    (root / "etc/palpate/board-rpi5.toml").symlink_to("/opt/palpate/share/palpate/board-rpi5.toml")
    return root


def old_box(root: Path) -> Path:
    """A box that has been taught."""
    one = box(root, SAVED | {"etc/palpate/watch/key.pem": "old", "var/lib/palpate/a.part": "half"})
    (one / "var/lib/palpate/current").symlink_to(f"bundles/{SHA}")
    (one / "etc/palpate/enrolment/key").chmod(0o400)
    return one


def saved(root: Path) -> bytes:
    """The backup of the box in a folder."""
    out = io.BytesIO()
    backup.save(out, root)
    return out.getvalue()


def seen(root: Path) -> dict[str, str]:
    """All files of a box by name, and the targets of its links."""
    return {
        str(path.relative_to(root)): os.readlink(path) if path.is_symlink() else path.read_text()
        for path in sorted(root.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


def test_a_box_comes_back_on_another(tmp_path, monkeypatch):
    """By one command each: settings, keys, bundles and sweeps come from the old box. The
    certificate and the links of the program stay; the former files of the new box stay beside them.
    The service stands still meanwhile."""
    old = old_box(tmp_path / "old")
    has = {"etc/palpate/watch/key.pem": "new", "etc/palpate/palpate.toml": "# new\n"}
    has |= {"var/lib/palpate/sweeps/sweep-000009.npy": "its own"}
    new, calls = box(tmp_path / "new", has), []
    monkeypatch.setattr(command, "_systemctl", lambda *words: calls.append(words))
    assert command.main(["save", str(tmp_path / "box.tar")], old) == 0
    assert (tmp_path / "box.tar").stat().st_mode & 0o777 == 0o600
    assert command.main(["restore", str(tmp_path / "box.tar")], new) == 0
    assert calls == [("stop", "palpate", "palpate-teach"), ("--no-block", "start", "palpate")]
    there = seen(new)
    assert {name: there[name] for name in SAVED} == SAVED
    assert there["etc/palpate/watch/key.pem"] == "new"
    assert there["etc/palpate/board-rpi5.toml"].startswith("/opt/palpate/")
    assert there["var/lib/palpate/current"] == f"bundles/{SHA}"
    assert "var/lib/palpate/a.part" not in there
    assert "var/lib/palpate/sweeps/sweep-000009.npy" not in there
    assert there["var/lib/palpate.before-restore/sweeps/sweep-000009.npy"] == "its own"
    assert there["etc/palpate.before-restore/palpate.toml"] == "# new\n"
    assert (new / "etc/palpate/enrolment/key").stat().st_mode & 0o777 == 0o400
    assert not [name for name in there if ".new" in name]
    # again, with the present files
    assert command.main(["restore", str(tmp_path / "box.tar")], new) == 0
    assert {name: seen(new)[name] for name in SAVED} == SAVED


def test_every_cut_and_every_changed_byte_is_found(tmp_path):
    """Nothing of the box has changed then, and nothing is left beside it."""
    data, new = saved(old_box(tmp_path / "old")), box(tmp_path / "new", {})
    before = seen(new)
    held = data.index(b"counts")
    changed = data[:held] + b"C" + data[held + 1 :]
    for wrong in (b"", b"no tar", changed, *(data[:n] for n in range(512, 512 * 30, 512))):
        if wrong.count(b"digests.json"):
            assert wrong is changed or len(wrong) < len(data)
            if wrong is not changed and b'"files"' in wrong:
                continue  # complete but for the padding
        with pytest.raises(FormatError, match="again"):
            backup.unpack(io.BytesIO(wrong), new)
        assert seen(new) == before
        assert not list(tmp_path.glob("new/*/*/*.new")) + list(tmp_path.glob("new/*/*.new"))


def archive(*members: tarfile.TarInfo) -> io.BytesIO:
    """An archive of these members and the end that fits them."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as tar:
        for member in members:
            tar.addfile(member, io.BytesIO(b""))
        text = json.dumps({"schema": 1, "files": {}}).encode()
        end = tarfile.TarInfo(backup.END)
        end.size = len(text)
        tar.addfile(end, io.BytesIO(text))
    return io.BytesIO(out.getvalue())


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    """A member without content."""
    made = tarfile.TarInfo(name)
    made.type, made.linkname = kind, link
    return made


@pytest.mark.parametrize(
    "hostile",
    [
        member("settings/../../shadow"),
        member("/etc/shadow"),
        member("data"),
        member("other/file"),
        member("data/current", tarfile.SYMTYPE, "/etc"),
        member("data/sweeps", tarfile.SYMTYPE, f"bundles/{SHA}"),
        member("data/hard", tarfile.LNKTYPE, "settings/palpate.toml"),
        member("data/device", tarfile.CHRTYPE),
        member("data/pipe", tarfile.FIFOTYPE),
    ],
    ids=lambda one: one.name,
)
def test_a_member_that_no_box_has_saved_is_refused(tmp_path, hostile):
    """Paths that lead elsewhere, links, devices."""
    new = box(tmp_path / "new", {})
    with pytest.raises(FormatError, match="saved"):
        backup.unpack(archive(hostile), new)


def test_a_missing_current_bundle_and_another_schema_are_refused(tmp_path, monkeypatch):
    """The reason names them."""
    new = box(tmp_path / "new", {})
    link = member("data/current", tarfile.SYMTYPE, f"bundles/{SHA}")
    with pytest.raises(FormatError, match="current"):
        backup.unpack(archive(link), new)
    monkeypatch.setattr(backup, "SCHEMA", 2)
    later = saved(old_box(tmp_path / "old"))
    monkeypatch.setattr(backup, "SCHEMA", 1)
    with pytest.raises(FormatError, match="schema 2"):
        backup.unpack(io.BytesIO(later), new)


def test_a_computer_without_palpate_is_refused(tmp_path, capsys):
    """Both ways; the message names the missing part."""
    with pytest.raises(ApplianceError, match="installed"):
        backup.save(io.BytesIO(), tmp_path)
    with pytest.raises(ApplianceError, match="install"):
        backup.unpack(io.BytesIO(saved(old_box(tmp_path / "old"))), tmp_path / "bare")
    assert command.main(["restore", str(tmp_path / "nowhere")], tmp_path) == 1
    assert "nowhere" in capsys.readouterr().err


def test_a_full_disk_changes_nothing(tmp_path, monkeypatch):
    """The restore ends with the reason, and the box is as it was."""
    data, new = saved(old_box(tmp_path / "old")), box(tmp_path / "new", {})
    before = seen(new)

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device", "sweep")

    monkeypatch.setattr(backup.shutil, "copyfileobj", full)
    with pytest.raises(OSError, match="space"):
        backup.unpack(io.BytesIO(data), new)
    assert seen(new) == before


def test_a_stopped_restore_is_completed_by_another(tmp_path, monkeypatch):
    """After a power cut at any rename of the swap, the same command restores the rest."""
    data = saved(old_box(tmp_path / "old"))
    for cut in range(4):
        root = box(tmp_path / f"new-{cut}", {"etc/palpate/palpate.toml": "# new\n"})
        steps = iter(range(9))

        def step(act: object, steps: object = steps, cut: int = cut) -> object:
            def run(*args: object) -> object:
                if next(steps) == cut:
                    raise InterruptedError
                return act(*args)

            return run

        with monkeypatch.context() as patched:
            patched.setattr(backup.storage, "exchange", step(backup.storage.exchange))
            patched.setattr(Path, "rename", step(Path.rename))
            with pytest.raises(InterruptedError):
                backup.swap(backup.unpack(io.BytesIO(data), root), root)
        backup.swap(backup.unpack(io.BytesIO(data), root), root)
        assert {name: seen(root)[name] for name in SAVED} == SAVED

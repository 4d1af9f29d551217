"""Whether `palpate status` may leave the settings unread."""

from __future__ import annotations

from palpate.core import runtime_folder


def test_settings_are_read_if_a_file_may_speak_of_the_folder(tmp_path, monkeypatch):
    """Also behind a dead link and in a folder's place."""
    folder, site = tmp_path / "settings", tmp_path / "site.toml"
    monkeypatch.setattr(runtime_folder, "CHECKOUT", str(folder))
    monkeypatch.setattr(runtime_folder, "SITE", str(site))
    assert runtime_folder.is_default()
    folder.mkdir()
    (folder / ".#skin.toml").symlink_to(tmp_path / "nothing")
    (folder / "skin.toml").write_text("[skin]\n")
    assert runtime_folder.is_default()
    site.write_text('[store]\nruntime = "/x"\n')
    assert not runtime_folder.is_default()
    site.unlink()
    (folder / "other.toml").mkdir()
    assert not runtime_folder.is_default()

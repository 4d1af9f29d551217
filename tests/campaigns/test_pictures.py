"""Pictures in the documents name their bundle, and it is that of today."""

from __future__ import annotations

from pathlib import Path

from palpate.bundle import bundle
from tests.campaigns import pictures


def test_pictures_are_of_the_present_bundles():
    """The demo ran the packaged bundle, the page has that of the invented shift."""
    again = "run python -m tests.campaigns pictures"
    assert pictures.bundle_of(pictures.DEMO) == bundle.load(bundle.DEFAULT).id, again
    assert pictures.bundle_of(pictures.PAGE) == pictures.INVENTED, again


def test_a_picture_of_another_bundle_is_found(tmp_path: Path):
    """The name can be read back, and one without a name has none."""
    png, invented = pictures.PAGE.read_bytes(), pictures.INVENTED.encode()
    other = tmp_path / "page.png"
    other.write_bytes(pictures.stamped(png.replace(invented, b"x" * 8), "01234567"))
    assert pictures.bundle_of(other) == "01234567"
    other.write_bytes(png[:100])
    assert pictures.bundle_of(other) == ""

"""The card of a bundle: what it says of its skin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from palpate_train.export import card
from tests.factories import toy_bundle


@pytest.mark.parametrize(("kind", "told"), [("float32", True), ("int16", False)])
def test_counts_that_are_no_numbers_are_told_of_float32_skins(
    tmp_path: Path, kind: str, told: bool
):
    """A program that runs model.onnx alone has to look for NaN by itself."""
    format = replace(toy_bundle.FORMAT, dtype=kind)
    manifest = toy_bundle.load(tmp_path / "toy", format=format).manifest
    assert ("NaN" in card.text(manifest, None)) is told

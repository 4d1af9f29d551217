"""The README's picture shows an answer of the packaged bundle."""

import re

import pytest

from palpate.bundle import bundle
from palpate.core.errors import FormatError
from palpate.sim import skin
from palpate_studies import overview_plot


@pytest.mark.slow
def test_it_shows_the_verdict_and_every_label():
    """Each label occurs once with its probability, the verdict in the title, "simulated" too."""
    svg = overview_plot.draw("paper")
    assert "paper (simulated)" in svg
    shares = [float(share) for share in re.findall(r">([0-9.]+) %<", svg)]
    assert len(shares) == len(bundle.load(bundle.DEFAULT).manifest.labels)
    assert sum(shares) == pytest.approx(100, abs=0.31)
    assert shares == sorted(shares, reverse=True)
    assert f"raw counts at {skin.FORMAT.rate_hz:g} Hz (simulated)" in svg


@pytest.mark.slow
def test_an_unknown_material_is_named():
    """The error lists the permitted materials."""
    with pytest.raises(FormatError, match=r"'cheese'.*wood"):
        overview_plot.draw("cheese")

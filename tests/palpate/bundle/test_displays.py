"""Display names in the manifest of a bundle."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from palpate.bundle.bundle import Manifest
from palpate.core.errors import BundleError


def test_a_manifest_keeps_display_names(default_bundle):
    """It is read as it was written."""
    plain = default_bundle.manifest
    named = replace(plain, displays={plain.labels[0]: "木, geölt"})
    assert Manifest.parse(named.json()) == named


@pytest.mark.parametrize(
    ("displays", "message"),
    [
        ({"felt": "Filz"}, "display name of 'felt', which is not a label; export"),
        ({"wood": ""}, "display name '' of 'wood' cannot be shown; use 1 to 60 characters"),
        ({"wood": "x" * 61}, "of 'wood' cannot be shown; use 1 to 60 characters"),
        ({"wood": "a\u202eb"}, "of 'wood' cannot be shown; use 1 to 60 characters"),
        ({"wood": "a\n<3>b"}, "display name 'a\\n<3>b' of 'wood' cannot be shown"),
        ({"wood": "a\x1b[2J"}, "display name 'a\\x1b[2J' of 'wood' cannot be shown"),
        ({"wood": 7}, "display name 7 of 'wood' cannot be shown"),
        (["wood"], "manifest cannot be read"),
    ],
)
def test_what_is_no_display_name_is_refused(default_bundle, displays, message):
    """Its label, its text and the remedy are named."""
    content = json.loads(default_bundle.manifest.json()) | {"displays": displays}
    with pytest.raises(BundleError, match=re.escape(message)):
        Manifest.parse(json.dumps(content).encode())

"""The room where a bundle is signed. In: a bundle's folder, somebody's key, a counter. Out: the bundle with its signature.

The box refuses a bundle whose counter is not above that of each that it has committed, so that no old one, however well
signed, can be put back unnoticed. The counter is the signer's: count what you deliver, from 1.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from appliance.bundle import bundle
from appliance.bundle.manifest import SCHEMA, Manifest
from appliance.core import storage
from appliance.core.errors import BundleError
from appliance.deployment import signature


def sign(folder: Path, key: Path, counter: int | None = None) -> Manifest:
    """Sign the bundle in `folder`; its manifest. counter: goes into the manifest first, so the bundle's id changes.

    Raises BundleError where the bundle is not whole or has no counter yet, and ConfigError where `key` does not sign.
    """
    manifest = bundle.load(folder).manifest
    if counter is not None:
        manifest = replace(manifest, counter=counter, schema=SCHEMA)
    if manifest.counter < 1:
        raise BundleError(
            f"{folder} has counter {manifest.counter}, which no box takes; give it one above those that were delivered "
            "before: --counter N, from 1 on"
        )
    text = manifest.json()
    storage.put_all({folder / bundle.SIGNATURE: signature.sign(text, key), folder / bundle.MANIFEST: text})
    return manifest

"""Signing a bundle. In: a bundle's folder, a key, a counter. Out: the bundle with its signature.

The box refuses a bundle whose counter is not above that of every bundle it has committed, so that nobody can install an
old one again, even with a valid signature. The signer chooses the counter: number your deliveries, from 1.
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
    """Sign the bundle in `folder`; its manifest. counter: is written into the manifest first, so the bundle's id changes.

    Raises BundleError where the bundle is incomplete or has no counter yet, and ConfigError where `key` does not sign.
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

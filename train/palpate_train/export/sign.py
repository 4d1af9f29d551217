"""Signing of a bundle with a key and a counter.

The box refuses a bundle whose counter is not above that of every bundle it has committed, so that
an old bundle cannot be installed again, even with a valid signature. The signer chooses the
counter: number your deliveries, from 1.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from palpate.bundle import arrays, bundle
from palpate.bundle.bundle import Bundle
from palpate.bundle.manifest import SCHEMA, Manifest
from palpate.core import storage
from palpate.core.errors import BundleError
from palpate.deployment import signature

own_key = signature.own_key


def sign(folder: Path, key: Path, counter: int | None = None) -> Manifest:
    """Sign the bundle in `folder` and return its manifest. counter: is written into the manifest
    first, so the bundle's id changes.

    Labels that a box has enrolled become part of the bundle, so that other boxes know them. Raises
    BundleError if the bundle is incomplete or has no counter yet, and ConfigError if `key` does not
    sign.
    """
    loaded = bundle.load(folder)
    if counter is not None and counter < (had := loaded.manifest.counter):
        raise BundleError(
            f"{folder} has counter {had} already, and a box that has committed that takes no "
            f"{counter}; "
            f"use --counter {had + 1}, or export the bundle again"
        )
    held = _with_labels(loaded) if loaded.added else {}
    entries = {name: bundle.file_entry(data) for name, data in held.items()}
    manifest = replace(loaded.manifest, files=loaded.manifest.files | entries)
    if counter is not None:
        manifest = replace(manifest, counter=counter, schema=SCHEMA)
    if manifest.counter < 1:
        raise BundleError(
            f"{folder} has counter {manifest.counter}, which no box takes; give it one above those "
            "that were delivered "
            "before: --counter N, from 1 on"
        )
    text = manifest.json()
    signed = {bundle.SIGNATURE: signature.sign(text, key), bundle.MANIFEST: text}
    if not held:
        storage.put_all({folder / name: data for name, data in signed.items()})
        return manifest
    with storage.folder(folder.resolve()) as new:
        for name, data in ({bundle.MODEL: loaded.model} | held | signed).items():
            (new / name).write_bytes(data)
    return manifest


def _with_labels(loaded: Bundle) -> dict[str, bytes]:
    """Golden sweeps and class means, also of enrolled labels, as a bundle holds them without
    an enrolment next to it."""
    assert loaded.classes
    return {
        bundle.GOLDEN: bundle.golden_file(
            loaded.golden, loaded.golden_logits, loaded.golden_refusals
        ),
        bundle.MEANS: arrays.packed(**loaded.classes.arrays()),
    }

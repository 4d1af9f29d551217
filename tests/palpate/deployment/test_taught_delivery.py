"""A bundle that the box has taught itself: its signature, its trial, and deliveries beside it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.manifest import Manifest
from palpate.core.errors import BundleError
from palpate.deployment.enrolment_key import NAMESPACE, TAUGHT
from palpate.deployment.store import Store
from tests.factories import deliveries, install_scripts
from tests.factories.deliveries import Delivery

pytestmark = [deliveries.NEEDED, pytest.mark.slow]


@pytest.fixture
def box(tmp_path: Path) -> Delivery:
    """A box without a delivered bundle."""
    return Delivery(tmp_path)


def taught(box: Delivery, version: str = "1", namespace: str = TAUGHT) -> dict[str, bytes]:
    """The files of a bundle as `palpate teach` leaves them."""
    held = deliveries.files(0, None, name="taught", version=version)
    signed = box.enrolment_key.sign(held[bundle.MANIFEST], namespace)
    return held | {bundle.TAUGHT_SIGNATURE: signed}


def test_it_runs_on_trial_and_a_delivery_always_wins(box):
    """It needs no counter; each newer delivery is accepted."""
    delivered = box.committed(5)
    for version in ("1", "2"):
        sha = box.store.learn(taught(box, version))
        chosen = box.store.choose()
        assert chosen.trial
        assert (chosen.folder.name, box.store.running().signer) == (sha, "taught here")
        assert box.store.running().taught
    assert box.store.commit()
    assert box.store.state.counter == 5
    assert box.store.rollback() == delivered
    assert box.store.rollback() == sha
    newer = box.committed(6)
    assert box.start() == newer
    assert not box.store.running().taught


def test_only_this_box_accepts_it_and_only_as_it_was(box, tmp_path):
    """Refused: on another box, with the signature of a label or of a bundle, or altered."""
    held, elsewhere = taught(box), Delivery(tmp_path / "other")
    shutil.rmtree(elsewhere.enrolment_key.folder)
    install_scripts.enrolment_key(elsewhere.enrolment_key.folder)
    other = replace(Manifest.parse(held[bundle.MANIFEST]), version="2").json()
    for there, files in (
        (elsewhere, held),
        (box, taught(box, namespace=NAMESPACE)),
        (box, taught(box, namespace="palpate-bundle")),
        (box, held | {bundle.MANIFEST: other}),
    ):
        with pytest.raises(BundleError, match="taught"):
            there.store.learn(files)


def test_a_setting_refuses_it(box):
    """With teach.allow = false the key of the box can bring no model, and one that runs stops."""
    box.store.learn(taught(box))
    strict = Store(box.how, lambda bundle: None, taught=False)
    with pytest.raises(BundleError, match=r"teach\.allow"):
        strict.learn(taught(box, "2"))
    with pytest.raises(BundleError, match=r"teach\.allow"):
        strict.running()


def test_a_taught_bundle_takes_labels_and_the_desktops_signature(box):
    """Both signatures are shown; the desktop's counts then, with its counter."""
    box.store.learn(taught(box))
    grown = deliveries.enrolled(dict(box.store.running().files), box.enrolment_key)
    box.store.learn(grown)
    assert box.store.running().signer == "taught here, enrolled here"
    held = taught(box)
    own = held.pop(bundle.TAUGHT_SIGNATURE)
    manifest = replace(Manifest.parse(held[bundle.MANIFEST]), counter=3)
    held = deliveries.signed(held | {bundle.MANIFEST: manifest.json()}, box.key)
    box.store.install(box.copied(held | {bundle.TAUGHT_SIGNATURE: own}))
    assert not box.store.running().taught

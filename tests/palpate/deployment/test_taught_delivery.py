"""A bundle that the box has taught itself: its signature, its trial, and deliveries beside it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.manifest import Manifest
from palpate.core.errors import BundleError, ConfigError
from palpate.deployment.enrolment_key import NAMESPACE, SIGNER, TAUGHT
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


def test_it_runs_on_trial_and_is_gone_back_from(box: Delivery):
    """It needs no counter, even after a delivery with one, and `rollback` leads to that."""
    delivered = box.committed(5)
    sha = box.store.learn(taught(box))
    chosen = box.store.choose()
    assert chosen.trial
    assert (chosen.folder.name, box.store.running().signer) == (sha, "taught here")
    assert box.store.running().taught
    assert box.store.commit()
    assert box.store.state.counter == 5
    assert box.store.rollback() == delivered


def test_a_delivery_always_wins(box: Delivery):
    """After a taught bundle was committed, each newer delivery is accepted, as before it."""
    box.committed(1)
    box.store.learn(taught(box))
    assert box.store.commit()
    delivered = box.committed(2)
    assert box.start() == delivered
    assert not box.store.running().taught


def test_one_taught_bundle_follows_another(box: Delivery):
    """A box is taught again and again, without any counter."""
    for version in ("1", "2"):
        sha = box.store.learn(taught(box, version))
        assert box.store.commit()
    assert box.start() == sha


def test_only_this_box_accepts_it(box: Delivery, tmp_path: Path):
    """Another box has another key; there it has to be signed on a desktop."""
    other = Delivery(tmp_path / "other")
    shutil.rmtree(other.enrolment_key.folder)
    install_scripts.enrolment_key(other.enrolment_key.folder)
    with pytest.raises(BundleError, match=r"not taught on this box, .*teach it here"):
        other.store.learn(taught(box))


@pytest.mark.parametrize("namespace", [NAMESPACE, "palpate-bundle"])
def test_a_signature_for_something_else_is_refused(box: Delivery, namespace: str):
    """The key signs enrolled labels too; such a signature does not make a bundle valid."""
    with pytest.raises(BundleError, match="not taught on this box"):
        box.store.learn(taught(box, namespace=namespace))


def test_an_altered_bundle_is_refused(box: Delivery):
    """The signature covers the manifest, and with it all files."""
    held = taught(box)
    manifest = replace(Manifest.parse(held[bundle.MANIFEST]), version="2")
    with pytest.raises(BundleError, match="not taught on this box"):
        box.store.learn(held | {bundle.MANIFEST: manifest.json()})


def test_the_key_of_an_earlier_install_learns_to_teach(box: Delivery):
    """An earlier version admitted enrolled labels alone. The box says so, and `make install` adds
    the namespace to the same key."""
    folder = box.enrolment_key.folder
    signer = folder / SIGNER
    signer.write_text(signer.read_text().replace(f",{TAUGHT}", ""))
    with pytest.raises(ConfigError, match=r"does not admit taught bundles; run make install"):
        box.enrolment_key.check(TAUGHT)
    box.enrolment_key.check()
    install_scripts.enrolment_key(folder)
    box.enrolment_key.check(TAUGHT)
    box.enrolment_key.check()


def test_a_setting_refuses_it(box: Delivery):
    """With teach.allow = false the key of the box can bring no model, and one that runs stops."""
    box.store.learn(taught(box))
    strict = Store(box.how, lambda bundle: None, taught=False)
    with pytest.raises(BundleError, match=r"which teach.allow = false forbids; deploy a bundle"):
        strict.learn(taught(box, "2"))
    with pytest.raises(BundleError, match=r"teach.allow = false"):
        strict.running()


def test_a_label_is_enrolled_into_a_taught_bundle(box: Delivery):
    """Both signatures are of this box, and both are shown."""
    box.store.learn(taught(box))
    grown = deliveries.enrolled(dict(box.store.running().files), box.enrolment_key)
    box.store.learn(grown)
    assert box.store.running().signer == "taught here, enrolled here"


def test_signed_on_a_desktop_it_is_a_delivery(box: Delivery):
    """The desktop's signature counts then, with its counter."""
    held = taught(box)
    own = held.pop(bundle.TAUGHT_SIGNATURE)
    manifest = replace(Manifest.parse(held[bundle.MANIFEST]), counter=3)
    held = deliveries.signed(held | {bundle.MANIFEST: manifest.json()}, box.key)
    box.store.install(box.copied(held | {bundle.TAUGHT_SIGNATURE: own}))
    assert not box.store.running().taught

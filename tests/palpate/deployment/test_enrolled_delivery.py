"""A bundle with an enrolled label in the store: trial, rollback, age, and each refusal."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.core.errors import BundleError, ConfigError
from palpate.deployment.enrolment_key import KEY, SIGNER
from palpate.deployment.state import PACKAGED
from tests.factories import deliveries, install_scripts
from tests.factories.deliveries import SIGNER as ANNA
from tests.factories.deliveries import Delivery

pytestmark = [deliveries.NEEDED, pytest.mark.slow]


@pytest.fixture
def box(tmp_path: Path) -> Delivery:
    """A box without a delivered bundle."""
    return Delivery(tmp_path)


def grown(box: Delivery, label: str = "cork") -> dict[str, bytes]:
    """The files of the running bundle after the enrolment of a label."""
    return deliveries.enrolled(dict(box.store.running().files), box.enrolment_key, label)


def test_a_label_is_on_trial_and_gone_back_from(box):
    """It is committed; `rollback` leads to the bundle without it."""
    one = box.committed(1)
    with_cork = box.store.learn(grown(box))
    chosen = box.store.choose()
    assert chosen.trial
    assert chosen.bundle.enrolled == {"cork": 1}
    assert (chosen.bundle.manifest.counter, chosen.folder.name) == (1, with_cork)
    assert box.store.running().signer == f"{ANNA}, enrolled here"
    assert box.store.commit()
    assert box.store.rollback() == one
    assert box.store.rollback() == with_cork


def test_a_second_label_and_the_packaged_bundle(box):
    """The packaged bundle is trusted like the program."""
    first = box.store.learn(grown(box))
    second = box.store.learn(grown(box, "felt"))
    running = box.store.running()
    assert running.bundle.enrolled == {"cork": 1, "felt": 1}
    assert running.signer == "palpate, enrolled here"
    assert running.bundle.base == bundle.digest((bundle.DEFAULT / bundle.MANIFEST).read_bytes())
    assert len({first, second, running.bundle.base}) == 3
    assert box.store.rollback() == PACKAGED


def test_the_next_delivery_counts_from_the_bundle_that_was_signed(box):
    """Labels of an older one are refused after a newer."""
    box.committed(1)
    old = grown(box)
    with_cork = box.store.learn(old)
    assert box.store.commit()
    assert box.store.install(box.made(1)) != with_cork
    assert box.store.learn(old) == with_cork
    box.committed(2)
    with pytest.raises(BundleError, match="1, and 2"):
        box.store.learn(old)
    box.store.rollback()
    assert box.store.learn(grown(box, "felt"))


def test_no_part_can_be_exchanged(box, tmp_path):
    """Refused: an enrolment without a signature, signed by another box, or by a signer of bundles;
    labels of another bundle, other labels of this bundle; a base that is unsigned, altered, or by
    an unknown signer. So the box's private key can add labels and nothing else."""

    def check_refused(
        box: Delivery, files: dict[str, bytes], why: str, kind: type[Exception] = BundleError
    ) -> None:
        """From a folder and from its own enrolment; the box continues with the same bundle."""
        before = box.store.current
        for deliver in (
            lambda: box.store.install(box.copied(files)),
            lambda: box.store.learn(files),
        ):
            with pytest.raises(kind, match=why):
                deliver()
        assert box.store.current == before

    box.committed(1)
    good, key = grown(box), box.enrolment_key
    labels = {name: good[name] for name in (bundle.ENROLMENT, bundle.ENROLMENT_SIGNATURE)}
    unsigned = deliveries.enrolled(dict(box.store.running().files), None)
    check_refused(box, unsigned, "npz is not signed")
    for signed in (
        install_scripts.enrolment_key(tmp_path / "other").sign(good[bundle.ENROLMENT]),
        deliveries.signature.sign(good[bundle.ENROLMENT], box.key),
    ):
        check_refused(box, good | {bundle.ENROLMENT_SIGNATURE: signed}, "not enrolled")
    felt = grown(box, "felt")[bundle.ENROLMENT]
    check_refused(box, good | {bundle.ENROLMENT: felt}, "not enrolled")
    other = deliveries.files(1, box.key, version="other")
    check_refused(box, other | labels, "belongs to bundle")
    nobody = deliveries.enrolled(deliveries.files(9, None), key)
    check_refused(box, nobody, "not the packaged bundle")
    for signer in (deliveries.key(tmp_path, "unknown"), key.folder / KEY):
        unknown = deliveries.enrolled(deliveries.files(9, signer), key)
        check_refused(box, unknown, "none of the signers")
    for name in (bundle.MEANS, bundle.MODEL):
        altered = good | {name: good[name][:-1] + bytes([good[name][-1] ^ 1])}
        check_refused(box, altered, f"{name} was altered")
    assert box.store.learn(good)


def test_a_lost_key_or_signer_does_not_end_what_runs_unless_it_must(box):
    """Without the private key the box continues. Without the signer the error says what to do, and
    the box continues after the signer was made again."""
    box.committed(1)
    box.store.learn(grown(box))
    assert box.store.commit()
    (box.enrolment_key.folder / KEY).rename(box.folder / "kept")
    assert box.store.running().bundle.enrolled
    (box.enrolment_key.folder / SIGNER).unlink()
    with pytest.raises(ConfigError, match="install"):
        box.store.choose()
    (box.folder / "kept").rename(box.enrolment_key.folder / KEY)
    install_scripts.enrolment_key(box.enrolment_key.folder)
    assert box.start() == box.store.current


def test_a_program_with_another_packaged_bundle_does_not_take_the_label(box, monkeypatch):
    """It says what to do; `rollback` works."""
    box.store.learn(grown(box))
    assert box.store.commit()
    newer = deliveries.put(box.folder / "newer", deliveries.files(0, None, version="99"))
    monkeypatch.setattr(bundle, "DEFAULT", newer)
    with pytest.raises(BundleError, match="rollback"):
        box.store.choose()
    assert box.store.rollback() == PACKAGED
    assert box.store.running().bundle.manifest.version == "99"

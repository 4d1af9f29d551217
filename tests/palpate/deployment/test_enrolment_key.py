"""The box's key for enrolments: private, for nothing else; and the errors without it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.core.errors import BundleError, ConfigError, TemporaryError
from palpate.deployment import signature
from palpate.deployment.enrolment_key import KEY, NAMESPACE, SIGNER, TAUGHT, EnrolmentKey
from tests.factories import deliveries, install_scripts

pytestmark = deliveries.NEEDED
DATA = b"any enrolment"


@pytest.fixture
def key(tmp_path: Path) -> EnrolmentKey:
    """A key as an install makes it."""
    return install_scripts.enrolment_key(tmp_path / "enrolment")


def test_a_bench_gets_a_key_of_its_own(tmp_path):
    """It signs what it admits, nobody else may read it, and a second start leaves it alone."""
    key = EnrolmentKey(tmp_path / "bench" / "enrolment")
    assert key.make()
    before = (key.folder / KEY).read_bytes()
    assert not key.make()
    for namespace in (NAMESPACE, TAUGHT):
        key.check(namespace)
    assert (key.folder / KEY).read_bytes() == before
    assert (key.folder / KEY).stat().st_mode & 0o077 == 0
    assert sorted(os.listdir(key.folder)) == [KEY, SIGNER]


def test_an_install_makes_a_private_key_once(key):
    """It signs validly, and another install changes nothing."""
    assert (key.folder / KEY).stat().st_mode & 0o777 == 0o400
    assert (key.folder / SIGNER).stat().st_mode & 0o777 == 0o644
    assert key.folder.stat().st_mode & 0o777 == 0o750
    assert sorted(os.listdir(key.folder)) == [KEY, SIGNER]
    before = {name: (key.folder / name).read_bytes() for name in (KEY, SIGNER)}
    key.check()
    install_scripts.enrolment_key(key.folder)
    assert {name: (key.folder / name).read_bytes() for name in (KEY, SIGNER)} == before
    key.verify(DATA, key.sign(DATA))


def test_a_signature_is_for_one_box_and_use(key, tmp_path):
    """Another box, data or use, or cut: refused; never for bundles, whatever the signers say."""
    other = install_scripts.enrolment_key(tmp_path / "other")
    assert (other.folder / KEY).read_bytes() != (key.folder / KEY).read_bytes()
    good = key.sign(DATA)
    bundles = signature.sign(DATA, key.folder / KEY)
    for data, signed in (
        (DATA, other.sign(DATA)),
        (DATA + b"!", good),
        (DATA, bundles),
        (DATA, good[:80]),
        (DATA, b""),
    ):
        with pytest.raises(BundleError, match="enrolled"):
            key.verify(data, signed)
    key.verify(DATA, good)
    signers = tmp_path / "allowed_signers"
    signers.write_text((key.folder / SIGNER).read_text())
    for signed in (key.sign(DATA), signature.sign(DATA, key.folder / KEY)):
        with pytest.raises(BundleError, match="namespace"):
            signature.verify(DATA, signed, signers)


def held(key: EnrolmentKey, data: Callable[[bytes], bytes], mode: int = 0o400) -> None:
    """Change the private key."""
    path = key.folder / KEY
    path.chmod(0o600)
    path.write_bytes(data(path.read_bytes()))
    path.chmod(mode)


def another(key: EnrolmentKey) -> bytes:
    """The private key of another box."""
    other = install_scripts.enrolment_key(key.folder.parent / "another")
    return (other.folder / KEY).read_bytes()


SPOILS: dict[str, tuple[Callable[[EnrolmentKey], None], str]] = {
    "lost": (lambda key: (key.folder / KEY).unlink(), "No such file"),
    "open to all": (lambda key: held(key, bytes, 0o444), "mode 444"),
    "cut": (lambda key: held(key, lambda data: data[: len(data) // 2]), "is damaged"),
    "empty": (lambda key: held(key, lambda data: b""), "is damaged"),
    "of another": (lambda key: held(key, lambda data: another(key)), "does not admit"),
    "no signer": (lambda key: (key.folder / SIGNER).unlink(), "signer cannot be read"),
}


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_key_that_cannot_be_used_is_told_with_what_to_do(key, spoil):
    """In one line before the robot sweeps."""
    spoiled, why = SPOILS[spoil]
    spoiled(key)
    with pytest.raises(ConfigError, match=why) as e:
        key.check()
    assert "install" in str(e.value)
    assert "\n" not in str(e.value)


def test_a_lost_signer_is_made_again_and_a_lost_key_is_not(key):
    """`make install` makes the signer again, and earlier signatures are valid again. A new key
    would make them invalid: without the private key the enrolled labels stay valid."""
    signed, before = key.sign(DATA), (key.folder / SIGNER).read_bytes()
    SPOILS["no signer"][0](key)
    install_scripts.enrolment_key(key.folder)
    assert (key.folder / SIGNER).read_bytes() == before
    SPOILS["lost"][0](key)
    install_scripts.enrolment_key(key.folder)
    assert os.listdir(key.folder) == [SIGNER]
    key.verify(DATA, signed)


@pytest.mark.parametrize("namespace", [NAMESPACE, TAUGHT])
def test_an_ssh_keygen_that_dies_once_is_tried_again(key, tmp_path, monkeypatch, namespace):
    """At the start of a box with enrolled labels or a taught bundle, and before a lesson: the error
    passes, so the service is restarted, not ended for good (exit code 78)."""
    signed = key.sign(DATA, namespace)
    (tmp_path / "bin").mkdir()
    dying = tmp_path / "bin" / "ssh-keygen"
    dying.write_text("#!/bin/sh\nkill -9 $$\n")
    dying.chmod(0o755)
    with monkeypatch.context() as patched:
        patched.setenv("PATH", f"{dying.parent}:{os.environ['PATH']}")
        for act in (
            lambda: key.verify(DATA, signed, namespace),
            lambda: key.sign(DATA, namespace),
            lambda: key.check(namespace),
        ):
            with pytest.raises(TemporaryError) as e:
                act()
            assert e.value.exit_code != ConfigError.exit_code
    key.verify(DATA, signed, namespace)

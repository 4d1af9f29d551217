"""Signatures: which signers a box trusts, and the errors where one is wrong or unchecked."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from palpate.bundle import bundle
from palpate.bundle.manifest import Manifest
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError, BundleError, ConfigError
from palpate.deployment import signature
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment
from palpate_train.export import sign
from tests.factories import deliveries
from tests.factories.deliveries import SIGNER, line

pytestmark = deliveries.NEEDED
MESSAGE = b'{"name": "any manifest"}\n'


class Signers:
    """Two keys, and a signers' file with the first."""

    def __init__(self, folder: Path) -> None:
        self.ours, self.theirs = deliveries.key(folder, "ours"), deliveries.key(folder, "theirs")
        self.file = folder / "allowed_signers"
        self.write(line(self.ours))

    def write(self, *lines: str) -> None:
        """Write these lines to the file."""
        self.file.write_text("".join(lines))

    def verify(self, signed: bytes | None = None, message: bytes = MESSAGE) -> str:
        """The name of the signer; signs with the first key by default."""
        return signature.verify(message, signed or signature.sign(MESSAGE, self.ours), self.file)


@pytest.fixture
def signers(tmp_path: Path) -> Signers:
    """Two keys, and a signers' file with the first."""
    return Signers(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ed25519", "rsa", "ecdsa"])
def test_a_signer_is_named(tmp_path, kind):
    """The file has several signers, comments, empty lines, and the namespace in an option."""
    own, other = deliveries.key(tmp_path, "own", kind), deliveries.key(tmp_path, "other")
    file = tmp_path / "signers"
    file.write_text(
        "# who may\n\n" + line(other, "ben") + line(own, "anna", 'namespaces="git,palpate-bundle" ')
    )
    assert signature.verify(MESSAGE, signature.sign(MESSAGE, own), file) == "anna"
    assert signature.verify(MESSAGE, signature.sign(MESSAGE, other), file) == "ben"


@pytest.mark.slow
def test_a_signature_of_nobody_in_the_file_is_refused(signers):
    """Also cut, empty, huge; a BOM and CR LF do no harm."""
    good = signature.sign(MESSAGE, signers.ours)
    for signed, message, why in (
        (signature.sign(MESSAGE, signers.theirs), MESSAGE, "signed by none"),
        (signature.sign(MESSAGE, signers.ours, "git"), MESSAGE, "namespace"),
        (good, MESSAGE + b" ", "incorrect signature"),
        (good[:100], MESSAGE, "signed by none"),
        (b"", MESSAGE, "signed by none"),
        (good + b"\n" * signature.MOST_SIGNATURE, MESSAGE, "16384 bytes"),
    ):
        with pytest.raises(BundleError, match=why):
            signature.verify(message, signed, signers.file)
    signers.file.write_bytes(("\ufeff# me\r\n" + line(signers.ours) + " \r\n").encode())
    assert signers.verify(good) == SIGNER
    signers.write(line(signers.ours, SIGNER, 'namespaces="git" '))
    with pytest.raises(BundleError, match="namespace"):
        signers.verify(good)


@pytest.mark.slow
@pytest.mark.parametrize("names", [("anna", "ben"), ("anna", "anna")])
def test_the_order_of_two_lines_of_a_key_does_not_matter(signers: Signers, names: tuple[str, str]):
    """One for git alone, the other for bundles."""
    good = signature.sign(MESSAGE, signers.ours)
    lines = [line(signers.ours, names[0], 'namespaces="git" '), line(signers.ours, names[1])]
    for order in (lines, lines[::-1]):
        signers.write(*order)
        assert signers.verify(good) == names[1]
    signers.write(lines[0], lines[0])
    with pytest.raises(BundleError, match="namespace"):
        signers.verify(good)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "No such file"),
        ("", "no signer"),
        ("# nobody\n\n", "no signer"),
        ("# anna\u2028ben {key}", "no signer"),
        ("anna valid-before=20300101 {key}", "line 1"),
        ('{line}anna namespaces="git",Valid-After="20200101" {key}', "line 2"),
        ("anna cert-authority {key}", "line 1"),
        ("*@lab {key}", "line 1"),
        ("anna,ben {key}", "line 1"),
        ("{key}", "line 1"),
        ("anna ssh-ed25519 AAAA", "line 1"),
        ("anna ssh-ed25519 !", "line 1"),
        ("anna ssh-dss {blob}", "line 1"),
        ("anna ssh-rsa {blob}", "line 1"),
        ("anna\u00a0{key}", "line 1"),
        ("anna no-such-option {key}", "line 1"),
        ("\udcff\n", "cannot be read"),
        ("#" * 300_000, "262144 bytes"),
    ],
)
def test_a_file_of_signers_is_understood_to_its_last_line_or_refused(signers, text, why):
    """The error names a line that ssh-keygen would skip silently, or that depends on the time."""
    key = line(signers.ours).removeprefix(f"{SIGNER} ")
    if text is None:
        signers.file.unlink()
    else:
        for name, held in (("key", key), ("line", line(signers.ours)), ("blob", key.split()[1])):
            text = text.replace(f"{{{name}}}", held)
        signers.file.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError, match=why):
        signers.verify()


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        (subprocess.TimeoutExpired("ssh-keygen", 10), 75),
        (OSError(12, "Cannot allocate memory"), 75),
        (BlockingIOError(11, "Resource temporarily unavailable"), 75),
        (subprocess.CompletedProcess("ssh-keygen", -9, b"", b""), 75),
        (FileNotFoundError(2, "No such file"), 78),
        (PermissionError(13, "Permission denied"), 78),
    ],
)
def test_faults_of_ssh_keygen_that_pass_are_tried_again(monkeypatch, tmp_path, fault, code):
    """Only a fault for a person keeps the service down."""

    def fails(*words: object, **options: object) -> object:
        if isinstance(fault, Exception):
            raise fault
        return fault

    monkeypatch.setattr(subprocess, "run", fails)
    with pytest.raises(ApplianceError) as e:
        signature.sign(MESSAGE, tmp_path / "key")
    assert e.value.exit_code == code


def test_an_ssh_keygen_that_hangs_is_ended(signers, monkeypatch):
    """The box does not hang with it."""
    good = signature.sign(MESSAGE, signers.ours)
    program = signers.file.parent / "ssh-keygen"
    program.write_text("#!/bin/sh\nexec /bin/sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(signers.file.parent))
    monkeypatch.setattr(signature, "DEADLINE_S", 0.1)
    with pytest.raises(ConfigError, match="timed"):
        signers.verify(good)


def test_labels_that_a_box_enrolled_are_signed_for_all_boxes(tmp_path, signers):
    """An ordinary bundle with the same answers."""
    folder = deliveries.put(
        tmp_path / "bundle", deliveries.enrolled(deliveries.files(1, None), None)
    )
    before = bundle.load(folder)
    made = sign.sign(folder, signers.ours, 2)
    after, text = bundle.load(folder), (folder / bundle.MANIFEST).read_bytes()
    assert signature.verify(text, (folder / bundle.SIGNATURE).read_bytes(), signers.file) == SIGNER
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        [*made.files, bundle.MANIFEST, bundle.SIGNATURE]
    )
    assert (after.added, after.enrolled, made.labels) == (None, {"cork": 1}, before.manifest.labels)
    assert before.classes
    assert after.classes
    for name, values in before.classes.arrays().items():
        assert after.classes.arrays()[name].tobytes() == values.tobytes()
    assert after.golden_logits.tobytes() == before.golden_logits.tobytes()
    assert after.manifest.known == before.manifest.known
    assert made.known
    assert made.known.enrolled == enrolment.LEAST
    Classifier(after, SystemClock()).self_test()


def test_signing_a_bundle(tmp_path, signers, capsys):
    """The counter is in the manifest; without a counter it refuses."""
    folder = deliveries.put(tmp_path / "bundle", deliveries.files(0, None))
    with pytest.raises(BundleError, match="counter 0"):
        sign.sign(folder, signers.ours)
    assert not (folder / bundle.SIGNATURE).exists()
    for counter, again in ((7, 7), (8, None), (9, 9)):
        made = sign.sign(folder, signers.ours, again)
        text = (folder / bundle.MANIFEST).read_bytes()
        assert Manifest.parse(text) == made
        assert made.counter == (counter if again else 7)
        assert (
            signature.verify(text, (folder / bundle.SIGNATURE).read_bytes(), signers.file) == SIGNER
        )
    text = (folder / bundle.MANIFEST).read_bytes()
    with pytest.raises(BundleError, match=r"9 .* 8"):
        sign.sign(folder, signers.ours, 8)
    assert (folder / bundle.MANIFEST).read_bytes() == text
    bundle.load(folder)
    (folder / bundle.MODEL).write_bytes(b"altered")
    with pytest.raises(BundleError, match="altered"):
        sign.sign(folder, signers.ours, 10)

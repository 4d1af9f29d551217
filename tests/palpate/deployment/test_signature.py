"""Signatures: which signers a box trusts, and the errors where a signature is wrong or cannot be
checked."""

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
def test_a_signer_is_named(tmp_path: Path, kind: str):
    """The file has several signers, comments, empty lines, and the namespace in an option."""
    own, other = deliveries.key(tmp_path, "own", kind), deliveries.key(tmp_path, "other")
    file = tmp_path / "signers"
    file.write_text(
        "# who may\n\n" + line(other, "ben") + line(own, "anna", 'namespaces="git,palpate-bundle" ')
    )
    assert signature.verify(MESSAGE, signature.sign(MESSAGE, own), file) == "anna"
    assert signature.verify(MESSAGE, signature.sign(MESSAGE, other), file) == "ben"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_a_file_from_another_editor_is_read(signers: Signers, encoding: str):
    """A byte order mark, UTF-16 and CR LF, as editors on other systems write them."""
    text = "# who may\r\n" + line(signers.ours, SIGNER).replace("\n", " \r\n")
    mark = "" if encoding in ("utf-8-sig", "utf-16") else "\ufeff"
    signers.file.write_bytes((mark + text).encode(encoding))
    assert signers.verify() == SIGNER


@pytest.mark.slow
def test_a_signature_of_nobody_in_the_file_is_refused(signers: Signers):
    """Another key, namespace or message, and a cut, empty or huge signature are refused with their
    reasons."""
    good = signature.sign(MESSAGE, signers.ours)
    other = subprocess.run(
        ["ssh-keygen", "-q", "-Y", "sign", "-n", "git", "-f", signers.ours],
        input=MESSAGE,
        stdout=-1,
        check=True,
        timeout=120,
    )
    for signed, message, why in (
        (
            signature.sign(MESSAGE, signers.theirs),
            MESSAGE,
            "signed by none of the signers in .*No principal matched",
        ),
        (other.stdout, MESSAGE, f"signature of {SIGNER} does not fit .*namespace does not match"),
        (good, MESSAGE + b" ", f"signature of {SIGNER} does not fit .*incorrect signature"),
        (good[:100], MESSAGE, "signed by none"),
        (b"", MESSAGE, "signed by none"),
        (good + b"\n" * signature.MOST_SIGNATURE, MESSAGE, "more than 16384 bytes"),
    ):
        with pytest.raises(BundleError, match=why):
            signature.verify(message, signed, signers.file)
    assert signers.verify(good) == SIGNER


def test_a_key_for_another_purpose_is_not_trusted(signers: Signers):
    """The option `namespaces` of the signers' file is respected."""
    signers.write(line(signers.ours, SIGNER, 'namespaces="git" '))
    with pytest.raises(BundleError, match="not permitted for use in signature namespace"):
        signers.verify()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "has no signer"),
        ("# nobody\n\n", "has no signer"),
        (
            "anna valid-before=20300101 {key}",
            "line 1: valid-before is not used here, a box may not know the time",
        ),
        (
            '{line}anna namespaces="git",Valid-After="20200101" {key}',
            "line 2: Valid-After is not used here",
        ),
        ("anna cert-authority {key}", "cert-authority is not used here"),
        ("*@lab {key}", "line 1: it is not understood"),
        ("anna,ben {key}", "line 1: it is not understood"),
        ("{key}", "line 1: it is not understood"),
        ("anna ssh-ed25519 AAAA", "line 1: it is not understood"),
        ("anna ssh-ed25519 !", "line 1: it is not understood"),
        ("anna ssh-dss {blob}", "line 1: it is not understood"),
        ("anna ssh-rsa {blob}", "line 1: it is not understood"),
        ("# anna\u2028ben {key}", "has no signer"),
        ("anna\u00a0{key}", "line 1: it is not understood"),
        ("anna no-such-option {key}", "line 1: it is not understood"),
        ("\udcff\n", "cannot be read"),
        ("#" * 300_000, "more than 262144 bytes"),
    ],
)
def test_a_file_of_signers_is_understood_to_its_last_line_or_refused(
    signers: Signers, text: str, why: str
):
    """The error names a line that ssh-keygen would skip silently, or that depends on the time."""
    key = line(signers.ours).removeprefix(f"{SIGNER} ")
    text = (
        text.replace("{key}", key)
        .replace("{line}", line(signers.ours))
        .replace("{blob}", key.split()[1])
    )
    signers.file.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError, match=why):
        signers.verify()


def test_a_missing_file_of_signers_is_named(signers: Signers):
    """The error shows the expected content of the file."""
    signers.file.unlink()
    with pytest.raises(ConfigError, match=r"No such file.*put a line `NAME KEY` there"):
        signers.verify()


def test_a_box_without_ssh_keygen_says_what_to_install(
    signers: Signers, monkeypatch: pytest.MonkeyPatch
):
    """The box does not hang if ssh-keygen hangs."""
    good = signature.sign(MESSAGE, signers.ours)
    monkeypatch.setenv("PATH", str(signers.file.parent))
    with pytest.raises(ConfigError, match="apt install openssh-client"):
        signers.verify(good)
    program = signers.file.parent / "ssh-keygen"
    program.write_text("#!/bin/sh\nexec /bin/sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(signature, "DEADLINE_S", 0.1)
    with pytest.raises(ConfigError, match=r"timed out after 0\.1 s"):
        signers.verify(good)


def test_a_key_that_cannot_sign_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """The file is not a key."""
    with pytest.raises(ConfigError, match="none does not sign"):
        signature.sign(MESSAGE, tmp_path / "none")
    assert "No such file" in capfd.readouterr().err


def test_labels_that_a_box_enrolled_are_signed_for_all_boxes(tmp_path: Path, signers: Signers):
    """`palpate-train sign` turns a bundle with an enrolment into an ordinary bundle with the same
    labels and answers and another signer."""
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


def test_signing_a_bundle(tmp_path: Path, signers: Signers, capsys: pytest.CaptureFixture[str]):
    """`palpate-train sign` writes the counter into the manifest and the signature beside it. It
    refuses to sign without a counter."""
    folder = deliveries.put(tmp_path / "bundle", deliveries.files(0, None))
    with pytest.raises(BundleError, match="counter 0, which no box takes"):
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
    with pytest.raises(
        BundleError, match=r"has counter 9 already, .* takes no 8; use --counter 10, or export"
    ):
        sign.sign(folder, signers.ours, 8)
    assert (folder / bundle.MANIFEST).read_bytes() == text
    bundle.load(folder)
    (folder / bundle.MODEL).write_bytes(b"altered")
    with pytest.raises(BundleError, match="was altered"):
        sign.sign(folder, signers.ours, 10)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (subprocess.TimeoutExpired("ssh-keygen", 10), 75),
        (OSError(12, "Cannot allocate memory"), 75),
        (BlockingIOError(11, "Resource temporarily unavailable"), 75),
        (FileNotFoundError(2, "No such file"), 78),
        (PermissionError(13, "Permission denied"), 78),
    ],
)
def test_faults_of_ssh_keygen_that_pass_are_tried_again(
    monkeypatch: pytest.MonkeyPatch, error: Exception, code: int
):
    """Only what a person can mend keeps the service down."""

    def fails(*words: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(subprocess, "run", fails)
    with pytest.raises(ApplianceError) as e:
        signature._keygen("verify")
    assert e.value.exit_code == code


def test_ssh_keygen_that_is_killed_says_nothing_about_the_signature(
    monkeypatch: pytest.MonkeyPatch,
):
    """Killed for want of memory, it is not "signed by none"."""
    done = subprocess.CompletedProcess("ssh-keygen", -9, b"", b"")
    monkeypatch.setattr(subprocess, "run", lambda *words, **options: done)
    with pytest.raises(ApplianceError, match="signal 9") as e:
        signature._keygen("find-principals")
    assert e.value.exit_code == 75

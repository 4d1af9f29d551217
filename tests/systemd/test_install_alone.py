"""`make install` with a host's name alone: the board and the signer that it finds or makes."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.deployment import signature
from tests.factories import deliveries
from tests.factories.install_scripts import require_pyinfra, run_here

require_pyinfra()


def shell(script: str) -> str:
    """The output of a script of the box, run here."""
    done = subprocess.run(
        ["sh", "-c", script], capture_output=True, text=True, check=True, timeout=120
    )
    return done.stdout.strip()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "board"),
    [
        ("Raspberry Pi 5 Model B Rev 1.0\0", "rpi5"),
        ("Raspberry Pi 4 Model B Rev 1.5\0", "rpi4"),
        ("Raspberry Pi Compute Module 4 Rev 1.0\0", "rpi4"),
        ("Raspberry Pi 400 Rev 1.0\0", "rpi400"),
        ("Raspberry Pi Model B Plus\0", ""),
        ("Radxa ROCK 5B\0", ""),
        (None, ""),
    ],
)
def test_the_firmware_tells_the_board(tmp_path: Path, model: str | None, board: str):
    """By the name that the kernel passes on; another computer tells none."""
    file = tmp_path / "model"
    if model is not None:
        file.write_text(model)
    assert shell(run_here(f"import install; print(install.own_board({str(file)!r}))")) == board


def set_board(folder: Path, board: str, before: str, model: str) -> str:
    """The settings file after an install of `board` on a box of this model."""
    for name, text in (("site", before), ("model", model), ("board-rpi5.toml", "")):
        (folder / name).write_text(text)
    shell(
        run_here(
            f"import install; from pathlib import Path; f = Path({str(folder)!r}); "
            "install.SETTINGS = str(f / 'site'); own = install.own_board; "
            "install.own_board = lambda: own(str(f / 'model')); "
            f"print('set -e'); print(install._set_board({board!r}, str(f)))"
        )
    )
    return (folder / "site").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("board", "before", "model", "after"),
    [
        ("", "# mine\n", "Raspberry Pi 5", 'board = "rpi5"\n# mine\n'),
        ("", 'board = "own"\n', "Raspberry Pi 5", 'board = "own"\n'),
        ("", "# mine\n", "Raspberry Pi 3", "# mine\n"),
        ("", "# mine\n", "Other", "# mine\n"),
        ("rpi4", 'board = "own"\n# mine\n', "Raspberry Pi 5", 'board = "rpi4"\n# mine\n'),
    ],
)
def test_a_box_without_a_board_gets_its_own(
    tmp_path: Path, board: str, before: str, model: str, after: str
):
    """Only if there is a file for it; a board that was named, now or before, stays."""
    assert set_board(tmp_path, board, before, model) == after


ASKED = """
import install, builtins
answers = iter(["rpi9", "rpi4"])
builtins.input = lambda question: (print(question), next(answers))[1]
class Box:
    name = "box"
    def __init__(self, found): self.found = found
    def run(self, what, command): return self.found
print([install.asked_board(Box(found)) for found in ('board = "rpi5"', "rpi5", "rpi3")])
"""


@pytest.mark.slow
def test_the_pins_are_asked_for_where_nothing_tells_them():
    """Not if the settings or the firmware tell them; a name without a file is asked for again."""
    said = run_here(ASKED).splitlines()
    assert said[0] == "box: the pins of which board? rpi4, rpi5, or Enter for none: "
    assert said[1] == "there is no board 'rpi9'"
    assert said[-1] == "['', '', 'rpi4']"


SIGNER = """
import own_signer; from fleet import Failed
told = []
try:
    print([own_signer.line(told.append) for _ in range(2)], len(told))
except Failed as e:
    print(e)
"""


@pytest.mark.slow
def test_a_signer_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """For this person alone; a damaged one, or no folder for it, is an error."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    key = tmp_path / "palpate" / "signing-key"
    made = run_here(SIGNER)
    assert made.endswith("] 1")
    assert made.count(key.with_suffix(".pub").read_text().split()[1]) == 2
    assert key.stat().st_mode & 0o777 == 0o600
    assert os.stat(key.parent).st_mode & 0o777 == 0o700
    key.with_suffix(".pub").write_text("")
    assert "signing-key.pub" in run_here(SIGNER)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "file"))
    assert "SIGNERS=FILE" in run_here(SIGNER)


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(None, "7"), ("6", "7"), ("8", "8"), ("x", "7")])
def test_a_delivery_raises_the_counter_of_root(tmp_path: Path, before: str | None, after: str):
    """A higher counter stays, and one that is no number is written again."""
    file = tmp_path / "counter"
    if before is not None:
        file.write_text(before)
    shell(run_here(f"import deploy; print(deploy.raised(7, {str(file)!r}))"))
    assert file.read_text().strip() == after
    assert [*tmp_path.iterdir()] == [file]


def unpacked(folder: Path, key: Path) -> Path:
    """A release as it is unpacked on a box, signed by a key. sums: more lines of its list."""
    release = folder / "palpate-1"
    (release / "wheels").mkdir(parents=True)
    (release / "wheels" / "palpate.whl").write_bytes(b"program")
    shell(f"cd {release} && sha256sum wheels/palpate.whl > SHA256SUMS")
    text = (release / "SHA256SUMS").read_bytes()
    (release / "SHA256SUMS.sig").write_bytes(signature.sign(text, key, "palpate-release"))
    return release


def others(release: Path) -> None:
    """Sign as another person."""
    key = deliveries.key(release.parent / "others")
    signed = signature.sign((release / "SHA256SUMS").read_bytes(), key, "palpate-release")
    (release / "SHA256SUMS.sig").write_bytes(signed)


def for_bundles(release: Path) -> None:
    """Sign as a bundle is signed."""
    signed = signature.sign((release / "SHA256SUMS").read_bytes(), release.parent / "keys" / "key")
    (release / "SHA256SUMS.sig").write_bytes(signed)


CHANGES: dict[str, tuple[Callable[[Path], object], int]] = {
    "as signed": (lambda r: None, 0),
    "another wheel": (lambda r: (r / "wheels" / "palpate.whl").write_bytes(b"PROGRAM"), 1),
    "a file more": (lambda r: (r / "palpate.service").touch(), 1),
    "a link more": (lambda r: (r / "share").symlink_to("/etc"), 1),
    "a file less": (lambda r: (r / "wheels" / "palpate.whl").unlink(), 1),
    "no signature": (lambda r: (r / "SHA256SUMS.sig").unlink(), 1),
    "a list of others": (others, 1),
    "the signature of a bundle": (for_bundles, 1),
    "an empty list": (lambda r: (r / "SHA256SUMS").write_bytes(b""), 1),
}


def checked(release: Path, signers: str) -> subprocess.CompletedProcess[str]:
    """Run the check of an unpacked release on a box with these signers."""
    file = release.parent / "signers"
    file.write_text(signers)
    script = run_here(
        f"import install; print(install.check_signature({str(release)!r}, {str(file)!r}))"
    )
    return subprocess.run(
        ["sh", "-ec", script], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.slow
@deliveries.NEEDED
@pytest.mark.parametrize("what", CHANGES)
def test_a_box_installs_what_a_signer_of_it_has_signed(tmp_path: Path, what: str):
    """Every file of the archive, and no other file."""
    key = deliveries.key(tmp_path / "keys")
    release = unpacked(tmp_path, key)
    change, code = CHANGES[what]
    change(release)
    done = checked(release, deliveries.line(key))
    assert done.returncode == code, done.stderr
    assert bool(done.stderr) == bool(code)


@pytest.mark.slow
@deliveries.NEEDED
@pytest.mark.parametrize(
    ("uses", "code"),
    [(("bundle", "release"), 0), (("release", "bundle"), 0), (("bundle", "bundle"), 1)],
)
def test_the_order_of_two_lines_of_a_key_does_not_matter(
    tmp_path: Path, uses: tuple[str, str], code: int
):
    """One of them has to allow releases."""
    key = deliveries.key(tmp_path / "keys")
    _, of = deliveries.line(key).split(" ", 1)
    each = zip(("anna", "anna-too"), uses, strict=True)
    signers = "".join(f'{name} namespaces="palpate-{use}" {of}' for name, use in each)
    assert checked(unpacked(tmp_path, key), signers).returncode == code


@pytest.mark.slow
def test_a_box_without_signers_says_that_nothing_was_checked(tmp_path: Path):
    """As when a Debian package is the first that comes."""
    where = f"{str(tmp_path)!r}, {str(tmp_path / 'none')!r}"
    script = run_here(f"import install; print(install.check_signature({where}))")
    done = subprocess.run(["sh", "-ec", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, "not checked" in done.stderr) == (0, True)

"""Fetching recordings: only new ones, whole pairs whenever a connection breaks, nothing
overwritten, and nothing else accepted.

The box is this machine: an `ssh` that hands its command to sh, with the real find, sha256sum and
tar. One test uses a real sshd if openssh-server is installed.
"""

import getpass
import io
import json
import os
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import ApplianceError, FormatError
from palpate.core.sweep_file import load
from palpate.core.types import Status
from palpate_train.cli.main import PROGRAM
from palpate_train.data import pull
from palpate_train.data.pull import PullReport, RecordingHost
from tests.factories.recordings import record

SSH = """#!/bin/sh
for command; do :; done
case "$command" in *{when}*) {what} ;; esac
exec sh -c "$command"
"""


class Ground:
    """A box with the folder `box`, and the local folder `here`; `ssh` can be replaced."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.box, self.here, self.bin = path / "box", path / "here", path / "bin"
        self.bin.mkdir()
        self.ssh()
        monkeypatch.setenv("PATH", str(self.bin), prepend=os.pathsep)
        for i in range(4):
            record(self.box / f"run {i // 2}" / f"sweep-{i:06d}.npy", "ab"[i % 2], id=i)

    def ssh(self, when: str = "nothing", what: str = "") -> None:
        """From now on `ssh` does `what` if its command holds `when`."""
        self.program("ssh", SSH.format(when=when, what=what))

    def program(self, name: str, text: str) -> None:
        """Put a command before the system's."""
        (self.bin / name).write_text(text)
        (self.bin / name).chmod(0o755)

    def pull(self, *more: str) -> None:
        """Run the command."""
        args = PROGRAM.parser("pull").parse_args(
            ["pull", "user@box", "--from", str(self.box), "--out", str(self.here), *more]
        )
        args.run(args)

    def fetch(self) -> PullReport:
        """Call the function behind the command."""
        tally = PullReport()
        pull.pull(RecordingHost("user@box", str(self.box)), self.here, tally, lambda line: None)
        return tally

    def same(self) -> bool:
        """Whether `here` holds exactly the files of the box."""
        return files(self.here) == files(self.box)


def files(folder: Path) -> dict[str, bytes]:
    """All files in a folder and below."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def counts(capsys: pytest.CaptureFixture[str], *names: str) -> list[int]:
    """Numbers of recordings fetched, there already and refused; `names` are printed below."""
    first, _, rest = capsys.readouterr().out.partition("\n")
    assert all(name in rest for name in names)
    return [int(word) for word in re.findall(r"\d+", first)]


@pytest.fixture
def ground(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ground:
    """A box with four recordings of two runs."""
    return Ground(tmp_path, monkeypatch)


def test_what_is_new_is_fetched(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """All recordings at first, then none, then the new recording; folders are the box's."""
    ground.pull()
    assert counts(capsys) == [4, 0, 0]
    assert ground.same()
    ground.ssh("tar", "exit 1")  # no recording that is present is fetched
    ground.pull()
    assert counts(capsys) == [0, 4, 0]
    ground.ssh()
    record(ground.box / "run 1" / "sweep-000004.npy", "a", id=4)
    ground.pull()
    assert counts(capsys) == [1, 4, 0]
    assert ground.same()


def test_a_box_without_recordings_has_none(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """Empty, or not there as sudo confirms; no local folder is made."""
    shutil.rmtree(ground.box)
    ground.box.mkdir()
    ground.pull()
    assert capsys.readouterr().out.startswith("fetched 0, ")
    assert not ground.here.exists()
    ground.program("sudo", '#!/bin/sh\nshift\nexec "$@"\n')
    with pytest.raises(ApplianceError, match="user@box"):
        pull.pull(
            RecordingHost("user@box", "/nowhere"), ground.here, PullReport(), lambda line: None
        )


def test_names_that_a_shell_would_read_otherwise_are_kept(ground: Ground):
    """Spaces, quotes, dollars, a dash, dots, other languages' letters, long names."""
    odd = ["a b", "it's $HOME", "-rf", "--checkpoint", "v1.2", "Häkelgarn", "x" * 150, "*", "\\n"]
    for name in odd:
        record(ground.box / name / f"{name}.npy", id=1)
    assert len(ground.fetch().fetched) == 13
    assert ground.same()


@pytest.mark.slow
def test_a_connection_that_breaks_off_leaves_whole_pairs(ground: Ground):
    """Wherever it ends, files are the box's, in pairs; the next call fetches the rest."""
    whole = sum(len(data) for data in files(ground.box).values()) + 8 * 512
    for cut in [*range(0, whole, 700), whole]:
        ground.ssh("tar", f'sh -c "$command" | head -c {cut}; exit 255')
        with pytest.raises(ApplianceError, match="no connection"):
            ground.fetch()
        held = files(ground.here) if ground.here.exists() else {}
        assert held.items() <= files(ground.box).items()
        assert {name[:-4] for name in held if name.endswith(".npy")} == {
            name[:-5] for name in held if name.endswith(".json")
        }
        ground.ssh()
        assert len(ground.fetch().fetched) == 4 - len(held) // 2
        assert ground.same()
        shutil.rmtree(ground.here)


def test_an_interrupted_call_goes_on(ground: Ground):
    """Ctrl-C after two recordings: these stay, and the next call fetches the other two."""
    tally = PullReport()

    def stop(line: str) -> None:
        if line.startswith("2/4 done"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pull.pull(RecordingHost("user@box", str(ground.box)), ground.here, tally, stop)
    assert len(tally.fetched) == 2
    assert len(files(ground.here)) == 4
    again = ground.fetch()
    assert (len(again.present), len(again.fetched)) == (2, 2)
    assert ground.same()


def test_what_is_left_of_a_kill_is_made_whole(ground: Ground):
    """A lone sidecar or a temporary file: the pair is fetched again."""
    ground.fetch()
    (ground.here / "run 0" / "sweep-000000.npy").unlink()
    (ground.here / "run 0" / "sweep-000001.npy").unlink()
    (ground.here / "run 0" / "sweep-000001.json").unlink()
    (ground.here / "run 0" / "sweep-000001.json.part").write_text("{")
    assert sorted(ground.fetch().fetched) == ["run 0/sweep-000000", "run 0/sweep-000001"]
    assert ground.same()


def test_half_a_recording_is_left_there(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """A missing sidecar or table: reported and not fetched; the others are."""
    (ground.box / "run 0" / "sweep-000000.json").unlink()
    (ground.box / "run 1" / "sweep-000003.npy").unlink()
    (ground.box / "run 1" / "sweep-000004.npy.part").write_bytes(b"half")
    ground.pull()
    assert counts(capsys, "run 0/sweep-000000", "run 1/sweep-000003") == [2, 0, 0]
    assert sorted(files(ground.here)) == [
        f"run {i // 2}/sweep-00000{i}.{end}" for i in (1, 2) for end in ("json", "npy")
    ]


def test_another_sweep_of_the_same_name_is_never_written_over(
    ground: Ground, capsys: pytest.CaptureFixture[str]
):
    """A box that counts from 1 again: both sweeps stay where they are, and the call fails."""
    ground.fetch()
    before = files(ground.here)
    record(ground.box / "run 0" / "sweep-000000.npy", "b", id=77)
    with pytest.raises(FormatError, match="1 recordings"):
        ground.pull()
    assert "run 0/sweep-000000" in capsys.readouterr().out
    assert files(ground.here) == before


def test_a_label_that_was_set_right_here_stays(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """An edited sidecar, here or on the box, is reported and no failure."""
    ground.fetch()
    mine = ground.here / "run 0" / "sweep-000000.json"
    mine.write_text(json.dumps(json.loads(mine.read_text()) | {"material": "cork"}))
    theirs = ground.box / "run 0" / "sweep-000001.json"
    theirs.write_text(json.dumps(json.loads(theirs.read_text()) | {"material": "felt"}))
    before = files(ground.here)
    ground.pull()
    assert counts(capsys, "run 0/sweep-000000", "run 0/sweep-000001") == [0, 2, 0]
    assert files(ground.here) == before


def test_what_is_no_recording_is_refused(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """Broken recordings of the box are not stored; a recording without frames is valid."""
    (ground.box / "run 0" / "sweep-000000.npy").write_bytes(b"\x93NUMPY")
    (ground.box / "run 0" / "sweep-000001.json").write_text("{}")
    np.save(ground.box / "run 1" / "sweep-000002.npy", np.array([{}], object), allow_pickle=True)
    record(ground.box / "sweep-000009.npy", status=Status.GAP, frames=0)
    with pytest.raises(FormatError, match="3 recordings"):
        ground.pull()
    assert counts(capsys, "run 0/sweep-000000 (") == [2, 0, 3]
    assert sorted(files(ground.here)) == [
        *(f"run 1/sweep-000003.{end}" for end in ("json", "npy")),
        "sweep-000009.json",
        "sweep-000009.npy",
    ]


def test_what_changes_while_it_is_fetched_is_refused(ground: Ground):
    """The bytes differ from the hash in the list."""
    ground.ssh("tar", f"echo >> '{ground.box}/run 0/sweep-000000.json'")
    tally = ground.fetch()
    (refused,) = tally.refused
    assert "000000.json changed" in refused
    assert len(tally.fetched) == 3


def test_what_goes_away_meanwhile_is_told(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """Removed between list and stream: the others are kept, and the box's message is passed on."""
    ground.ssh("tar", f"rm '{ground.box}/run 0/sweep-000000.npy'")
    with pytest.raises(ApplianceError, match="again"):
        ground.fetch()
    assert "sweep-000000.npy" in capsys.readouterr().err
    assert len(files(ground.here)) == 6


def member(name: str, kind: bytes = tarfile.REGTYPE, data: bytes = b"x", link: str = "") -> bytes:
    """An archive with one member of any kind."""
    held = io.BytesIO()
    with tarfile.open(fileobj=held, mode="w") as archive:
        info = tarfile.TarInfo(name)
        info.type, info.size, info.linkname = kind, len(data), link
        archive.addfile(info, io.BytesIO(data))
    return held.getvalue()


SWEEP, LINK = "run 0/sweep-000000.npy", tarfile.SYMTYPE


@pytest.mark.parametrize(
    "archive",
    [
        *map(member, ("../evil.npy", "run 0/../../evil.npy", "/tmp/evil.npy")),
        member("run 0/sweep-000007.npy"),
        member(SWEEP, LINK, b"", "/etc/passwd"),
        member(SWEEP, tarfile.LNKTYPE, b"", "../../../etc/passwd"),
        member("run 0", LINK, b"", "/tmp"),
        *(member(SWEEP, kind, b"") for kind in (tarfile.CHRTYPE, tarfile.FIFOTYPE)),
        member(SWEEP, tarfile.DIRTYPE, b""),
    ],
)
def test_a_hostile_archive_is_refused(ground: Ground, archive: bytes):
    """Paths outside, links, devices, files not asked for: none is written."""
    (ground.bin / "archive").write_bytes(archive)
    ground.ssh("tar", f"exec cat '{ground.bin}/archive'")
    with pytest.raises(FormatError, match="sends '"):
        ground.fetch()
    assert not ground.here.exists()


A, B = (f"run 0/sweep-{i:06d}" for i in (0, 1))
LONG_NAME = tarfile.TarInfo.create_pax_global_header({"comment": "x" * (2 << 20)})
STREAMS = {
    "parts of one after another": ((f"{A}.json", f"{B}.json", f"{A}.npy", f"{B}.npy"), b""),
    "a recording again and again": ((f"{A}.json",) * 3, b""),
    "a header without end": ((f"{A}.json",), LONG_NAME),
}
"""Requested files in a stream, and the bytes before them."""


@pytest.mark.parametrize(("names", "before"), STREAMS.values(), ids=STREAMS)
def test_a_hostile_stream_takes_no_memory(ground: Ground, names: tuple[str, ...], before: bytes):
    """One recording's parts wait at most, each file comes once, headers have a limit."""
    held = io.BytesIO()
    held.write(before)
    with tarfile.open(fileobj=held, mode="w") as archive:
        for name in names:
            info = tarfile.TarInfo(name)
            info.size = (ground.box / name).stat().st_size
            archive.addfile(info, io.BytesIO((ground.box / name).read_bytes()))
    (ground.bin / "archive").write_bytes(held.getvalue())
    ground.ssh("tar", f"exec cat '{ground.bin}/archive'")
    with pytest.raises((ApplianceError, FormatError), match=r"0 of 4|sends"):
        ground.fetch()
    assert not ground.here.exists()


def test_a_list_without_end_is_refused(ground: Ground, monkeypatch: pytest.MonkeyPatch):
    """It is not read to its end."""
    monkeypatch.setattr(pull, "MAX_LIST", 100)
    with pytest.raises(FormatError, match="lists"):
        ground.fetch()


def test_a_member_beyond_all_size_is_refused(ground: Ground):
    """Refused before its bytes are read: the archive holds only its header."""
    info = tarfile.TarInfo("run 0/sweep-000000.json")
    info.size = 1 << 40
    (ground.bin / "archive").write_bytes(info.tobuf())
    ground.ssh("tar", f"exec cat '{ground.bin}/archive'")
    with pytest.raises(FormatError, match="requested"):
        ground.fetch()


def test_a_name_that_leads_elsewhere_is_refused(ground: Ground):
    """A path in the list that leads elsewhere: it is not requested, and the others are fetched."""
    record(ground.box.parent / "evil.npy")
    sha256 = "f" * 64
    (ground.box / "run 0" / "line\nbreak.npy").write_bytes(b"")
    ground.program(
        "find",
        f"""#!/bin/sh
        printf '{sha256}  ./../evil.npy\\0{sha256}  ./../evil.json\\0{sha256}  .//etc/evil.npy\\0'
        exec {shutil.which("find")} "$@"
    """,
    )
    tally = ground.fetch()
    refused = [name.partition(" (")[0] for name in tally.refused]
    assert refused == ["'../evil'", "'/etc/evil'", "'run 0/line\\nbreak'"]
    assert ground.fetch().present == tally.fetched
    assert len(files(ground.here)) == 8


def test_a_shell_that_talks_and_a_missing_ssh_are_named(
    ground: Ground, monkeypatch: pytest.MonkeyPatch
):
    """A greeting before the list is not a file; the message says what to install."""
    ground.ssh("find", "echo Welcome")
    with pytest.raises(FormatError, match="b'Welcome"):
        ground.fetch()
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ApplianceError, match="ssh "):
        ground.fetch()


def test_a_folder_of_others_is_read_with_sudo(ground: Ground):
    """Only if it cannot be read without sudo; sudo runs the same script."""
    ground.program("sudo", f'#!/bin/sh\ntouch "{ground.bin}/asked"\nshift\nexec "$@"\n')
    ground.fetch()
    assert not (ground.bin / "asked").exists()
    shutil.rmtree(ground.here)
    ground.program("test", "#!/bin/sh\nexit 1\n")
    ground.ssh(
        "sh", f'command=$(echo "$command" | sed "s:test -r:{ground.bin}/test -r:")'
    )  # root may read anything
    assert len(ground.fetch().fetched) == 4
    assert (ground.bin / "asked").exists()


def test_a_folder_that_cannot_be_read_is_named(ground: Ground, capsys: pytest.CaptureFixture[str]):
    """Not there for this user, and sudo asks for a password: one message."""
    ground.program("sudo", "#!/bin/sh\necho 'sudo: a password is required' >&2\nexit 1\n")
    with pytest.raises(ApplianceError, match="/nowhere"):
        pull.pull(
            RecordingHost("user@box", "/nowhere"), ground.here, PullReport(), lambda line: None
        )
    assert capsys.readouterr().err.startswith("user@box: sudo: a")


def test_a_list_or_stream_that_is_cut_short_is_told(ground: Ground):
    """Failing or missing tools never look like a box without recordings."""
    ground.ssh("tar", "exit 0")
    with pytest.raises(ApplianceError, match="0 of 4"):
        ground.fetch()
    ground.program("find", "#!/bin/sh\nexit 127\n")
    with pytest.raises(ApplianceError, match="be read"):
        ground.fetch()


def test_an_npy_takes_its_name_last(ground: Ground, monkeypatch: pytest.MonkeyPatch):
    """As on a recording box: no .npy is ever without its sidecar, whenever the power fails."""
    taken = []
    monkeypatch.setattr(
        pull.storage, "put_all", lambda held: taken.extend(path.suffix for path in held)
    )
    ground.fetch()
    assert taken == [".json", ".npy"] * 4


def test_ssh_is_asked_without_questions(ground: Ground):
    """The user's options come first; no password is asked; a host is never an option."""
    ground.program("ssh", f'#!/bin/sh\nprintf "%s\\n" "$@" > "{ground.bin}/asked"\nexit 255\n')
    with pytest.raises(ApplianceError, match="no connection"):
        ground.pull("--port", "2222", "--ssh-option", "BatchMode=no")
    asked = (ground.bin / "asked").read_text().splitlines()
    assert asked[:6] == ["-o", "BatchMode=no", "-p", "2222", "-o", "BatchMode=yes"]
    assert asked[asked.index("--") + 1] == "user@box"
    assert "ConnectTimeout=10" in asked


@pytest.mark.slow
def test_through_a_real_sshd(tmp_path: Path):
    """Keys, a login shell, the real tools: all is fetched; a wrong key connects not."""
    sshd = Path("/usr/sbin/sshd")
    if not sshd.exists():
        pytest.skip("no sshd: apt-get install openssh-server")
    if os.getuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)  # normally made by its service
    for name in ("host", "mine"):
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / name],
            check=True,
            timeout=120,
        )
    lines = [f"HostKey {tmp_path}/host", f"AuthorizedKeysFile {tmp_path}/mine.pub", "PidFile none"]
    lines += ["StrictModes no", "UsePAM no"]
    lines += ["PasswordAuthentication no", "KbdInteractiveAuthentication no"]
    (tmp_path / "config").write_text("\n".join(lines) + "\n")
    # sshd takes one connection from a socket that ssh itself holds: no port is needed
    proxy = f"ProxyCommand={sshd} -i -f {tmp_path}/config"
    options = [proxy, f"IdentityFile={tmp_path}/mine", f"UserKnownHostsFile={tmp_path}/known"]
    options += ["StrictHostKeyChecking=accept-new", "IdentityAgent=none"]
    reach = ["-F", "none", *(part for option in options for part in ("-o", option))]
    for i in range(3):
        record(tmp_path / "box" / "a session" / f"sweep-{i:06d}.npy", "ab"[i % 2], id=i)
    box = RecordingHost(f"{getpass.getuser()}@palpate", str(tmp_path / "box"), reach)
    tally = PullReport()
    pull.pull(box, tmp_path / "here", tally, lambda line: None)
    pull.pull(box, tmp_path / "here", tally, lambda line: None)
    assert (len(tally.fetched), len(tally.present)) == (3, 3)
    assert files(tmp_path / "here") == files(tmp_path / "box")
    assert load(tmp_path / "here" / "a session" / "sweep-000002.npy")[0].material == "a"
    (tmp_path / "mine.pub").write_text("")
    with pytest.raises(ApplianceError, match="no connection"):
        pull.listing(box)

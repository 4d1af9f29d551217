"""The contract of skin, lines and port inside the guest, on its real kernel."""

import re
import threading
from pathlib import Path

from tests.rig.backends import remote
from tests.rig.image import Image
from tests.rig.inside import GuestControls, pack
from tests.rig.machine import Guest
from tests.rig.notes import Count, Note

PYTEST = (
    "/opt/palpate/bin/python -m pytest -q -rs -p no:cacheprovider tests/palpate/io/test_backends.py"
)
CODE = (
    "pyproject.toml",
    "tests/conftest.py",
    "tests/factories",
    "tests/rig/backends",
    "tests/palpate/io/test_backends.py",
)
"""Files of this checkout that the guest needs beside the installed box."""


def test_the_contract_holds_on_a_real_kernel(
    image: Image, tmp_path: Path, count: Count, note: Note
):
    """test_backends.py on xHCI, PL061 and a 16550; a part where time is short."""
    code = tmp_path / "code"
    code.mkdir()
    pack(code, CODE)
    some = count(1, 0) * " -k 'without_a_gap or start_and_stop or test_outputs or arrive_whole'"
    with Guest(image, tmp_path, snapshot=True, code=code) as machine:
        ends = (machine.bench().makefile("rwb"), GuestControls(machine))
        threading.Thread(target=remote.serve, args=ends, daemon=True).start()
        mount = "mkdir -p /code && mount -o ro /dev/vdb /code"
        machine.run(f"systemctl stop palpate; {mount}", timeout_s=90, check=True)
        env = "PYTHONDONTWRITEBYTECODE=1 PALPATE_BACKEND=remote PYTHONPATH=/code/site"
        done = machine.run(
            f"cd /code && timeout -s INT 500 env {env} {PYTEST}{some}", timeout_s=520
        )
    assert done.rc == 0, done.out[-6000:]
    passed = int(re.search(r"(\d+) passed", done.out)[1])
    assert passed >= 3
    note("none (the contract, inside)", "held", passed)

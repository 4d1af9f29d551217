"""The scripts of systemd/ that run on the box at its install, run on this machine."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from palpate.deployment.enrolment_key import EnrolmentKey
from tests.factories.paths import ROOT

SCRIPTS = ROOT / "systemd"


SERVER = """
import json, os, sys
fork, wait = os.fork, os.waitpid  # gevent may replace them
try:
    import deploy, install
except ImportError:
    pass  # no pyinfra here
for line in sys.stdin:
    child = fork()
    if not child:
        for fd, name in ((1, "said"), (2, "errors")):
            os.dup2(os.open(os.path.join(line.strip(), name), os.O_CREAT | os.O_WRONLY), fd)
        code = 1
        os.environ.clear()
        os.environ.update(json.load(open(os.path.join(line.strip(), "environment"))))
        try:
            exec(open(os.path.join(line.strip(), "code")).read(), {"__name__": "__main__"})
            code = 0
        except BaseException:
            import traceback
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    print(wait(child, 0)[1], flush=True)
"""
"""Forks a process for each line, which is a folder with code."""


@cache
def _server() -> subprocess.Popen[str]:
    """The process that has imported the scripts. It ends when its input ends."""
    return subprocess.Popen(
        [sys.executable, "-c", SERVER],
        env=os.environ | {"PYTHONPATH": str(SCRIPTS)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def run_here(code: str) -> str:
    """Output of code that imports the scripts, in a process: gevent changes it too much."""
    server = _server()
    assert server.stdin
    assert server.stdout
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "code").write_text(code)
        given = os.environ | {"PYTHONPATH": str(SCRIPTS)}
        Path(folder, "environment").write_text(json.dumps(dict(given)))
        server.stdin.write(f"{folder}\n")
        server.stdin.flush()
        failed = server.stdout.readline().strip()
        assert failed == "0", Path(folder, "errors").read_text()
        return Path(folder, "said").read_text().strip()


def enrolment_key(folder: Path) -> EnrolmentKey:
    """The box's key for enrolments, as the install makes it, but owned by this user."""
    if not shutil.which("ssh-keygen"):
        pytest.skip("needs ssh-keygen (apt-get install openssh-client)")
    made = f"enrolment_key.make({str(folder)!r}, os.getuid(), os.getgid())"
    code = f"import enrolment_key, os; print({made})"
    subprocess.run(["bash", "-euc", run_here(code)], check=True, capture_output=True, timeout=120)
    return EnrolmentKey(folder)


def page_secrets(folder: Path) -> None:
    """Token, key and certificate of the page, as the install makes them."""
    code = f"import page_secrets, os; print(page_secrets.make({str(folder)!r}, str(os.getgid())))"
    subprocess.run(["bash", "-euc", run_here(code)], check=True, capture_output=True, timeout=120)


def require_pyinfra() -> None:
    """Skip the module of tests where pyinfra is not installed. Its import would take long."""
    if find_spec("pyinfra") is None:
        pytest.skip("no pyinfra here; pip install -e .[deploy]", allow_module_level=True)

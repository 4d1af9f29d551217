"""`build/ros/bin/python tests/robots/messages.py`: builds palpate_msgs into the virtual environment
of this Python, as colcon does in an installation of ROS 2. Needs the extras `ros` and `ros-build`,
cmake, a C++ compiler and Python's headers.

The wheels were built elsewhere: their CMake files contain the paths of Python's and numpy's headers
on the machine that built them, and no prefix is set.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy

SOURCE = Path(__file__).resolve().parents[2] / "appliance" / "plugins" / "palpate_msgs"
BUILDER = "/opt/python/cp311-cp311"
"""Folder of Python on the machine that built the wheels."""


def mend(prefix: Path) -> None:
    """Replace these paths in the wheels' CMake files by this machine's."""
    headers = {
        f"{BUILDER}/include/python3.11": sysconfig.get_path("include"),
        f"{BUILDER}/lib/python3.11/site-packages/numpy/_core/include": numpy.get_include(),
    }
    for path in prefix.glob("share/*/cmake/*.cmake"):
        before = after = path.read_text()
        for there, here in headers.items():
            after = after.replace(there, here)
        if after != before:
            path.write_text(after)


def main() -> None:
    """Configure, build, install."""
    prefix = Path(sys.prefix)
    mend(prefix)
    environment = {**os.environ, "AMENT_PREFIX_PATH": str(prefix)}
    with tempfile.TemporaryDirectory() as folder:
        settings = {
            "CMAKE_PREFIX_PATH": prefix,
            "CMAKE_INSTALL_PREFIX": prefix,
            "Python3_EXECUTABLE": sys.executable,
            "Python3_FIND_VIRTUALENV": "ONLY",
            "Python3_ROOT_DIR": sys.base_prefix,
            "BUILD_TESTING": "OFF",
        }
        options = [f"-D{name}={value}" for name, value in settings.items()]
        for arguments in (
            ["-S", SOURCE, "-B", folder, *options],
            ["--build", folder],
            ["--install", folder],
        ):
            subprocess.run(["cmake", *arguments], env=environment, check=True)


if __name__ == "__main__":
    main()

"""Locks the versions and hashes of all packages again, the box's first; the others keep to its
versions.

`python -m tests.campaigns lock` runs uv, which has to be installed. PyTorch is in no lock, because
its build depends on the graphics card (docs/security.md).
"""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
BOX, TEACH = "appliance/requirements.lock", "appliance/teach.lock"
TOOLS = "tests/tools.lock"
BUILD = "setuptools>=77"
LOCKS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    BOX: (("-e .[page,mqtt,opcua,found]",), ()),
    TEACH: (("-e .[page,mqtt,opcua,found,teach]",), (BOX,)),
    TOOLS: (("-e .[dev]", "-e train[reports,peers,dask,files]", BUILD), (BOX, TEACH)),
    "systemd/build.lock": ((BUILD,), (TOOLS,)),
    "systemd/fleet.lock": (("-e .[deploy]",), (TOOLS,)),
    "train/desktop.lock": (("-e .", "-e train[reports]"), (TOOLS,)),
    "docs/site/site.lock": (("-e .[site]",), (TOOLS,)),
}
"""Each lock with what it holds, and the locks that it keeps to, in the order of making."""
LEFT_OUT = """palpate palpate-train torch triton cuda-toolkit cuda-bindings cuda-pathfinder
nvidia-cublas nvidia-cuda-cupti nvidia-cuda-nvrtc nvidia-cuda-runtime nvidia-cudnn-cu13 nvidia-cufft
nvidia-cufile nvidia-curand nvidia-cusolver nvidia-cusparse nvidia-cusparselt-cu13 nvidia-nccl-cu13
nvidia-nvjitlink nvidia-nvshmem-cu13 nvidia-nvtx"""
"""Ours, and PyTorch with what it brings."""


def command(out: str, keeps_to: tuple[str, ...]) -> list[str]:
    """The command that reads requirements and writes the lock `out`."""
    options = "-q --universal --generate-hashes --no-header --allow-unsafe --python-version 3.11"
    words = ["uv", "pip", "compile", *options.split(), "-", "-o", out]
    for name in LEFT_OUT.split():
        words += ["--no-emit-package", name]
    for lock in keeps_to:
        words += ["-c", lock]
    return words


def main() -> None:
    """Write all locks."""
    for out, (requirements, keeps_to) in LOCKS.items():
        print(out)
        subprocess.run(
            command(out, keeps_to), input="\n".join(requirements), text=True, cwd=ROOT, check=True
        )


if __name__ == "__main__":
    main()

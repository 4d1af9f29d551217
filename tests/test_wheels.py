"""The three distributions, installed from their wheels, in a folder with modules of the user."""

import ast
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path
from textwrap import dedent

import pytest

from palpate import __version__
from tests.factories.paths import ROOT

CLIENT = ROOT / "appliance" / "plugins" / "client" / "pyproject.toml"
OWN = ("train.py", "appliance.py", "serial_port.py", "library.py", "tests/__init__.py")
"""Files of a user, in the folder in which the programs run."""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The wheels by name, built from a copy, since a build leaves files behind."""
    top = tmp_path_factory.mktemp("wheels")
    left_out = shutil.ignore_patterns("studies", "*.egg-info", "__pycache__", "build")
    for name in ("appliance", "train"):
        shutil.copytree(ROOT / name, top / name, ignore=left_out)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, top / name)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "-q", "--no-deps"]
    sources = [top, top / "train", top / "appliance" / "plugins" / "client"]
    for source in sources:
        subprocess.run(
            [*pip, "--no-build-isolation", "-w", top / "dist", source], check=True, timeout=300
        )
    return {path.name.partition("-")[0]: path for path in (top / "dist").glob("*.whl")}


def run(wheels: list[Path], program: str, folder: Path) -> str:
    """The output of a program with these wheels, in a folder with a user's files."""
    for name in OWN:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("raise ImportError('a file of the user')\n")
    installed = folder / "site"
    for wheel in wheels:
        zipfile.ZipFile(wheel).extractall(installed)
    (folder / "main.py").write_text(program)
    path = os.pathsep.join([str(installed), sysconfig.get_paths()["purelib"]])
    return subprocess.run(
        [sys.executable, "-S", "main.py"],  # -S: without the links to this checkout
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    ).stdout


@pytest.mark.slow
def test_wheels_have_names_of_their_own(wheels: dict[str, Path]):
    """Each holds one package, whose name nobody else has, with its data files."""
    tops = {
        name: {entry.partition("/")[0] for entry in zipfile.ZipFile(path).namelist()}
        for name, path in wheels.items()
    }
    assert {name: {t for t in found if "dist-info" not in t} for name, found in tops.items()} == {
        "palpate": {"palpate"},
        "palpate_train": {"palpate_train"},
        "palpate_client": {"palpate"},
    }
    names = zipfile.ZipFile(wheels["palpate"]).namelist()
    held = ("default_bundle/model.onnx", "default_bundle/manifest.json", "web/page/watch.html")
    assert {f"palpate/{name}" for name in held} <= set(names)
    assert any(n.endswith("licenses/LICENSE") for n in names)
    folder = ROOT / "train" / "palpate_train" / "reports" / "templates"
    templates = {f"palpate_train/reports/templates/{path.name}" for path in folder.iterdir()}
    assert (
        0
        < len(templates & {*zipfile.ZipFile(wheels["palpate_train"]).namelist()})
        == len(templates)
    )


@pytest.mark.slow
def test_box_and_desktop_beside_files_of_the_user(wheels: dict[str, Path], tmp_path: Path):
    """A tiny set is fitted without PyTorch's stages, and answered."""
    uses_both = dedent("""
    import numpy as np, palpate
    from palpate_train import PalpateClassifier
    x = np.random.default_rng(0).integers(900, 1100, (24, 100, 4, 4)).astype(np.uint16)
    y = np.repeat(["cork", "felt"], 12)
    x[:12, ::4] += 300
    model = PalpateClassifier(rate_hz=100.0, steps=0, size="64").fit(x, y)
    print(palpate.__file__, *sorted(set(map(str, model.predict(x)))))
    """)
    told = run([wheels["palpate"], wheels["palpate_train"]], uses_both, tmp_path)
    assert told.startswith(str(tmp_path))
    assert told.endswith("cork felt\n")


@pytest.mark.slow
@pytest.mark.thorough  # installs five libraries
def test_the_box_in_a_clean_environment(wheels: dict[str, Path], tmp_path: Path):
    """Locked dependencies and the wheel alone: `palpate check` on the rig says ok."""
    python = tmp_path / "venv" / "bin" / "python"
    pip = (python, "-m", "pip", "install", "-q", "--disable-pip-version-check")
    for command in (
        (sys.executable, "-m", "venv", tmp_path / "venv"),
        (*pip, "--require-hashes", "-r", ROOT / "appliance" / "requirements.lock"),
        (*pip, "--no-deps", wheels["palpate"]),
    ):
        subprocess.run(command, check=True, cwd=tmp_path, timeout=600)
    check = [python.with_name("palpate"), "check", "--sim", "skin", "--virtual"]
    out = subprocess.run(check, check=True, capture_output=True, text=True, timeout=600).stdout
    assert out.count("ok  ") == 5


@pytest.mark.slow
def test_the_client_alone(wheels: dict[str, Path], tmp_path: Path):
    """Its wheel suffices, and loads no numpy."""
    uses_client = dedent("""
    import sys
    from palpate.client import answers, box, feed
    from palpate.core.sentences import sentence
    line = sentence("RES", 1, 0.5, "ok", "cork", 0.9, 0.8, 1, 0, 1.2, "b", "sim", 1.0).decode()
    print(answers.__file__, answers.Answer.read(line).label, feed.DEFAULT, "numpy" in sys.modules)
    """)
    told = run([wheels["palpate_client"]], uses_client, tmp_path)
    assert told.startswith(str(tmp_path))
    assert told.endswith("cork /run/palpate/feed.sock False\n")


def test_the_client_holds_what_it_imports():
    """Its list of modules is the client and all that the client imports of the box."""
    project = tomllib.loads(CLIENT.read_text())
    needed, new = set(), {"palpate.client.box", "palpate.client.feed"}
    while new:
        needed |= new
        files = [ROOT / "appliance" / f"{name.replace('.', '/')}.py" for name in new]
        found = {
            name
            for file in files
            for node in ast.walk(ast.parse(file.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module.startswith("palpate.")
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        }
        is_file = {n for n in found if (ROOT / "appliance" / f"{n.replace('.', '/')}.py").is_file()}
        new = is_file - needed
    assert set(project["tool"]["setuptools"]["py-modules"]) == needed
    assert project["project"]["version"] == __version__

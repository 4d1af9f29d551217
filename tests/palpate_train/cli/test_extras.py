"""palpate-train without its extras, and the messages about them."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from textwrap import dedent

import pytest

from palpate_train.data import extras
from tests.factories.paths import ROOT


@pytest.mark.slow
def test_a_fit_without_stages_needs_no_extra(tmp_path: Path):
    """Fit, export, score and evaluate; a report says which extra it wants, and leaves nothing."""
    # The exit codes of commands of palpate-train where no library of an extra can be imported
    bare = dedent("""
    import json, sys
    class Without:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in ("torch", "matplotlib", "jinja2", "aeon"):
                raise ModuleNotFoundError(f"no {name}", name=name)
    sys.meta_path.insert(0, Without())
    from palpate_train.cli.main import main
    print([main(words) for words in json.loads(sys.argv[1])])
    """)
    made, out = str(tmp_path / "fit.npz"), str(tmp_path / "bundle")
    sets = ("--set", "sim:T-REAL/level-blind:1:2", "--only", "position<=3")
    commands = [
        ["fit", *sets, "--seed", "1", "--size", "bands", "--out", made],
        ["export", made, "--out", out, "--name", "x", "--version", "1"],
        ["score", out, *sets],
        ["report", out, *sets, "--out", str(tmp_path / "r.html")],
    ]
    command = [sys.executable, "-c", bare, json.dumps(commands)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.splitlines()[-1:] == ["[0, 0, 0, 65]"], done.stderr
    assert "palpate-train[reports]" in done.stderr
    assert not (tmp_path / "r.html").exists()


@pytest.mark.slow
def test_each_extra_that_a_message_names_exists():
    """In both packages; so do those of the helper's table."""

    def messages(folder: Path) -> str:
        """All texts of the modules in a folder."""
        trees = (ast.parse(path.read_bytes()) for path in folder.rglob("*.py"))
        nodes = (
            node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)
        )
        return "\n".join(node.value for node in nodes if isinstance(node.value, str))

    projects = {"palpate": ROOT, "palpate-train": ROOT / "train"}
    known = {
        name: set(tomllib.loads((folder / "pyproject.toml").read_text())["project"].get(key, ()))
        for name, folder in projects.items()
        for key in ("optional-dependencies",)
    }
    texts = messages(ROOT / "appliance" / "palpate") + messages(ROOT / "train" / "palpate_train")
    named = set(re.findall(r"\b(palpate(?:-train)?)\[([a-z]+)\]", texts))
    assert ("palpate", "page") in named
    assert {(name, extra) for name, extra in named if extra not in known[name]} == set()
    assert set(extras.EXTRAS.values()) <= known["palpate-train"]


def test_a_missing_library_is_told_with_its_extra():
    """Any other error stays the same."""
    told = pytest.raises(extras.FormatError, match=r"torch.*\[stages\]")
    with told, extras.needed_for("the cluster"):
        raise ModuleNotFoundError("no torch", name="torch.nn")
    with pytest.raises(ModuleNotFoundError), extras.needed_for("the cluster"):
        raise ModuleNotFoundError("none", name="elsewhere")

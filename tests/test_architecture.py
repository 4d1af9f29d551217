"""Imports, and the form of modules, tests and texts; `make lint` has the contracts of imports."""

import ast
import functools
import gc
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from palpate_train.models import methods
from tests.factories.paths import ROOT

SOURCES = sorted(
    [*ROOT.glob("appliance/**/*.py"), *ROOT.glob("train/**/*.py"), *ROOT.glob("systemd/*.py")]
)
TESTS = sorted(ROOT.glob("tests/**/*.py"))
TEST_FILES = [path for path in TESTS if path.name.startswith("test_")]
BOX = [
    p for p in SOURCES if p.is_relative_to(ROOT / "appliance" / "palpate") and "sim" not in p.parts
]
PACKAGES = {
    path.name: path
    for path in (
        ROOT / "appliance" / "palpate",
        ROOT / "train" / "palpate_train",
        ROOT / "train" / "studies" / "palpate_studies",
    )
}
"""Folders of the packages by their import names."""
ALLOWED = {"palpate", "numpy", "onnxruntime", "usb", "gpiod", "serial", "_sha2", "_sha256"}
"""What the box may import; the last two are Python's own, from 3.12 on and before."""
EXTRAS = {
    "web": {"tornado"},
    "bridges/mqtt.py": {"paho"},
    "service/network.py": {"zeroconf", "ifaddr"},
    "bridges/opcua.py": {"asyncua"},
    "bridges/opcua_model.py": {"asyncua"},
    "bridges/opcua_space.py": {"asyncua"},
    "bridges/opcua_security.py": {"asyncua", "cryptography"},
    "bridges/ros.py": {"rclpy", "rcl_interfaces", "diagnostic_msgs", "sensor_msgs", "std_srvs"},
    "bridges/ros_action.py": {"rclpy", "palpate_msgs"},
}
"""What a package or module imports beside that, of an extra; it is loaded for this alone."""


def run(*args: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    """Run a command; its output, or a failure that shows it."""
    done = subprocess.run(
        args, cwd=cwd, env=env, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    """All nodes of a module; the module itself is the first."""
    gc.disable()  # it would look through the nodes of all modules before this one
    try:
        return list(ast.walk(ast.parse(path.read_text())))
    finally:
        gc.enable()


def shown(path: Path) -> str:
    """The path below the root of the project."""
    return str(path.relative_to(ROOT))


def imports(path: Path) -> set[str]:
    """Names of all modules that a file imports; relative ones begin with a dot."""
    found = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add("." * node.level + (node.module or ""))
    return found


def module_imports(*packages: str) -> dict[str, set[str]]:
    """For each module those that it imports, also in functions and type hints."""
    dotted = {}
    for folder in map(PACKAGES.__getitem__, packages):
        for path in folder.glob("**/*.py"):
            name = ".".join(path.relative_to(folder.parent).with_suffix("").parts)
            dotted[name.removesuffix(".__init__")] = path
    found: dict[str, set[str]] = {name: set() for name in dotted}
    for name, path in dotted.items():
        for node in nodes(path):
            if isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):  # `from package import module` names the module
                full = {f"{node.module}.{alias.name}" for alias in node.names}
                found[name] |= {one if one in dotted else str(node.module) for one in full}
    return {name: imported & dotted.keys() - {name} for name, imported in found.items()}


@pytest.mark.slow
def test_no_module_imports_itself_through_others():
    """Type hints and functions included; one that is there would be found."""

    def circles(graph: dict[str, set[str]]) -> list[str]:
        """The modules that reach themselves, with the imports that lead to them."""
        left, kept = {}, graph
        while kept != left:  # a module is in no circle if it imports or serves nothing of the rest
            left, imported = kept, set().union(*kept.values())
            kept = {name: names & left.keys() for name, names in left.items() if name in imported}
            kept = {name: names for name, names in kept.items() if names}
        return [f"{name} -> {', '.join(sorted(names))}" for name, names in sorted(kept.items())]

    graph = module_imports("palpate", "palpate_train", "palpate_studies")
    assert "palpate.core.errors" in graph["palpate.deployment.store"]
    assert circles(graph) == []
    back = graph | {"palpate.core.errors": {"palpate.deployment.store"}}
    assert "palpate.core.errors -> palpate.deployment.store" in circles(back)


@pytest.mark.slow
def test_every_module_of_training_serves_a_command():
    """All of train but the studies is imported for a command of palpate-train, by the library or by
    the program that teaches a box. A
    module that only a study uses is not."""
    graph = module_imports("palpate_train")
    begins = ("palpate_train.cli.", "palpate_train.library.")
    left = ["palpate_train.__main__", "palpate_train.teach.__main__", methods.OWN]
    left += [name for name in graph if name.startswith(begins)]
    found = set()
    while left:
        if (name := left.pop()) not in found:
            found.add(name)
            left += graph[name]
    packages = {path.parent for path in SOURCES}
    root = PACKAGES["palpate_train"].parent
    modules = {name for name in graph if root.joinpath(*name.split(".")) not in packages}
    assert modules - found == set()


@pytest.mark.slow
def test_the_box_imports_five_libraries():
    """And itself by full names; a library of an extra only where that is for."""

    def foreign(path: Path) -> set[str]:
        """The modules that a file of the box imports and may not import."""
        extras = (
            names
            for part, names in EXTRAS.items()
            if path.is_relative_to(ROOT / "appliance" / "palpate" / part)
        )
        allowed = ALLOWED.union(sys.stdlib_module_names, *extras)
        return {name for name in imports(path) if name.split(".")[0] not in allowed}

    assert {shown(path): names for path in BOX if (names := foreign(path))} == {}
    assert foreign(ROOT / "train" / "palpate_train" / "models" / "training.py") >= {"torch"}


@pytest.mark.slow
def test_no_test_imports_another():
    """Code that tests share stands in tests/factories."""
    found = [
        f"{shown(path)} imports {name}"
        for path in TESTS
        for name in imports(path)
        if re.search(r"(^|\.)(test_|conftest)", name)
    ]
    assert found == []


def test_heavy_libraries_are_imported_by_tests_that_run(heavy):
    """Each process collects all tests, so a module of tests imports these in a `Later`."""
    assert heavy == set()


@pytest.mark.slow
def test_a_fresh_process_loads_nothing_of_the_desktop():
    """After a whole virtual run, PyTorch, scikit-learn, scipy and train are not in the process."""
    code = (
        "import sys; from palpate.__main__ import main; "
        "main(['run', '--sim', 'skin', '--virtual', '--sweeps', '1']);"
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'torch', 'sklearn', 'scipy', "
        "'palpate_train', 'onnx', 'pandas'}))"
    )
    assert run(sys.executable, "-c", code, cwd=ROOT).splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("from palpate.__main__ import main; main(['check', '--settings'])", "palpate.sim"),
        ("import palpate.cli.parser", "asyncio palpate.bridges.server"),
        ("import palpate.client.feed", "numpy serial usb onnxruntime"),
    ],
)
def test_what_is_not_needed_is_not_loaded(code, absent):
    """The simulator unless it is named, a bridge for its options, the line for the feed."""
    code += f"; import sys; print({{*{absent.split()}}} & {{*sys.modules}})"
    assert run(sys.executable, "-c", code, cwd=ROOT).splitlines()[-1] == "set()"


def test_onnxruntime_starts_no_thread_of_its_own():
    """Telemetry off: a session that has run leaves the process with one thread."""
    code = (
        "import os; from palpate.bundle import bundle; from palpate.core import clock; "
        "from palpate.inference import classifier; import onnxruntime;"
        "box = classifier.Classifier(bundle.load(bundle.DEFAULT), clock.SystemClock()); "
        "box.self_test();"
        "print(len(os.listdir('/proc/self/task')))"
    )
    env = {k: v for k, v in os.environ.items() if not k.startswith("ORT_")} | {
        "OPENBLAS_NUM_THREADS": "1"
    }
    assert run(sys.executable, "-c", code, cwd=ROOT, env=env).splitlines()[-1] == "1"


@pytest.mark.slow
def test_modules_and_functions_are_short():
    """Modules have at most 500 lines, functions under 40 lines of code."""

    def too_long(path: Path) -> list[str]:
        """The functions of 40 lines and more, without their docstrings."""
        found = []
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                lines = node.end_lineno - body[0].lineno + 1 if body else 0
                if lines >= 40:
                    found.append(f"{shown(path)}: {node.name} has {lines} lines")
        return found

    # Lines of a module, about
    longest = 500
    grounds = [p for p in TESTS if p.parent.name in ("rig", "backends", "fuzz", "cuts")]
    paths = [path for path in [*SOURCES, *grounds] if not path.name.startswith("test_")]
    sizes = {shown(path): len(path.read_text().splitlines()) for path in paths}
    assert {path: lines for path, lines in sizes.items() if lines > longest} == {}
    assert [line for path in paths for line in too_long(path)] == []


def test_no_wall_clock_no_pickle_no_bare_except():
    """Monotonic time only, nothing unpickled, no error swallowed whole."""
    banned = r"\btime\.time\(|datetime|import pickle|allow_pickle=True|except\s*:"
    found = []
    for path in (path for path in BOX if path.name != "wall_clock.py"):
        pattern = banned if path.name == "clock.py" else rf"{banned}|time\.sleep"
        found += [f"{shown(path)}: {m[0]}" for m in re.finditer(pattern, path.read_text())]
    assert found == []


@pytest.mark.slow
def test_dataclasses_with_arrays_are_not_compared_by_value():
    """Each has eq=False: since Python 3.13, comparing two arrays for their truth raises."""
    array = re.compile(r"(?!.*Callable).*\b(NDArray|Array|ndarray)\b")
    compared = re.compile(r"dataclass(?!.*eq=False)")
    found = []
    classes = [(p, n) for p in SOURCES for n in nodes(p) if isinstance(n, ast.ClassDef)]
    for path, node in classes:
        if any(compared.match(ast.unparse(decorator)) for decorator in node.decorator_list):
            fields = [field for field in node.body if isinstance(field, ast.AnnAssign)]
            if any(array.match(ast.unparse(field.annotation)) for field in fields):
                found.append(f"{shown(path)}: {node.name}")
    assert found == []


def test_values_of_the_box_do_not_change():
    """Each dataclass is frozen and takes no other attribute; LeRobot and a cached part want two."""
    # Dataclasses of the box that count or collect; every other one is a value
    changing = {
        *(
            "Agreement",
            "AnswerScore",
            "Context",
            "EdgeCounters",
            "Finger",
            "OpenSweep",
            "Reception",
        ),
        *("Gathering", "SensorCounters", "_Line"),
    }
    written = re.compile(r"(?m)^ *@dataclass\((.*)\)\n *class (\w+)")
    found = {
        name: (name not in changing, True) == ("frozen=True" in how, "slots=True" in how)
        for path in sorted((ROOT / "appliance").rglob("*.py"))
        for how, name in written.findall(path.read_text())
    }
    wrong = {name for name, right in found.items() if not right}
    assert wrong == {"PalpateCameraConfig", "SweepSet"}


def written_tests() -> list[tuple[str, ast.FunctionDef]]:
    """Each test function, after the name of its file."""
    return [
        (f"{shown(path)}: {node.name}", node)
        for path in TEST_FILES
        for node in nodes(path)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]


@pytest.mark.slow
def test_every_test_says_what_it_holds():
    """Each test has a docstring."""
    assert [name for name, test in written_tests() if not ast.get_docstring(test)] == []


@pytest.mark.slow
def test_every_test_asserts():
    """Each asserts, or calls a helper named check_, assert_ or expect_."""

    def asserts(test: ast.FunctionDef) -> bool:
        """Whether a test can fail: assert, pytest.raises, fail, warns, or a checking helper."""
        if any(isinstance(node, ast.Assert) for node in ast.walk(test)):
            return True
        calls = [ast.unparse(node.func) for node in ast.walk(test) if isinstance(node, ast.Call)]
        judges = re.compile(r"(.*\.)?(raises|fail|warns|_?check|_?(check|assert|expect)_\w+)")
        return any(map(judges.fullmatch, calls))

    assert [name for name, test in written_tests() if not asserts(test)] == []


@pytest.mark.slow
def test_no_test_waits_for_a_program_without_a_limit():
    """Each program that a test or a factory runs to its end has a timeout."""

    def endless(node: ast.AST) -> bool:
        """Whether a node runs a program, or waits for its end, without a limit of time."""
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            return False
        if any(keyword.arg in ("timeout", None) for keyword in node.keywords):
            return False
        name = ast.unparse(node.func)
        return node.func.attr == "communicate" or bool(
            re.fullmatch(r"subprocess\.(run|call|check_call|check_output)", name)
        )

    assert endless(ast.parse("subprocess.run(['true'])").body[0].value)
    paths = [p for p in TESTS if p in TEST_FILES or p.parent.name == "factories"]
    found = [
        f"{shown(path)}:{node.lineno}" for path in paths for node in nodes(path) if endless(node)
    ]
    assert found == []


@pytest.mark.slow
def test_each_class_name_stands_once():
    """A class name says which class is meant: none stands in two modules, tests included."""
    found: dict[str, list[str]] = {}
    for path in [*SOURCES, *TESTS]:
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(shown(path))
    assert {name: where for name, where in found.items() if len(where) > 1} == {}


def test_the_desktop_is_installed_without_running_tests(tmp_path: Path):
    """`make desktop` in a fresh checkout installs both commands and starts no test."""
    (tmp_path / "train").mkdir()
    for name in ("Makefile", "pyproject.toml", "train/pyproject.toml"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    for lock in ("appliance/requirements.lock", "systemd/build.lock", "train/desktop.lock"):
        (tmp_path / lock).parent.mkdir(exist_ok=True)
        (tmp_path / lock).touch()
    steps = run("make", "--dry-run", "desktop", cwd=tmp_path)
    assert "install --no-compile --no-build-isolation -e train[stages,reports]\n" in steps
    assert "tools.lock" not in steps  # tests and studies come with make test
    assert "-m pytest" not in steps  # a folder may have its name

"""Change single comparisons, boundaries, and/or/not and constants of the box, and count the changes
that no fast test of the box notices.

`python -m tests.campaigns mutants [--count 500] [--seed 7]` draws the changes (cosmic-ray) in equal
numbers from PACKAGES, and tries each in a copy of the sources: on the tests that run the changed
statement (coverage), or those of its package where it runs only at import. It goes on where it was
stopped: build/mutants/SEED.jsonl has a line for each change. Remove the folder to begin with other
sources.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from palpate.core.statistics import wilson
from tests.factories.paths import ROOT

if TYPE_CHECKING:
    from coverage import CoverageData

WORK = ROOT / "build" / "mutants"
TOOLS, TREE = WORK / "tools", WORK / "tree"
BOX, TESTS = "appliance/palpate", "tests/palpate"
PACKAGES = ("core", "io", "answer", "inference", "sweeps", "deployment")
OPERATORS = re.compile(
    r"core/(AddNot|NumberReplacer|Replace(TrueWithFalse|FalseWithTrue|AndWithOr|OrWithAnd)"
    r"|ReplaceUnaryOperator_Delete_Not|ReplaceBinaryOperator_(Add_Sub|Sub_Add)"
    r"|ReplaceComparisonOperator_(Is|IsNot)_(Is|IsNot)"
    r"|ReplaceComparisonOperator_(Eq|NotEq|Lt|LtE|Gt|GtE)_(Eq|NotEq|Lt|LtE|Gt|GtE))"
)
FAST = ("-q", "-p", "no:cacheprovider", "-m", "not slow and not thorough")
PYTEST = f"import sys, pytest; sys.path.append({str(TOOLS)!r}); sys.exit(pytest.main())"
COVER = ("-p", "pytest_cov", f"--cov={BOX}", "--cov-context=test", "--cov-report=")
TIMES = ("-o", "junit_family=xunit1", "--junit-xml=tests.xml")
Tests = dict[str, float]


def drawn(package: str, count: int, seed: int) -> Iterator[tuple[str, str, str]]:
    """Changes of a package: name, file and changed source; a place counts once."""
    from cosmic_ray import plugins
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code

    names = sorted(filter(OPERATORS.fullmatch, plugins.operator_names()))
    places: dict[tuple[str, Any], list[tuple[str, int]]] = {}
    for path in sorted(TREE.glob(f"{BOX}/{package}/**/*.py")):
        nodes = [*ast_nodes(get_ast(path.read_text()))]
        for name in names:
            spans = [s for n in nodes for s in plugins.get_operator(name)().mutation_positions(n)]
            for i, span in enumerate(spans):
                places.setdefault((str(path.relative_to(TREE)), span), []).append((name, i))
    chance = random.Random(f"{seed} {package}")
    for file, span in chance.sample(sorted(places), min(count, len(places))):
        name, i = chance.choice(places[file, span])
        changed = mutate_code((TREE / file).read_text(), plugins.get_operator(name)(), i)
        yield f"{file}:{span[0][0]}:{span[0][1]} {name[5:]}", file, changed


def observed() -> tuple[Tests, CoverageData]:
    """The seconds of each test that passes without a change, and the tests of each line."""
    from coverage import CoverageData

    if not (TREE / "tests.xml").exists():
        print("running the fast tests of the box once, to see which lines each runs", flush=True)
        shutil.rmtree(TREE, ignore_errors=True)
        for name in subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, TREE / name)
        ran(*COVER, *TIMES, TESTS)
    cases = ElementTree.parse(TREE / "tests.xml").iter("testcase")
    lines = CoverageData(str(TREE / ".coverage"))
    lines.read()
    return {
        f"{c.get('file')}::{c.get('name')}": float(c.get("time")) for c in cases if not len(c)
    }, lines


def tests_of(file: str, line: int, seconds: Tests, lines: CoverageData) -> list[str]:
    """The tests that run a statement, fastest first; those of its package if none does."""
    first = last = line
    for node in ast.walk(ast.parse((TREE / file).read_text())):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0):
            body = getattr(node, "body", None)
            first, last = node.lineno, body[0].lineno - 1 if body else node.end_lineno or line
    each = lines.contexts_by_lineno(str(TREE / file))
    names = {c.split("|")[0] for n in range(first, max(last, line) + 1) for c in each.get(n, ())}
    own = f"{TESTS}/{file.removeprefix(BOX).split('/')[1]}/"
    known = names & seconds.keys() or {name for name in seconds if name.startswith(own)}
    return sorted(known, key=seconds.__getitem__) or [TESTS]


def tried(file: str, changed: str, tests: list[str]) -> str:
    """Whether the change is `killed`, has `survived`, or ran into a `timeout`."""
    path, listed = TREE / file, WORK / "tests.txt"
    before = path.read_text()
    listed.write_text("\n".join(tests))
    path.write_text(changed)
    try:
        code = ran("-x", "--timeout=60", f"@{listed}", timeout=1800)
        return "killed" if code else "survived"
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        path.write_text(before)


def ran(*options: str, timeout: float | None = None) -> int:
    """The exit code of pytest in the copy."""
    command = (sys.executable, "-c", PYTEST, *FAST, *options)
    sources = ":".join(str(TREE / part) for part in ("appliance", "train", "train/studies"))
    env = os.environ | {"PYTHONPATH": sources, "PYTHONDONTWRITEBYTECODE": "1"}
    with (WORK / "pytest.log").open("w") as log:
        return subprocess.run(
            command, cwd=TREE, env=env, stdout=log, stderr=log, check=False, timeout=timeout
        ).returncode


def main(arguments: Sequence[str] | None = None) -> None:
    """Try the changes that have no line yet, and print the share of each package that survived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args(arguments)
    sys.path.append(str(TOOLS))
    kept, each = WORK / f"{args.seed}.jsonl", args.count // len(PACKAGES)
    seconds, lines = observed()
    done = dict(map(json.loads, kept.read_text().splitlines())) if kept.exists() else {}
    changes = [(p, *change) for p in PACKAGES for change in drawn(p, each, args.seed)]
    for number, (_, name, file, changed) in enumerate(changes, 1):
        if name not in done:
            done[name] = tried(
                file, changed, tests_of(file, int(name.split(":")[1]), seconds, lines)
            )
            with kept.open("a") as f:
                f.write(json.dumps([name, done[name]]) + "\n")
            print(f"{number} of {len(changes)}: {name} {done[name]}", flush=True)
    for package in PACKAGES:
        ends = Counter(done[name] for p, name, *_ in changes if p == package)
        low, high = wilson(ends["survived"], ends.total())
        print(f"{package}: {dict(ends)}, survived [{low:.1%} to {high:.1%}]")


if __name__ == "__main__":
    main()

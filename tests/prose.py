"""`python -m tests.prose`: the share of clauses that a reader has to read twice, by package.

A clause counts if it matches one of SYMPTOMS. Docstrings and comments of Python files count, and
the text of Markdown files outside of code. In codebases of this field the share is 0.1 to 1.0 %.

Each package has a ceiling in prose_ceilings.toml; `make lint` fails if a package exceeds it. After
rewriting prose, `python -m tests.prose --lower` sets every ceiling to the measured share where that
is lower. A ceiling never rises: rewrite the clause instead. A match is a symptom; the cure is a
plain sentence with its subject first, a noun instead of "what ...", the noun again instead of
"one", "is not a" instead of "is no", and one thought.
"""

import argparse
import ast
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.factories.paths import ROOT

FOLDERS = ("appliance", "train", "systemd", "firmware_config", "tests", "docs")
PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
DEPTH = 2
"""Folders in the name of a package."""
CEILING = 1.0
"""Highest share of the clauses of a package, in %."""
SYMPTOMS = re.compile(
    r"\b[Ww]hat (?:is|are|was|were|a|an|the|it|they|one|each|no|of|comes?|goes|has|have|had|holds?"
    r"|does|ends?|needs?|can|may|must|stands?|[a-z]+s)\b"
    r"|\b(?:that|this|the|which|each|no|another|other|smaller|usual|new|old) ones?\b"
    r"|\b(?:is|are|was|were) no (?!longer|more\b)\w+"
    r"|\b(?:is|are|was|were|be) told\b|\btells? of\b|\b[Ww]hoever\b|\ball the same\b|\bnone the\b"
    r"|(?:^|[.:;] )(?:Chosen|Simulated|Trained|Kept|Tested|Drawn|Taken|Told|Of [a-z ]+ (?:is|are))"
    r" (?:is|are|was|were)\b"
    r"|\bbut for\b|\bnot [a-z ]+ but\b|\bin place of\b|\bof which\b|\bfor which\b"
)
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(slots=True)
class Count:
    """The clauses of a package."""

    clauses: int = 0
    matches: list[str] = field(default_factory=list)
    """Clauses that match, each after its file."""

    @property
    def percent(self) -> float:
        """Share of the clauses that match, rounded up to a tenth of a percent."""
        return math.ceil(1000 * len(self.matches) / max(1, self.clauses)) / 10


def texts(path: Path) -> list[str]:
    """Docstrings and comment lines of a Python file; the text of a Markdown file without code."""
    source = path.read_text(encoding="utf-8", errors="replace")
    if path.suffix == ".md":
        return [re.sub(r"(?s)```.*?```|<!--.*?-->", "", source)]
    nodes = (node for node in ast.walk(ast.parse(source)) if isinstance(node, DOCUMENTED))
    comments = (line for line in source.splitlines() if line.lstrip().startswith("# "))
    return [
        *filter(None, map(ast.get_docstring, nodes)),
        *(line.split("#", 1)[1] for line in comments),
    ]


def clauses(text: str) -> list[str]:
    """The clauses of more than three words."""
    parts = re.split(r"(?<=[.!?;:])\s+", re.sub(r"\s+", " ", text))
    return [part for part in parts if len(part.split()) > 3]


def files(root: Path = ROOT) -> Iterator[tuple[str, Path]]:
    """Each file that is counted, after the name of its package."""
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*")):
            if path.suffix in (".py", ".md"):
                yield "/".join(path.relative_to(root).parts[:-1][:DEPTH]), path
    yield from ((page, root / page) for page in PAGES if (root / page).exists())


def measure(root: Path = ROOT) -> dict[str, Count]:
    """The count of each package."""
    counts: dict[str, Count] = {}
    for package, path in files(root):
        count = counts.setdefault(package, Count())
        for clause in (clause for text in texts(path) for clause in clauses(text)):
            count.clauses += 1
            if SYMPTOMS.search(clause):
                count.matches.append(f"{path.relative_to(root)}: {clause}")
    return counts


def exceeded(counts: Mapping[str, Count]) -> list[str]:
    """A line for each package that exceeds CEILING."""
    return [
        f"{package}: {count.percent} % of {count.clauses} clauses have to be read twice;"
        f" at most {CEILING} % may"
        for package, count in counts.items()
        if count.percent > CEILING
    ]


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    """Check or list; 1 if a package exceeds the ceiling."""
    parser = argparse.ArgumentParser(prog="python -m tests.prose", description=__doc__)
    parser.add_argument("packages", nargs="*", help="packages to list, or starts of paths")
    args = parser.parse_args(arguments)
    counts = measure(root)
    if args.packages:
        found = [line for count in counts.values() for line in count.matches]
        print(*(line for line in found if line.startswith(tuple(args.packages))), sep="\n")
        return 0
    too_many = exceeded(counts)
    for line in too_many:
        print(f"{line}: python -m tests.prose {line.partition(':')[0]} lists them", file=sys.stderr)
    clauses_in_all = sum(count.clauses for count in counts.values())
    matches = sum(len(count.matches) for count in counts.values())
    print(f"prose: {matches} of {clauses_in_all} clauses have to be read twice")
    return int(bool(too_many))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

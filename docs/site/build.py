"""Builds the site: `PYTHONPATH=systemd python docs/site/build.py build` (make site).

Copies README, CHANGELOG, CONTRIBUTING and all pages below docs/ and firmware_config/ into
build/site-src, with the files that they link to, and writes the references from the code. README
becomes the first page. The studies write their result pages into build/site-src/results. Sphinx
then makes build/site, with warnings as errors. Last, every link of every HTML page is followed.
Each broken link is printed, and the exit code is 1.
"""

from __future__ import annotations

import inspect
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import manual
import palpate_train.library
from manual import BOX_PAGES, ROOT
from palpate_train.cli.main import PROGRAM

HERE = Path(__file__).resolve().parent

LINK = re.compile(r"(!?\[[^\]]*\]\()([^)#\s]+)((?:#[^)\s]*)?\))")
RESULTS = "results.md"
RESULT_PAGES = {
    "development": "Speed against accuracy: our methods and their peers",
    "paper": "The paper's experiment, run again (simulated)",
    "stress-fabrics": "Robustness: accuracy on corrupted sweeps of recorded fabrics",
    "stress": "Robustness: accuracy on corrupted sweeps (simulated)",
    "certainty": "Calibration, unknown materials, early answers (simulated)",
}
"""Pages of studies, by their folders, the most telling first."""
REFERENCE = re.compile(r'(?:href|src)="([^"]+)"')
CODE = re.compile(r"(?s)```.*?```|`[^`\n]*`")
CHAPTERS = {
    "Tutorials": [
        "docs/tutorials/first-model",
        "docs/tutorials/first-day",
        "docs/tutorials/library",
    ],
    "How-to": [
        "docs/how-to/*",
        "docs/robots/README",
        "docs/robots/*",
        "docs/board-checklist",
    ],
    "Reference": ["docs/reference/*", "firmware_config/PROTOCOL", "firmware_config/*/README"],
    "Explanation": [
        "docs/explanation/*",
        "docs/recipe",
        "docs/architecture",
        "docs/security",
        "docs/skins",
        "docs/faults",
    ],
    "Results": ["results", "docs/data/README", "docs/*/README"],
    "Project": [
        "CHANGELOG",
        "CONTRIBUTING",
        "docs/decisions/README",
        "docs/decisions/*",
    ],
}
"""Captions of the contents, and their pages, without .md. Pages of one pattern are in the order of
the manual for the box, then by name."""


def main() -> int:
    """Build all; the exit code."""
    build = Path(sys.argv[1])
    sources, site = build / "site-src", build / "site"
    for folder in (sources, site):
        shutil.rmtree(folder, ignore_errors=True)
    results(sources)
    lost = gather(sources)
    if not lost:
        command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-j", "auto"]
        command += ["-b", "html", "-d", str(build / "site-cache"), "-c", str(HERE)]
        if code := subprocess.run([*command, sources, site], check=False).returncode:
            return code
        for page in sources.rglob("*.html"):
            take_over(page.relative_to(sources), sources, site)
        lost = broken(site)
    print(*lost, sep="\n", end="\n" * bool(lost))
    return bool(lost)


def gather(out: Path) -> list[str]:
    """Write the sources of all pages into `out`; links that lead nowhere."""
    made = {"training-commands": training_commands(), "library": library()}
    known = manual.references() | made | tables()
    lost: list[str] = []
    names = sorted(pages())
    listed = names + [RESULTS] * (out / RESULTS).exists()
    for name in names:
        text = manual.filled((ROOT / name).read_text("utf-8"), known)
        target = out / ("index.md" if name == "README.md" else name)
        target.parent.mkdir(parents=True, exist_ok=True)
        text = linked(Path(name), text, out, lost)
        target.write_text(text + contents(listed) * (name == "README.md"), "utf-8")
    return lost


def tables() -> dict[str, str]:
    """Tables of files below docs/data, by their markers."""
    held: dict[str, dict[str, Any]] = {}
    for name in ("known-libraries", "processors"):
        found = tomllib.loads((ROOT / "docs" / "data" / f"{name}.toml").read_text("utf-8"))
        held |= {name: found} if "rows" in found else found
    return {name: table(**one) for name, one in held.items()}


def table(columns: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def results(out: Path) -> None:
    """Draw the pages of results into `out`/results, and list them on a page."""
    pages = (out / "results").absolute()
    command: list[str | Path] = [sys.executable, "-m", "palpate_studies", "pages", "--out", pages]
    subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    names = [page.parent.name for page in sorted(pages.glob("*/index.html"))]
    links = [
        f'- <a href="results/{name}/index.html">{RESULT_PAGES.get(name, name)}</a>'
        for name in sorted(names, key=[*RESULT_PAGES, *names].index)
    ]
    text = ["# Result pages", "", "The studies draw these pages from their results.", "", *links]
    (out / RESULTS).write_text("\n".join([*text, ""]), "utf-8")


def take_over(page: Path, sources: Path, site: Path) -> None:
    """Copy a page of results into the site with the files that it links to. Its links to Markdown
    lead to the pages that Sphinx has made of it."""
    text = (sources / page).read_text("utf-8")
    text = re.sub(r'href="((?:\.\./)+)README\.md"', r'href="\1index.html"', text)
    text = re.sub(r'href="(?![a-z]+:)([^"#]+)\.md(#[^"]*)?"', r'href="\1.html\2"', text)
    (site / page).parent.mkdir(parents=True, exist_ok=True)
    (site / page).write_text(text, "utf-8")
    for target in filter(None, map(local, REFERENCE.findall(text))):
        for root in (sources, ROOT):
            if (file := root / page.parent / target).is_file() and file.suffix != ".html":
                shutil.copyfile(file, site / page.parent / target)


def local(target: str) -> str:
    """The relative path of a link, or "" where it leads out of the site or into its own page."""
    return "" if re.match(r"[a-z]+:|//|#", target) else unquote(re.split(r"[#?]", target)[0])


def broken(site: Path) -> list[str]:
    """Each relative link or picture of an HTML page of the site that is not there."""
    lost = []
    for page in sorted(site.rglob("*.html")):
        for target in filter(None, map(local, REFERENCE.findall(page.read_text("utf-8")))):
            if not (page.parent / target).exists():
                lost.append(f"{page.relative_to(site)}: {target} is not in the site")
    return lost


def pages() -> Iterator[str]:
    """Paths of all pages from ROOT."""
    for pattern in ("*.md", "docs/**/*.md", "firmware_config/**/*.md"):
        yield from (str(path.relative_to(ROOT)) for path in ROOT.glob(pattern))


def training_commands() -> str:
    """The reference of `palpate-train`."""
    return manual.command_sections(list(manual.leaves(PROGRAM.parser(*PROGRAM.commands))), "##")


def library() -> str:
    """The reference of the library: each public name with its docstring and its members."""
    return "\n\n".join(
        _entry(name, getattr(palpate_train.library, name)) for name in palpate_train.library.__all__
    )


def _entry(name: str, what: Any) -> str:
    """A class with its own public members, or a function."""
    text = f"## {name}\n\n    {name}{_parameters(what)}\n\n{inspect.getdoc(what)}"
    if not inspect.isclass(what):
        return text
    for member, value in vars(what).items():
        function = value.fget if isinstance(value, property) else value
        if not member.startswith("_") and inspect.isfunction(function):
            form = "" if isinstance(value, property) else _parameters(function)
            text += f"\n\n### {name}.{member}\n\n    {member}{form}"
            text += f"\n\n{inspect.getdoc(function)}"
    return text


def _parameters(function: Any) -> str:
    """The parameters in brackets, without `self` and types."""
    found = inspect.signature(function).parameters.values()
    kept = [one.replace(annotation=one.empty) for one in found if one.name != "self"]
    return str(inspect.Signature(kept))


def linked(page: Path, text: str, out: Path, lost: list[str]) -> str:
    """The text with its links checked. Linked files are copied as well, and README's page is
    `index`. Links that lead nowhere are added to `lost`."""

    def follow(found: re.Match[str]) -> str:
        begin, target, end = found.groups()
        if re.match(r"[a-z]+:", target):
            return found[0]
        path = (ROOT / page.parent / target).resolve()
        if not (path.is_file() and path.is_relative_to(ROOT)):
            lost.append(f"{page}: {target} is not a file of this project; mend the link")
            return found[0]
        name = path.relative_to(ROOT)
        if name == Path("README.md"):
            return f"{begin}{target.removesuffix('README.md')}index.md{end}"
        if path.suffix != ".md":
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / name)
        if path.suffix == ".html":
            return f'<a href="{target}">{begin.lstrip("!").strip("[](")}</a>'
        return found[0]

    kept = CODE.findall(text)
    plain = LINK.sub(follow, CODE.sub("\0", text))
    return re.sub("\0", lambda _: kept.pop(0), plain)


def contents(names: list[str]) -> str:
    """The contents of the site, for the margin: each page once, in the first chapter that has
    it."""
    taken: set[str] = {"README.md"}
    text = "\n"
    for caption, patterns in CHAPTERS.items():
        listed: list[str] = []
        for pattern in patterns:
            fits = re.compile(f"{pattern}.md".replace("*", "[^/]*"))
            found = [name for name in names if fits.fullmatch(name) and name not in taken]
            listed += sorted(found, key=_order)
            taken.update(found)
        lines = "\n".join(name.removesuffix(".md") for name in listed)
        text += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{lines}\n```\n"
    return text


def _order(name: str) -> tuple[int, str]:
    """For pages of one pattern: README first, then the order of the manual for the box."""
    if name.endswith("README.md"):
        return -1, name
    below = name.removeprefix("docs/")
    return (BOX_PAGES.index(below) if below in BOX_PAGES else len(BOX_PAGES)), name


if __name__ == "__main__":
    sys.exit(main())

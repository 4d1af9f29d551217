"""`python -m tests.campaigns.skins way|noise|load|page [SKIN ...]`: measures emulated skins, for
docs/data/skins.json and the tables of docs/skins.md.

way: record, describe, fit, export and run with each skin. noise: wrong frames on a bad cable. load:
share of a core, lost frames and time to the answer, with the bundles of `way`. Without an argument
all of them, then the page.
"""

import argparse
import json
import sys
from dataclasses import asdict
from shutil import rmtree
from typing import Any

from palpate.core.provenance import commit
from palpate_train.metrics import score
from tests.campaigns.skins import load, noise, page, way
from tests.campaigns.skins.subjects import NAMES, subject
from tests.factories.paths import ROOT

WORK = ROOT / "build" / "skins"
RESULTS = ROOT / "docs" / "data" / "skins.json"
FAULTS = 10_000
PARTS = ("way", "noise", "load")


def measured(part: str, name: str, seconds: float) -> dict[str, Any]:
    """The results of a part for a skin."""
    if part == "noise":
        return {
            fault.__name__: asdict(noise.count(subject(name), fault, FAULTS))
            for fault in noise.FAULTS
        }
    if part == "load":
        return load.measure(name, WORK / name / "bundle", seconds)
    rmtree(WORK / name, ignore_errors=True)
    (WORK / name).mkdir(parents=True)
    return {"shipped": score.shipped(), **way.go(name, WORK / name)}


def main() -> int:
    """Run the parts, and write their results beside earlier results of the others."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.skins", description=__doc__)
    parser.add_argument("part", nargs="?", choices=[*PARTS, "page"], help="all by default")
    parser.add_argument(
        "skins", nargs="*", metavar="SKIN", help=f"from {', '.join(NAMES)}; all by default"
    )
    parser.add_argument(
        "--seconds", type=float, default=600, help="of `load` for each skin (%(default)s)"
    )
    args = parser.parse_args()
    if wrong := set(args.skins) - set(NAMES):
        parser.error(f"no skin {', '.join(sorted(wrong))}; there are {', '.join(NAMES)}")
    for part in [part for part in PARTS if args.part in (None, part)]:
        for name in args.skins or NAMES:
            found = measured(part, name, args.seconds)
            print(part, name, json.dumps(found), flush=True)
            _keep(part, name, found)
    page.write(ROOT / "docs" / "skins.md", json.loads(RESULTS.read_text("utf-8")))
    return 0


def _keep(part: str, name: str, found: dict[str, Any]) -> None:
    results: dict[str, Any] = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    results.setdefault(part, {})[name] = {"commit": commit(), **found}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    sys.exit(main())

"""`python -m palpate_studies`: experiments and their pages."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from palpate_train.arguments.program import Program

PROGRAM = Program(
    "python -m palpate_studies",
    "Experiments with the methods of Palpate, and the pages that publish their results.",
    "palpate_studies.commands",
    {
        "paper": ("experiments", "run the paper's experiment on the simulated skin"),
        "development": ("experiments", "evaluate methods on all development sets"),
        "fabrics": (
            "experiments",
            "evaluate methods on real fabrics, one condition left out at a time",
        ),
        "shots": (
            "experiments",
            "evaluate methods on real fabrics with few sweeps of each material",
        ),
        "recipe": (
            "experiments",
            "measure the cost of each view of the recipe, and which views sets ask for",
        ),
        "stress": (
            "measure",
            "test trained methods, and a bundle, on corrupted sweeps, one corruption at a time",
        ),
        "certainty": (
            "measure",
            "measure how far a model's probabilities can be trusted: calibration, "
            "unknown materials",
        ),
        "alignment": (
            "measure",
            "measure whether a displaced contact is flagged before accuracy is lost (simulated)",
        ),
        "rules": (
            "measure",
            "measure what each rule of the answer buys and costs: a bundle without it (simulated)",
        ),
        "reports": ("publish", "make the project's results again: the stale ones, or some by name"),
        "pages": ("publish", "draw the pages of results, with their pictures"),
        "tables": (
            "publish",
            "write tables and the chart of results into README and written pages",
        ),
        "overview": (
            "publish",
            "draw the README's picture: a simulated sweep and the box's answers",
        ),
    },
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one study; its exit code."""
    return PROGRAM.run(argv)


if __name__ == "__main__":
    sys.exit(main())

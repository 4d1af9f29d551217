"""The command `palpate-train`."""

from __future__ import annotations

from collections.abc import Sequence

from palpate_train.arguments.program import Program

PROGRAM = Program(
    "palpate-train",
    "Trains, judges and exports the models of Palpate.",
    "palpate_train.cli",
    {
        "sets": ("sets", "list the sweep sets that can be named, describe sets, or show a sweep"),
        "pull": ("sets", "fetch new recordings from a box"),
        "import": (
            "importing",
            "make a sweep set of CSV, text, MAT, HDF5 and .npy files (docs/how-to/import.md)",
        ),
        "fit": ("fit", "choose a model and fit it to sweep sets, or train another method"),
        "evaluate": (
            "evaluation",
            "train and test methods under a protocol; --list shows the methods",
        ),
        "export": ("bundles", "quantize a fit, measure what it tolerates, and pack its bundle"),
        "score": (
            "bundles",
            "run a set through the box's classifier with a bundle, and print the answers",
        ),
        "report": (
            "report",
            "write a page about a bundle: its answers to a set, its limits, its cost",
        ),
        "sign": ("signing", "sign a bundle, so that boxes take it"),
    },
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code."""
    return PROGRAM.run(argv)

"""The command `palpate-train`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from palpate_train.arguments.runner import Program

PROGRAM = Program(
    "palpate-train",
    "Trains, judges and exports the models of Palpate.",
    "palpate_train.cli",
    {
        "sweep sets": {
            "sets": "list the sweep sets that can be named, describe sets, or show a sweep",
            "pull": "fetch new recordings from a box",
            "import": (
                "make a sweep set of CSV, text, MAT, HDF5 and .npy files (docs/how-to/import.md)"
            ),
        },
        "models": {
            "fit": "choose a model and fit it to sweep sets",
            "evaluate": "train and test methods under a protocol; --list names the methods",
        },
        "bundles": {
            "export": "quantize a fit and pack its bundle",
            "pack": "train any method and pack its bundle",
            "score": "run a set through the box's classifier with a bundle, and print the answers",
            "bridge": (
                "measure how many broken taxels a bundle tolerates, and write it into its manifest"
            ),
            "widen": "let altered sweeps of a bundle's materials count as known ones",
            "parity": "show what int8 changes in a model's answers, and in each tensor",
            "report": "write a page about a bundle: its answers to a set, its limits, its cost",
            "sign": "sign a bundle, so that boxes take it",
        },
    },
    {
        "sets": ("sets", "pull"),
        "importing": ("import",),
        "fit": ("fit",),
        "bundles": ("export", "pack", "score", "bridge", "widen", "parity"),
        "evaluation": ("evaluate",),
        "report": ("report",),
        "signing": ("sign",),
    },
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code."""
    return PROGRAM.run(argv)


def parser(wanted: str) -> argparse.ArgumentParser:
    """The parser of one command."""
    return PROGRAM.parser(wanted)

"""The whole way with a skin, by the commands that a person types: record, describe, fit, export,
run.

The result is the answers of the last command to sweeps at positions that no recording has.
"""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from palpate.bundle.bundle import load
from palpate.core.statistics import wilson
from palpate.sim import skin

TRAINED, TESTED = range(1, 7), range(101, 105)
"""Seeds of the skin's positions, in recordings and in the last command."""
RECORDED, PLAYED = 6, 30
"""Number of sweeps of a material at a position in recordings; number of sweeps at a position in the
last command."""
LIMIT_S = 600
"""Longest time of a command."""


def box(*arguments: object) -> str:
    """Run `palpate ARGUMENTS`; returns its output."""
    return _command("tests.campaigns.skins.command", *arguments)


def desktop(*arguments: object) -> str:
    """Run `palpate-train ARGUMENTS`; returns its output."""
    return _command("palpate_train", *arguments)


def _command(package: str, *arguments: object) -> str:
    command = [sys.executable, "-m", package, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if done.returncode:
        raise SystemExit(
            f"{' '.join(command[2:])}: exit code {done.returncode}\n{done.stderr.strip()[-800:]}"
        )
    return done.stdout


def go(name: str, folder: Path) -> dict[str, Any]:
    """Record, describe, fit, export and run with the skin `name`; all files are in `folder`."""
    sweeps, fit, bundle = folder / "sweeps", folder / "fit.npz", folder / "bundle"
    chosen = ("--skin", name, "--virtual")
    for seed in TRAINED:
        for material in skin.MATERIALS:
            played = ("--sim", f"skin:{material}", "--seed", seed, "--sweeps", RECORDED)
            labels = ("--material", material, "--position", f"p{seed}")
            box("record", *chosen, *played, *labels, "--out", sweeps)
    desktop("sets", "describe", sweeps)
    desktop("fit", "--set", sweeps, "--seed", 1, "--out", fit)
    desktop("export", fit, "--out", bundle, "--name", name, "--version", 1)
    right = total = lost = 0
    for seed in TESTED:
        played = ("--set", f"classifier.bundle={bundle}", "--seed", seed, "--sweeps", PLAYED)
        text = box("demo", *chosen, *played)
        good, of = map(int, re.findall(r"all sweeps\s+(\d+) / (\d+)", text)[-1])
        right, total = right + good, total + of
        lost += int(re.findall(r"frames lost\s+(\d+)", text)[-1])
    return {
        "skin": name,
        "sweeps": len(TRAINED) * RECORDED * len(skin.MATERIALS),
        "format": str(load(bundle).format),
        "right": right,
        "total": total,
        "lost": lost,
        "interval": [round(v, 4) for v in wilson(right, total)],
        "bundle_kb": round(sum(f.stat().st_size for f in bundle.iterdir()) / 1000, 1),
    }

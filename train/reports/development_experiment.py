"""All methods on all development sets. In: methods, seeds. Out: the figures of the command `development`, as JSON.

One set is never enough to tune on: a recipe that was fitted to one shows here at once on the others. Accuracy comes from
evaluate, whose finished folds are kept: an interrupted command goes on where it was, and `kept` reports what there is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from train.data.sets import Dataset, digest
from train.evaluation import evaluate
from train.evaluation.evaluate import Plan, Where
from train.metrics import score
from train.models import methods
from train.models.methods import FULL_EFFORT, Effort
from train.reports.chart_report import FABRICS, SEVEN, ChartPart, joined

Json = dict[str, Any]
Log = Callable[[str], None]
OURS = ("default", "compact", "filter-bank")
"""What is compared with the peers: the first of them that is there."""
PEERS = ("minirocket", "minirocket-augmented", "multirocket-hydra", "quant", "ds-cnn", "edge-spectral")
EACH = (5, 10, 20)
"""Training sweeps of each material along a learning curve, before all of them."""


@dataclass(frozen=True)
class DevelopmentCase:
    """One set under one protocol. means_removed: each taxel's mean over the window is taken away. curve: with EACH."""

    name: str
    part: ChartPart
    means_removed: bool = True
    curve: bool = False


FOUR = ("material=BeigeCotton,BrownCotton,Canvas,Linen",)


def _fabrics(name: str, protocol: str, only: tuple[str, ...], curve: bool = False) -> DevelopmentCase:
    return DevelopmentCase(name, ChartPart((FABRICS,), protocol, only, real=True), curve=curve)


def _published(name: str) -> DevelopmentCase:
    return DevelopmentCase(f"{name}, published split", ChartPart((f"aeon:{name}",), "split:split=0->1"))


REAL = ChartPart(("sim:T-REAL:1",), "leave:position")
HARD = ChartPart(("sim:T-REAL:1", "sim:T-HARD:1-20"), "split:set=0->1")
CASES = (
    DevelopmentCase("simulated tubes, a position out", REAL, means_removed=False, curve=True),
    DevelopmentCase("simulated tubes, attached anew", HARD, means_removed=False),
    _fabrics("7 fabrics, a force out", "leave:force", SEVEN, curve=True),
    _fabrics("7 fabrics, a speed out", "leave:speed", SEVEN),
    _fabrics("7 fabrics, a repetition out", "leave:rep", SEVEN),
    _fabrics("4 fabrics, a force out", "leave:force", FOUR),
    _fabrics("4 fabrics, a speed out", "leave:speed", FOUR),
    _fabrics("4 fabrics, a direction out", "leave:direction", FOUR),
    *map(_published, ("ACSF1", "OSULeaf", "BasicMotions", "ArrowHead", "GunPoint")),
)
"""In the order of the page; they are run from the last, which is the cheapest."""
QUICK = (
    DevelopmentCase("simulated tubes, a position out",
         ChartPart(("sim:T-REAL:1001:3",), "leave:position", ("position<=2",)), means_removed=False, curve=True),
    DevelopmentCase("simulated tubes, attached anew",
         ChartPart(("sim:T-REAL:1001:3", "sim:T-HARD:1001-1002:2"), "split:set=0->1", ("position<=2",)), means_removed=False),
)  # fmt: skip
QUICK_METHODS = ("compact", "edge-spectral", "L-gauss")
QUICK_EFFORT = Effort(share=0.02)


def usual_methods() -> tuple[str, ...]:
    """OURS and PEERS, as far as they exist."""
    known = methods.every()
    return tuple(name for name in (*OURS, *PEERS) if name in known)


@dataclass
class Development:
    """One run of the command. left_out: what is missing, and why."""

    cases: Sequence[DevelopmentCase]
    names: Sequence[str]
    where: Where
    log: Log
    data: Path | None = None
    effort: Effort = FULL_EFFORT
    seeds: Sequence[int] = (1,)
    left_out: dict[str, str] = field(default_factory=dict)

    def results(self) -> Json:
        """All figures: `cases` with what they were run on, and `results` by case, method and training sweeps."""
        methods.find(self.names)
        cases: list[Json] = []
        found: list[Json] = []
        for number, case in enumerate(reversed(self.cases), 1):
            sweeps = case.part.load(self.data)
            if sweeps is None:
                self.left_out[case.name] = "real sweeps; name their folder with --data or PALPATE_DATA"
                continue
            cases.append(_about(case, sweeps))
            for each in (0, *(EACH if case.curve else ())):
                found += self._evaluated(case, sweeps, each, f"{number}/{len(self.cases)} {case.name}")
        known = {"methods": list(self.names), "seeds": list(self.seeds), "effort": self.effort.share}
        listed = {"cases": cases[::-1], "results": found, "left_out": self.left_out}
        return known | score.provenance() | listed

    def _evaluated(self, case: DevelopmentCase, sweeps: Dataset, each: int, what: str) -> Iterator[Json]:
        """One entry for each method that can take the set and is complete with all seeds that were found."""
        plan = Plan(self.names, (case.part.protocol,), self.seeds, case.means_removed, self.effort, each)
        by_method: dict[str, list[Json]] = {}

        def log(line: str) -> None:
            self.log(f"{what}{f', {each} each' if each else ''}: {line}")

        for result in evaluate.evaluate(sweeps, plan, self.where, log):
            if result.refused:
                self.left_out[f"{result.method}, {case.name}"] = result.refused
            else:
                by_method.setdefault(result.method, []).append(result.json() | {"seed": result.seed})
        for method, results in by_method.items():
            yield {"case": case.name, "each": each, "method": method} | _entry(results)


def _about(case: DevelopmentCase, sweeps: Dataset) -> Json:
    """What a case was run on."""
    return {
        "case": case.name, "set": sweeps.source, "only": list(case.part.only), "protocol": case.part.protocol,
        "means_removed": case.means_removed, "sweeps": len(sweeps), "materials": len(sweeps.materials),
        "format": str(sweeps.format), "digest": digest(sweeps), "curve": case.curve,
    }  # fmt: skip


def _entry(results: Sequence[Json]) -> Json:
    """Accuracy with its interval, and costs, of the results of all seeds; so too of each other precision."""
    seeds = [result["seed"] for result in results]
    forms = {
        name: joined([result["forms"][name] | {"seed": seed} for result, seed in zip(results, seeds, strict=True)])
        for name in results[0].get("forms", {})
    }
    costs = {name: max(float(result[name]) for result in results) for name in ("fit_s", "ms_p50")}
    return joined(results) | costs | {"forms": forms}

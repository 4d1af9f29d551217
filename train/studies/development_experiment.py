"""All methods on all development sets. In: methods, seeds. Out: the figures of the command
`development`, as JSON.

One set is never enough to tune on: a recipe that was fitted to one shows here at once on the
others. Accuracy comes from evaluate, whose finished folds are kept: an interrupted command goes on
where it was, and `kept` reports what there is. The skin that was attached anew (T-HARD) is not
among the sets: the simulator cannot be trusted with it, see decision 10.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from appliance.core.errors import FormatError
from train.data.sets import Dataset, digest
from train.evaluation import evaluate
from train.evaluation.evaluate import Plan, Where
from train.metrics import score
from train.models import methods
from train.models.methods import FULL_EFFORT, Effort
from train.studies.chart_report import FABRICS, SEVEN, ChartPart, joined

Json = dict[str, Any]
Log = Callable[[str], None]
OURS = ("default", "default-reattached", "filter-bank", "compact-50k")
"""No peers; the first of them that is there is compared with the peers."""
PEERS = (
    "minirocket",
    "minirocket-augmented",
    "multirocket-hydra",
    "quant",
    "ds-cnn",
    "lite",
    "edge-spectral",
)
EACH = (5, 10, 20)
"""Points of a learning curve, as far as a set has more sweeps of each material than that."""


@dataclass(frozen=True)
class DevelopmentCase:
    """One set under one protocol. means_removed: each taxel's mean over the window is taken away.
    curve: training sweeps of each material along its learning curve, before all of them."""

    name: str
    part: ChartPart
    means_removed: bool = True
    curve: tuple[int, ...] = ()

    @property
    def simulated(self) -> bool:
        """Whether its sweeps are the simulator's."""
        return any(name.startswith("sim:") for name in self.part.sets)


FOUR = ("material=BeigeCotton,BrownCotton,Canvas,Linen",)


def _fabrics(
    name: str, protocol: str, only: tuple[str, ...], curve: tuple[int, ...] = ()
) -> DevelopmentCase:
    return DevelopmentCase(name, ChartPart((FABRICS,), protocol, only, real=True), curve=curve)


def _published(name: str, curve: tuple[int, ...] = ()) -> DevelopmentCase:
    return DevelopmentCase(
        f"{name}, published split", ChartPart((f"aeon:{name}",), "split:split=0->1"), curve=curve
    )


REAL = ChartPart(("sim:T-REAL:1",), "leave:position")
CASES = (
    _fabrics("7 fabrics, a force out", "leave:force", SEVEN, EACH),
    _fabrics("7 fabrics, a speed out", "leave:speed", SEVEN),
    _fabrics("7 fabrics, a repetition out", "leave:rep", SEVEN),
    _fabrics("4 fabrics, a force out", "leave:force", FOUR),
    _fabrics("4 fabrics, a speed out", "leave:speed", FOUR),
    _fabrics("4 fabrics, a direction out", "leave:direction", FOUR),
    _published("ACSF1", (5,)),
    _published("OSULeaf", (5, 10)),
    _published("BasicMotions", (5,)),
    _published("ArrowHead", (5, 10)),
    _published("GunPoint", EACH),
    DevelopmentCase("simulated tubes, a position out", REAL, means_removed=False, curve=EACH),
)
"""In the order of the page."""
QUICK = (
    _published("GunPoint"),
    DevelopmentCase(
        "simulated tubes, a position out",
        ChartPart(("sim:T-REAL:1001:3",), "leave:position", ("position<=2",)),
        means_removed=False,
        curve=EACH,
    ),
)
QUICK_METHODS = ("compact-50k", "edge-spectral", "L-gauss")
QUICK_EFFORT = Effort(share=0.02)


def usual_methods() -> tuple[str, ...]:
    """OURS and PEERS, as far as they exist."""
    known = methods.every()
    return tuple(name for name in (*OURS, *PEERS) if name in known)


@dataclass
class Development:
    """One run of the command. not_wanted: names of cases, or of points of their curves ("NAME, 5
    each"), that are not run. left_out: what is missing, and why."""

    cases: Sequence[DevelopmentCase]
    names: Sequence[str]
    where: Where
    log: Log
    data: Path | None = None
    effort: Effort = FULL_EFFORT
    seeds: Sequence[int] = (1,)
    not_wanted: Sequence[str] = ()
    left_out: dict[str, str] = field(default_factory=dict)

    def results(self) -> Json:
        """All figures: `cases` with what they were run on, and `results` by case, method and
        training sweeps.

        Raises FormatError for an unknown method, and where what is not wanted does not exist.
        """
        methods.find(self.names)
        self._require_known(self.not_wanted)
        cases: list[Json] = []
        found: list[Json] = []
        for number, case in enumerate(self.cases, 1):
            sweeps = case.part.load(self.data)
            if sweeps is None:
                self.left_out[case.name] = (
                    "real sweeps; name their folder with --data or PALPATE_DATA"
                )
                continue
            cases.append(_about(case, sweeps))
            for each, name in _points(case):
                if name in self.not_wanted or case.name in self.not_wanted:
                    self.left_out[name] = f"not wanted in the run of {', '.join(self.names)}"
                else:
                    found += self._evaluated(
                        case, sweeps, each, f"{number}/{len(self.cases)} {name}"
                    )
        known = {
            "methods": list(self.names),
            "seeds": list(self.seeds),
            "effort": self.effort.share,
        }
        runs = [known | score.provenance()]
        return {
            "methods": list(self.names),
            "runs": runs,
            "cases": cases,
            "results": found,
            "left_out": self.left_out,
        }

    def _require_known(self, names: Sequence[str]) -> None:
        known = [name for case in self.cases for _, name in _points(case)]
        for name in names:
            if name not in known:
                raise FormatError(f"{name!r} is no case; leave out some of {'; '.join(known)}")

    def _evaluated(
        self, case: DevelopmentCase, sweeps: Dataset, each: int, what: str
    ) -> Iterator[Json]:
        """One entry for each method that can take the set and is complete with all seeds that were
        found."""
        plan = Plan(
            self.names, (case.part.protocol,), self.seeds, case.means_removed, self.effort, each
        )
        by_method: dict[str, list[Json]] = {}

        def log(line: str) -> None:
            self.log(f"{what}: {line}")

        for result in evaluate.evaluate(sweeps, plan, self.where, log):
            if result.refused:
                self.left_out[f"{result.method}, {case.name}"] = result.refused
            else:
                by_method.setdefault(result.method, []).append(
                    result.json() | {"seed": result.seed}
                )
        for method, results in by_method.items():
            yield {"case": case.name, "each": each, "method": method} | _entry(results)


def _points(case: DevelopmentCase) -> list[tuple[int, str]]:
    """Training sweeps of each material (0 for all) and name of what is evaluated of a case: it, and
    points of its curve."""
    return [(each, _name(case.name, each)) for each in (0, *case.curve)]


def _name(case: str, each: int) -> str:
    """Of a case, or of a point of its curve."""
    return f"{case}, {each} each" if each else case


def join(run: Json, earlier: Sequence[Json]) -> Json:
    """`run` with what it lacks of `earlier` runs: methods, their entries, what they left out, who
    ran when, and times.

    Raises FormatError where an earlier run was of other sweeps.
    """
    made = dict(run)
    for one in earlier:
        _require_same_sweeps(made, one)
        there = {(entry["case"], entry["each"], entry["method"]) for entry in made["results"]}
        more = [
            entry
            for entry in one["results"]
            if (entry["case"], entry["each"], entry["method"]) not in there
        ]
        names = dict.fromkeys([*made["methods"], *one["methods"]])
        made |= {
            "methods": sorted(names, key=lambda name: (*OURS, *PEERS, name).index(name)),
            "results": [*made["results"], *more],
            "runs": [*made["runs"], *one["runs"]],
        }
        if one.get("times"):
            made.setdefault("times", one["times"])
        done = {
            name
            for entry in made["results"]
            for name in (f"{entry['method']}, {entry['case']}", _name(entry["case"], entry["each"]))
        }
        made["left_out"] = {
            k: why for k, why in (one["left_out"] | made["left_out"]).items() if k not in done
        }
    return made


def _require_same_sweeps(run: Json, earlier: Json) -> None:
    known = {case["case"]: case["digest"] for case in earlier["cases"]}
    for case in run["cases"]:
        if known.get(case["case"], case["digest"]) != case["digest"]:
            raise FormatError(
                f"{case['case']!r} was of other sweeps in a run that is joined; run its methods again"
            )


def _about(case: DevelopmentCase, sweeps: Dataset) -> Json:
    """What a case was run on."""
    return {
        "case": case.name,
        "set": sweeps.source,
        "only": list(case.part.only),
        "protocol": case.part.protocol,
        "means_removed": case.means_removed,
        "simulated": case.simulated,
        "sweeps": len(sweeps),
        "materials": len(sweeps.materials),
        "format": str(sweeps.format),
        "digest": digest(sweeps),
        "curve": list(case.curve),
    }


def _entry(results: Sequence[Json]) -> Json:
    """Accuracy with its interval, and costs, of the results of all seeds; so too of each other
    precision."""
    seeds = [result["seed"] for result in results]
    forms = {
        name: joined(
            [
                result["forms"][name] | {"seed": seed}
                for result, seed in zip(results, seeds, strict=True)
            ]
        )
        for name in results[0].get("forms", {})
    }
    costs = {name: max(float(result[name]) for result in results) for name in ("fit_s", "ms_p50")}
    return joined(results) | costs | {"forms": forms}

"""A Fit: a trunk with its heads, and the sweeps that these were fitted to. In: a file. Out: the
Fit, and its graphs.

PyTorch is needed for `network` alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import checker, shape_inference

from appliance.core.errors import FormatError
from appliance.core.sweep_set import read
from train.data.sets import Dataset
from train.models.methods import Cost, Model
from train.models.recipe import graph, spectrum
from train.models.recipe.architectures import Architecture
from train.models.recipe.augment import Augmentation
from train.models.recipe.heads import HeadPlan
from train.onnx_tools.graph_builder import run, with_head

if TYPE_CHECKING:
    from train.models.recipe.network import Compact

Array = NDArray[Any]


@dataclass(frozen=True)
class Fit:
    """A trained network. weights: the state of a fused Compact with its LDA head, the temperature
    folded in, and a second head, `int8.weight` [K, F] and `int8.bias` [K], fitted to what the int8
    trunk gives.

    architecture: cut to what the heads see. ranges: of its int8 form, None where there is none.
    train, held: the sweeps that were trained on and those that were held out. about: JSON of how it
    was made and validated. plan: how heads are fitted again, before a temperature. cost: (step,
    cross entropy) of the training; the file does not keep it.
    """

    weights: dict[str, Array]
    scale: float
    architecture: Architecture
    ranges: graph.Ranges | None
    train: Dataset
    held: Dataset
    about: dict[str, Any]
    plan: HeadPlan
    cost: Cost = field(default_factory=list)

    @property
    def keep_means(self) -> bool:
        """Whether the head sees the means of the taxels."""
        return bool(self.about["recipe"]["keep_means"])

    @property
    def bands(self) -> int:
        """How many of the features, the last ones, are of the spectrum and were not learned."""
        return self.architecture.spectrum * spectrum.count(self.train.format)

    @property
    def augmentation(self) -> Augmentation:
        """The augmentation of its training."""
        return Augmentation(**self.about["recipe"]["scene"])

    def network(self) -> Compact:
        """The network in PyTorch, ready to run; of a fit without a filter bank."""
        import torch  # here: a fit without stages is made and packed without PyTorch

        from train.models.recipe.network import Compact

        with torch.random.fork_rng(devices=[]):  # its first weights are drawn, and overwritten
            format, classes = self.train.format, len(self.train.materials)
            model = Compact(format, classes, self.scale, False, self.keep_means, self.architecture)
        state = {
            k: torch.from_numpy(v) for k, v in self.weights.items() if not k.startswith("int8.")
        }
        model.load_state_dict(state)
        return model.eval()

    def trunk(self, int8: bool = True, tenths: bool = False) -> onnx.ModelProto:
        """`sweep` -> `features` float32 [1, F], or `tenths` float32 [1, 10, F]; see
        graph.trunk_graph."""
        ranges, format = self.ranges if int8 else None, self.train.format
        return graph.trunk_graph(
            format, self.scale, self.weights, self.architecture, ranges, tenths, self.keep_means
        )

    def in_float(self) -> Fit:
        """The same without an int8 form: its float trunk and head take that one's place."""
        head = {f"int8.{name}": self.weights[f"head.{name}"] for name in ("weight", "bias")}
        return replace(self, weights=self.weights | head, ranges=None)

    def int8_head(self) -> tuple[Array, Array]:
        """Weight [K, F] and bias [K] of the int8 trunk's head, the temperature folded in."""
        return self.weights["int8.weight"], self.weights["int8.bias"]

    def save(self, path: Path) -> None:
        """Write the fit as one .npz without pickle; training and held-out sweeps are one set, the
        first of them trained on."""
        names = ("samples", "labels", *("unloaded",) * (self.train.unloaded is not None))
        sets = {
            f"set_{k}": np.concatenate([getattr(self.train, k), getattr(self.held, k)])
            for k in names
        }
        arrays = {f"weight_{k}": v for k, v in self.weights.items()} | sets
        for name in self.train.groups:
            arrays[f"group_{name}"] = np.concatenate(
                [self.train.groups[name], self.held.groups[name]]
            )
        meta = {
            "scale": self.scale,
            "shape": asdict(self.architecture),
            "reach": asdict(self.ranges) if self.ranges else None,
            "materials": self.train.materials,
            "rate_hz": self.train.rate_hz,
            "source": self.train.source,
            "trained_on": len(self.train),
            "about": self.about,
            "plan": self.plan.json(),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as f:
            np.savez_compressed(f, allow_pickle=False, meta=np.array(json.dumps(meta)), **arrays)

    @classmethod
    def load(cls, path: Path) -> Fit:
        """Read what `save` wrote. Raises FormatError where it is something else."""
        what = "a fit (made by palpate-train fit)"
        arrays = read(path, what)
        try:
            meta = json.loads(str(arrays["meta"]))
            weights, groups = (
                {k.removeprefix(p): v for k, v in arrays.items() if k.startswith(p)}
                for p in ("weight_", "group_")
            )
            samples, labels, materials = (
                arrays["set_samples"],
                arrays["set_labels"],
                tuple(meta["materials"]),
            )
            unloaded = arrays.get("set_unloaded")
            sweeps = Dataset(
                samples, labels, materials, meta["rate_hz"], groups, meta["source"], unloaded
            )
            first = np.arange(len(sweeps)) < meta["trained_on"]
            architecture = Architecture(
                **meta["shape"] | {"channels": tuple(meta["shape"]["channels"])}
            )
            reach = meta["reach"]
            ranges = graph.Ranges(reach["digits"], tuple(reach["responses"])) if reach else None
            train, held = sweeps.take(first), sweeps.take(~first)
            fit = cls(
                weights,
                meta["scale"],
                architecture,
                ranges,
                train,
                held,
                meta["about"],
                HeadPlan.read(meta["plan"]),
            )
        except (KeyError, ValueError, TypeError) as e:
            raise FormatError(
                f"{path.name}: not {what}, or of another version; fit again: {e}"
            ) from e
        try:
            with_head(fit.trunk(), *fit.int8_head())
        except (KeyError, ValueError, checker.ValidationError, shape_inference.InferenceError) as e:
            raise FormatError(
                f"{path.name}: its weights are not those of its {architecture}; fit again"
            ) from e
        return fit


@dataclass(frozen=True)
class CompactModel:
    """A fit as the box runs it. forms: "float", the same before quantization.

    fit: what it comes from, with the sweeps that were trained on and held out. weight [K, F], bias
    [K]: its head for all materials. ran: what was computed or chosen. cost: of the training of
    stages.
    """

    fit: Fit
    weight: Array
    bias: Array
    ran: str
    cost: Cost = field(default_factory=list)
    forms: Mapping[str, Model] = field(default_factory=dict)

    def features(self, inputs: Array, tenths: bool = False) -> Array:
        """Raw counts [n, T, R, C] -> what the head sees, float32 [n, F]; of each tenth [n, 10, F],
        see graph.trunk_graph."""
        return run(self.fit.trunk(tenths=tenths), inputs)

    def logits(self, inputs: Array) -> Array:
        """Raw counts [n, T, R, C] -> float32 [n, K]."""
        return run(self.graph(), inputs)

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return with_head(self.fit.trunk(), self.weight, self.bias)

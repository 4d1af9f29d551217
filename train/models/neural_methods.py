"""The room of neural methods. In: an Effort. Out: the METHODS paper-cnn, tactnet2 and recurrent.

All are networks of train/networks.py, trained by the one loop of train/loop.py on the materials that occur in
training; a material that does not occur gets a logit that no sweep can lift.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat
from train.data.sets import Dataset
from train.models.linear_head import hold_out, temperature
from train.models.methods import FULL_EFFORT, Effort, Method, Model
from train.models.networks import PAPER, TACTNET2, ImageNetwork, Network, Recurrent, texture_scale
from train.models.training import Cost, Log, TrainingRecipe, in_order, learn, one_thread, silent, tensors
from train.onnx_tools.graph_builder import GraphModel
from train.onnx_tools.quantize import quantize

Array = NDArray[Any]
Rules = TypeVar("Rules", bound=TrainingRecipe)
PAPER_STEPS, PROCESSOR_STEPS = 4000, 200
"""Iterations of the paper's CNN: the paper's (table I) on a GPU; fewer on a processor, where one core needs about a
second and a half for each."""
PAPER_RECIPE = TrainingRecipe(batch=50, peak_rate=1e-4, weight_decay=0.0, smoothing=0.0, ema=0.0, dropout=0.25, noise=0.0,
                      gain=0.0, cycle=False)  # fmt: skip
"""As printed (section IV.D); its p_d = .75 is the share that is kept."""
PAPER_INT8 = ("Conv", "Relu", "MaxPool", "Gemm")
"""Nodes of the paper's CNN that its int8 form has in int8."""
TACTNET2_RECIPE = TrainingRecipe(steps=120, batch=32, peak_rate=2e-3, smoothing=0.0, ema=0.9, dropout=0.5, noise=0.0, gain=0.0,
                         adversarial=0.01)  # fmt: skip
"""Adversarial training as in Goodfellow et al. 2015, half of the cost; dropout as in Gal and Ghahramani 2016. The
numbers are ours, so that one core needs about half a minute for 480 sweeps; farther than .01 only cost accuracy on
positions held out inside a training set."""
RECURRENT_RECIPE = TrainingRecipe(steps=400)
"""As the compact network's, with half the iterations."""
LEAST_STEPS = 2
"""However small the effort is."""


@dataclass(frozen=True)
class NetworkModel:
    """A trained network as a Model. ran: what was computed, and how. cost: (iteration, cross entropy) in training.

    forms: the same in other precisions.
    """

    network: Network
    ran: str
    cost: Cost = field(default_factory=list)
    forms: Mapping[str, Model] = field(default_factory=dict)

    @torch.no_grad()
    def logits(self, given: Array) -> Array:
        """Digits [n, T, R, C] -> float32 [n, K]."""
        with one_thread():
            return np.concatenate([self.network(x).numpy() for x in tensors(given, in_order(len(given), 32))])

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return self.network.graph()


Build = Callable[[SweepFormat, int, Array], Network]


def paper_cnn(form: SweepFormat, classes: int, samples: Array) -> Network:
    """The paper's CNN; digits are scaled by one mean and one deviation of all of `samples`, since no scale is printed.

    15,891,910 parameters for 1500 x 4 x 4 and six materials.
    """
    return ImageNetwork(form, classes, *_statistics(samples), PAPER)


def paper_cnn_centred(form: SweepFormat, classes: int, samples: Array) -> Network:
    """The paper's CNN behind a layer that takes each taxel's mean away, as in the compact network."""
    return ImageNetwork(form, classes, texture_scale(samples), None, PAPER)


def tactnet2(form: SweepFormat, classes: int, samples: Array) -> Network:
    """TactNet-II as far as it is known (networks.TACTNET2); each taxel's mean is taken away, as in the compact network.

    On the box and here alike dropout is off at test time, the mean field of the paper's Monte Carlo dropout: the same
    sweep gets the same answer every time.
    """
    return ImageNetwork(form, classes, texture_scale(samples), None, TACTNET2)


def recurrent(form: SweepFormat, classes: int, samples: Array) -> Network:
    """The paper's future work; each taxel's mean is taken away, as in the compact network."""
    return Recurrent(form, classes, texture_scale(samples))


def _statistics(samples: Array) -> tuple[float, float]:
    """(scale, offset) that make all digits together of mean 0 and deviation 1."""
    mean = float(samples.mean(dtype=np.float64))
    return float(1 / max(samples.std(dtype=np.float64), 1e-6)), mean


def train_network(
    sweeps: Dataset,
    given: Array,
    seed: int,
    *,
    build: Build,
    recipe: TrainingRecipe,
    calibrated: bool,
    bfloat16: bool,
    log: Log,
    int8: Sequence[str] = (),
) -> NetworkModel:
    """Train what `build` gives. calibrated: hold some groups out for the temperature; else all are trained on, with 1.

    int8: kinds of nodes that the form "int8" has in int8; where there are none there is no such form.
    Raises FormatError where only one material occurs.
    """
    known = replace(sweeps, samples=given).select(())
    train, held = parts(known, seed)[:2] if calibrated else (known, known)
    with _computing(seed) as device:
        half = bfloat16 and (device == "cuda" or bool(torch.cpu.get_capabilities().get("avx512_bf16")))
        network = build(train.format, len(train.materials), train.samples)
        network, cost = learn(network, train, recipe, seed, log, device, half)
        trained = NetworkModel(network, ran(recipe, device, half, bfloat16), cost)
    cooler = temperature(trained.logits(held.samples), held.labels) if calibrated else 1.0
    network.spread(np.unique(sweeps.labels), len(sweeps.materials), cooler)
    return replace(trained, forms={"int8": GraphModel(quantize(network.graph(), train.samples, int8))} if int8 else {})


def parts(sweeps: Dataset, seed: int) -> tuple[Dataset, Dataset, str]:
    """As heads.hold_out; too small a set is trained on whole, and there Platt's doubt alone bounds the temperature."""
    try:
        return hold_out(sweeps, seed)
    except FormatError:
        return sweeps, sweeps, "nothing"


def ran(recipe: TrainingRecipe, device: str, half: bool, wanted: bool) -> str:
    """What was computed, and how."""
    digits = "bfloat16" if half else "float32 (no bfloat16 here)" if wanted else "float32"
    return f"{recipe.steps} iterations of {recipe.batch} in {digits} on {device}"


@contextmanager
def _computing(seed: int) -> Iterator[str]:
    """The device: a GPU where there is one, else one thread. The same bits each time; no random state is changed."""
    exact = torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False)  # float32 means float32
    with one_thread(), exact, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        yield "cuda" if torch.cuda.is_available() else "cpu"


def shortened(recipe: Rules, effort: Effort) -> Rules:
    """`recipe` with as many iterations as `effort` asks for."""
    return replace(recipe, steps=max(round(recipe.steps * effort.share), LEAST_STEPS))


def methods(effort: Effort = FULL_EFFORT, log: Log = silent) -> tuple[Method, ...]:
    """The neural methods, trained with this effort. log: is told of every iteration."""
    steps = effort.paper_steps
    if steps is None:
        steps = round((PAPER_STEPS if torch.cuda.is_available() else PROCESSOR_STEPS) * effort.share)

    def network(name: str, about: str, build: Build, recipe: TrainingRecipe, printed: bool = False) -> Method:
        return Method(name, about, "raw", partial(
            train_network, build=build, recipe=recipe, calibrated=not printed, log=log,
            bfloat16=(half := effort.bfloat16 and printed), int8=PAPER_INT8 if printed else (),
        ), effort=f"{recipe.steps} iterations{', bfloat16' * half}")  # fmt: skip

    paper = replace(PAPER_RECIPE, steps=max(steps, LEAST_STEPS))
    return (
        network("paper-cnn", f"the paper's CNN on raw digits (section IV), {paper.steps} iterations", paper_cnn, paper, True),
        network("paper-cnn-centred", "the same behind each taxel's mean, which it need not unlearn", paper_cnn_centred, paper, True),
        network("tactnet2", "TactNet-II as far as it is known (Tulbure and Baeuml 2018)", tactnet2, shortened(TACTNET2_RECIPE, effort)),
        network("recurrent", "gated recurrent unit over patches, the paper's future work", recurrent, shortened(RECURRENT_RECIPE, effort)),
    )  # fmt: skip


METHODS = methods()

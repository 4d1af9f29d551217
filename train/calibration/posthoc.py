"""The room where a trained trunk gets all that stands on it. In: its features of training sweeps. Out: a Posthoc.

That is an embedding, heads for each tenth, temperatures, the rule for early decisions and the limit of what is known;
and the graph of all of it. What was fitted is judged by sweeps that it did not see, group by group.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from appliance.bundle.bundle import Known
from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from train.calibration import early_exit, novelty
from train.calibration.early_exit import EarlyRule, Heads
from train.calibration.novelty import Embedding
from train.models.compact.augment import Augmentation
from train.models.compact.fit import COPIES, Fit, copies, varied
from train.models.linear_head import temperature
from train.onnx_tools.graph_builder import run

Array = NDArray[Any]


@dataclass(frozen=True)
class Posthoc:
    """What stands on a trunk. weight [F, K], bias [K]: the head that names, cooled by `temperature`. warmth: temperature
    of logits from class means; steps: of the tenths, cooled; limit: see known."""

    embedding: Embedding
    weight: Array
    bias: Array
    temperature: float
    warmth: float
    steps: Heads
    rule: EarlyRule
    limit: float

    def logits(self, features: Array) -> Array:
        """Features [..., F] of whole sweeps -> logits [..., K] whose softmax may be believed."""
        named: Array = np.asarray(features, np.float64) @ self.weight + self.bias
        return named

    def probabilities(self, tenths: Array) -> Array:
        """Features [n, D + 1, F] -> probabilities [n, D + 1, K] after each step and the whole sweep."""
        steps = self.steps.logits(self.embedding(tenths))
        return softmax(np.concatenate([steps, self.logits(tenths[:, -1])[:, None]], axis=1))

    def known(self) -> Known:
        """For the manifest."""
        return Known(self.limit, self.warmth)

    def means(self) -> bytes:
        """The file means.npz of a bundle."""
        packed, held = io.BytesIO(), self.embedding.classes()
        np.savez_compressed(packed, means=held.means, bias=held.bias, sweeps=held.sweeps)
        return packed.getvalue()

    def graph(self, trunk: onnx.ModelProto, known: bool = True) -> onnx.ModelProto:
        """The model of a bundle; `early` is in it where the trunk gives tenths and there is a rule."""
        return assembled(
            trunk, self.embedding, (self.weight, self.bias), self.steps if self.rule.early else None, known
        )


@dataclass(frozen=True)
class AugmentedCopies:
    """The training sweeps again, as the scene might have given them: features [M, F], labels [M], groups [M].

    They teach the head that names how materials vary. The embedding does not see them: with them a strange material
    would lie among what is known.
    """

    features: Array
    labels: Array
    groups: Array


def fit_posthoc(
    tenths: Array, labels: Array, groups: Array, judged: Array, fixed: int = 0, also: AugmentedCopies | None = None
) -> Posthoc:
    """Fit all of it on features [N, D + 1, F] of sweeps with labels [N] from 0 to K - 1, of groups [N].

    judged: bool [N], sweeps that the trunk did not see; only these find temperatures, rule and limit, each with heads
    that did not see its group. fixed: so many features, the last ones, were not trained; see known.embed.
    Raises FormatError as known.embed, and where there is but one group or nothing to judge by.
    """
    whole, classes = tenths[:, -1], int(labels.max()) + 1
    copied = also or AugmentedCopies(whole[:0], labels[:0], groups[:0])

    def named(fit: Array) -> tuple[Array, Array]:
        """The head found without the groups that are not in `fit`, bool [N]."""
        more = np.isin(copied.groups, groups[fit])
        x, y = np.concatenate([whole[fit], copied.features[more]]), np.concatenate([labels[fit], copied.labels[more]])
        return early_exit.lda(x, y, classes)

    logits, numbers = early_exit.crossed(tenths, labels, groups, judged, fixed)
    warmth = temperature(logits[:, -1], labels[numbers])
    at = {number: row for row, number in enumerate(numbers)}
    for fit, judges in novelty.parts(groups, judged):
        weight, bias = named(fit)
        there = [number for number in judges if number in at]
        logits[[at[number] for number in there], -1] = whole[there] @ weight + bias
    cooler = early_exit.temperatures(logits, labels[numbers])
    rule = early_exit.rule(softmax(logits / cooler[:, None]), labels[numbers])
    embedding, (weight, bias) = novelty.embed(whole, labels, fixed), named(np.ones(len(labels), bool))
    steps = early_exit.heads(embedding(tenths), labels, classes).cooled(cooler[:-1])
    limit = novelty.limit(novelty.crossed(whole, labels, groups, judged, fixed))
    return Posthoc(embedding, weight / cooler[-1], bias / cooler[-1], float(cooler[-1]), warmth, steps, rule, limit)


def assembled(
    trunk: onnx.ModelProto,
    embedding: Embedding,
    head: tuple[Array, Array],
    steps: Heads | None = None,
    known: bool = True,
) -> onnx.ModelProto:
    """The model that a bundle holds, of a trunk (float or int8) and what stands on it.

    trunk: `sweep` -> `features` float32 [1, F], or `tenths` [1, D + 1, F], which `steps` need. head: weight [F, K], bias
    [K]. Outputs: `logits` [1, K], `early` [1, D, K] where there are `steps`, `embedding` [1, r] where `known`.
    """
    whole = onnx.ModelProto()
    whole.CopyFrom(trunk)
    given = trunk.graph.output[0]
    dims = [d.dim_value for d in given.type.tensor_type.shape.dim]
    add = partial(_add, whole.graph)
    last = (
        given.name if len(dims) == 2 else add("Gather", given.name, np.array(dims[1] - 1), output="head.last", axis=1)
    )
    weight, bias = (np.asarray(part, np.float32) for part in head)
    add("Gemm", last, weight - weight.mean(1, keepdims=True), bias - bias.mean(), output="logits")
    outputs: dict[str, list[int]] = {"logits": [1, len(bias)]}
    if steps is not None and len(dims) == 3:
        z = add("MatMul", given.name, embedding.projection, output="head.turned")
        z = add("Add", z, embedding.offset, output="head.each")
        # [1, D, r] -> [D, 1, r]: one head for each row
        rows = add("Slice", z, np.array([0]), np.array([dims[1] - 1]), np.array([1]), output="head.first")
        rows = add("Transpose", rows, output="head.rows", perm=[1, 0, 2])
        rows = add("MatMul", rows, steps.weight, output="head.steps")
        add("Transpose", add("Add", rows, steps.bias[:, None], output="head.said"), output="early", perm=[1, 0, 2])
        outputs["early"] = [1, dims[1] - 1, len(bias)]
    if known:
        add("Gemm", last, embedding.projection, embedding.offset, output="embedding")
        outputs["embedding"] = [1, embedding.projection.shape[1]]
    del whole.graph.output[:]
    for name, shape in outputs.items():
        whole.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    onnx.checker.check_model(whole, full_check=True)
    return whole


def _add(graph: onnx.GraphProto, op: str, *inputs: str | Array, output: str, **how: Any) -> str:
    """One node more; arrays become constants."""
    names = []
    for i, held in enumerate(inputs):
        names.append(held if isinstance(held, str) else f"{output}.{i}")
        if not isinstance(held, str):
            graph.initializer.append(numpy_helper.from_array(np.array(held, order="C"), names[-1]))
    graph.node.append(helper.make_node(op, names, [output], name=output, **how))
    return output


def posthoc_inputs(made: Fit) -> tuple[Array, Array, Array, Array, int, AugmentedCopies]:
    """What its int8 trunk makes of the sweeps that were trained on and held out, in this order.

    Raises FormatError where none was held out: nothing could judge.
    """
    train, held, by = made.train, made.held, made.about["held_out_by"]
    if by == "nothing":
        raise FormatError(f"{train.source}: too few groups to hold some out; record more positions")
    tenths = run(made.trunk(tenths=True), np.concatenate([train.samples, held.samples]))
    labels, groups = np.append(train.labels, held.labels), np.append(train.group(by), held.group(by))
    change = partial(varied, rows=train.format.rows, scene=Augmentation(**made.about["recipe"]["scene"]))
    trunk, seed = made.trunk(), made.about["seed"]
    changed = np.concatenate([run(trunk, copy.samples) for copy in copies(made.network(), train, change, seed)])
    also = AugmentedCopies(changed, np.tile(train.labels, COPIES), np.tile(train.group(by), COPIES))
    return tenths, labels, groups, np.arange(len(labels)) >= len(train), made.bands, also


def calibrate(made: Fit) -> Posthoc:
    """All that stands on the trunk of `made`. Raises FormatError as `seen` and finish.finish."""
    return fit_posthoc(*posthoc_inputs(made))

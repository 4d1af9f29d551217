"""The room where a trained trunk gets all that stands on it. In: its features of training sweeps. Out: a Finish.

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

from appliance.bundle import Known
from appliance.classifier import softmax

from . import early, known
from .early import Heads, Rule
from .known import Embedding

Array = NDArray[Any]


@dataclass(frozen=True)
class Finish:
    """What stands on a trunk. temperature: of the whole sweep's logits; steps: of the tenths, cooled; limit: see known."""

    embedding: Embedding
    temperature: float
    steps: Heads
    rule: Rule
    limit: float

    def logits(self, features: Array) -> Array:
        """Features [..., F] of whole sweeps -> logits [..., K] whose softmax may be believed."""
        return self.embedding.logits(features, self.temperature)

    def probabilities(self, tenths: Array) -> Array:
        """Features [n, D + 1, F] -> probabilities [n, D + 1, K] after each step and the whole sweep."""
        steps = self.steps.logits(self.embedding(tenths))
        return softmax(np.concatenate([steps, self.logits(tenths[:, -1])[:, None]], axis=1))

    def known(self) -> Known:
        """For the manifest."""
        return Known(self.limit, self.temperature)

    def means(self) -> bytes:
        """The file means.npz of a bundle."""
        packed, means = io.BytesIO(), self.embedding.means
        bias = -(means.astype(np.float64) ** 2).sum(1) / 2
        np.savez_compressed(packed, means=means, bias=bias.astype(np.float32), sweeps=np.zeros(len(means), np.int64))
        return packed.getvalue()

    def graph(self, trunk: onnx.ModelProto, known: bool = True) -> onnx.ModelProto:
        """The model of a bundle; `early` is in it where the trunk gives tenths and there is a rule."""
        return assembled(trunk, self.embedding, self.temperature, self.steps if self.rule.early else None, known)


def finish(
    tenths: Array, labels: Array, groups: Array, judged: Array, fixed: int = 0, changed: Array | None = None
) -> Finish:
    """Fit all of it on features [N, D + 1, F] of sweeps with labels [N] from 0 to K - 1, of groups [N].

    judged: bool [N], sweeps that the trunk did not see; only these find temperatures, rule and limit, each with heads
    that did not see its group. fixed: so many features, the last ones, were not trained; see known.embed.
    changed: bool [N], sweeps that were changed as a scene might: the heads of the tenths see them, too, but they do not
    count for the embedding. What they cover would pass for known (AUROC .93 for .97).
    Raises FormatError as known.embed, and where there is but one group or nothing to judge by.
    """
    plain = np.ones(len(labels), bool) if changed is None else ~changed
    logits, numbers = early.crossed(tenths, labels, groups, judged, fixed, changed)
    limit = known.limit(known.crossed(tenths[plain, -1], labels[plain], groups[plain], judged[plain], fixed))
    cooler = early.temperatures(logits, labels[numbers])
    rule = early.rule(softmax(logits / cooler[:, None]), labels[numbers])
    embedding = known.embed(tenths[plain, -1], labels[plain], fixed)
    steps = early.heads(embedding(tenths), labels, len(embedding.means)).cooled(cooler[:-1])
    return Finish(embedding, float(cooler[-1]), steps, rule, limit)


def assembled(
    trunk: onnx.ModelProto, embedding: Embedding, cooler: float, steps: Heads | None = None, known: bool = True
) -> onnx.ModelProto:
    """The model that a bundle holds, of a trunk (float or int8) and what stands on it.

    trunk: `sweep` -> `features` float32 [1, F], or `tenths` [1, D + 1, F], without which there are no `steps`. Outputs: `logits` [1, K],
    from the embedding, so that the box's class means say the same; `early` [1, D, K] where there are `steps`;
    `embedding` [1, r] where `known`.
    """
    whole = onnx.ModelProto()
    whole.CopyFrom(trunk)
    dims = [d.dim_value for d in trunk.graph.output[0].type.tensor_type.shape.dim]
    r, k = embedding.projection.shape[1], len(embedding.means)
    add = partial(_add, whole.graph)
    z = add("MatMul", trunk.graph.output[0].name, embedding.projection, output="head.turned")
    z = each = add("Add", z, embedding.offset, output="embedding" if len(dims) == 2 else "head.each")
    if len(dims) == 3:
        z = add("Gather", each, np.array(dims[1] - 1), output="embedding", axis=1)
    means = embedding.means.astype(np.float64)
    weight, bias = means.T / cooler, -(means**2).sum(1) / 2 / cooler
    add("Gemm", z, weight.astype(np.float32), bias.astype(np.float32), output="logits")
    outputs: dict[str, list[int]] = {"logits": [1, k]}
    if steps is not None and len(dims) == 3:
        # [1, D, r] -> [D, 1, r]: one head for each row
        rows = add("Slice", each, np.array([0]), np.array([dims[1] - 1]), np.array([1]), output="head.first")
        rows = add("Transpose", rows, output="head.rows", perm=[1, 0, 2])
        rows = add("MatMul", rows, steps.weight, output="head.steps")
        rows = add("Add", rows, steps.bias[:, None], output="head.said")
        add("Transpose", rows, output="early", perm=[1, 0, 2])
        outputs["early"] = [1, dims[1] - 1, k]
    if known:
        outputs["embedding"] = [1, r]
    del whole.graph.output[:]
    for name, shape in outputs.items():
        whole.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    onnx.checker.check_model(whole, full_check=True)
    return whole


def _add(graph: onnx.GraphProto, op: str, *inputs: str | Array, output: str, **how: Any) -> str:
    """One node more; arrays among its inputs become constants."""
    names = [held if isinstance(held, str) else f"{output}.{i}" for i, held in enumerate(inputs)]
    for name, held in zip(names, inputs, strict=True):
        if not isinstance(held, str):
            graph.initializer.append(numpy_helper.from_array(np.array(held, order="C"), name))
    graph.node.append(helper.make_node(op, names, [output], name=output, **how))
    return output

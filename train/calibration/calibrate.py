"""Everything that is fitted after training. In: a Fit, or its trunk's features of the training
sweeps. Out: a Calibration.

That is an embedding, heads for each tenth, temperatures, the rule for early decisions, the limit of
what is known, and the graph of all of it. What was fitted is judged by sweeps that it did not see,
group by group.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from appliance.bundle.bundle import Known, Moved
from appliance.inference.classifier import softmax
from train.calibration import early_exit, novelty
from train.calibration.displacement import (
    AugmentedCopies,
    DisplacementFit,
    displaced,
    fit_displacement,
)
from train.calibration.early_exit import EarlyRule, Heads
from train.calibration.novelty import Embedding
from train.metrics.temperature import sufficient_temperature
from train.models.linear_head import hold_out
from train.models.recipe.augment import Augmentation
from train.models.recipe.copies import COPIES, copies
from train.models.recipe.fitted import Fit
from train.models.recipe.heads import HeadPart, HeadPlan
from train.onnx_tools.graph_builder import joined, run
from train.onnx_tools.quantize import sixteen_bits

Array = NDArray[Any]
HELD_COPIES_SEED, DISTURBED_SEED = 1, 2
"""Added to a fit's seed for the copies of its held-out sweeps, and for disturbed ones."""
DISTURBED = Augmentation(
    moved=0.0,
    gain=0.1,
    gains=0.05,
    silent=0.06,
    damped=0.0,
    colour=0.0,
    noise=0.4,
    hum=0.3,
    drift=0.1,
)
"""What may happen to a known material in service: a worse amplifier, the mains, a taxel that
fails."""
ONE_IN = 10
"""One in so many training sweeps is disturbed so; docs/decisions/0006 has what other shares
gave."""
DIRECTIONS, TURN, OFFSET = "embedding.axes", "embedding.turn", "embedding.offset"
"""Names of a model's matrices; see novelty.Embedding."""


@dataclass(frozen=True)
class HeldOut:
    """Answers to the sweeps that judge, each by heads, embedding and temperature as they are fitted
    without its group.

    numbers: of the sweeps [n]. probabilities: [n, K], of the network. known: bool [n], whether the
    novelty check lets them pass.
    """

    numbers: Array
    probabilities: Array
    known: Array


@dataclass(frozen=True)
class Calibration:
    """What is fitted to a trunk. weight [F, K], bias [K]: the head that names the material, divided
    by `temperature`.

    class_mean_temperature: temperature of logits from class means. steps: heads of the tenths, with their
    temperatures. limit: see novelty. moved: for sweeps of a moved skin, None where there were no
    copies to fit it to. held: what it answers to held-out sweeps.
    """

    embedding: Embedding
    weight: Array
    bias: Array
    temperature: float
    class_mean_temperature: float
    steps: Heads
    rule: EarlyRule
    limit: float
    moved: DisplacementFit | None
    held: HeldOut

    def logits(self, features: Array) -> Array:
        """Features [..., F] of whole sweeps -> logits [..., K] whose softmax is calibrated."""
        logits: Array = np.asarray(features, np.float64) @ self.weight + self.bias
        return logits

    def probabilities(self, tenths: Array) -> Array:
        """Features [n, D + 1, F] -> probabilities [n, D + 1, K] after each step and the whole
        sweep."""
        steps = self.steps.logits(self.embedding(tenths))
        return softmax(np.concatenate([steps, self.logits(tenths[:, -1])[:, None]], axis=1))

    def known(self) -> Known:
        """The entry `known` of a manifest."""
        return Known(self.limit, self.class_mean_temperature)

    def displacement_rule(self) -> Moved | None:
        """The entry `moved` of a manifest."""
        return self.moved.rule if self.moved else None

    def means(self) -> bytes:
        """The file means.npz of a bundle."""
        packed, classes = io.BytesIO(), self.embedding.classes()
        classes = self.moved.classes(classes) if self.moved else classes
        np.savez_compressed(packed, allow_pickle=False, **classes.arrays())
        return packed.getvalue()

    def graph(
        self, trunk: onnx.ModelProto, tenths: onnx.ModelProto | None = None, known: bool = True
    ) -> onnx.ModelProto:
        """The model of a bundle, from the trunk that gives `features`. It has `early` where there
        is a rule, and `tenths`, the same trunk that gives these."""
        head = self.weight, self.bias
        if tenths is None or self.rule.early is None:
            return assemble_model(trunk, self.embedding, head, known=known)
        return assemble_model(joined(trunk, tenths), self.embedding, head, self.steps, known)


@dataclass(frozen=True)
class CalibrationInputs:
    """What everything is fitted to: features [N, D + 1, F] of sweeps with labels [N] from 0 to K -
    1, of groups [N].

    judged: bool [N], sweeps that the trunk did not see. Only these find temperatures and rule, each
    with heads that did not see its group. fixed: so many features, the last ones, were not trained;
    see novelty.embed. Where there are some, most of a distance is in them, and all sweeps find its
    limit: of more positions, so that it is less a matter of chance. copied: augmented copies; those
    that are not held are what the head was fitted to as well, the others judge what a moved skin
    does. disturbed: bool [N], sweeps that only show how far known materials scatter when something
    is wrong: the head does not see them, and they judge nothing. plan: of the head that names the
    material; None for one discriminant that sees everything.
    """

    tenths: Array
    labels: Array
    groups: Array
    judged: Array
    fixed: int
    copied: AugmentedCopies
    disturbed: Array
    plan: HeadPlan | None = None


def calibrate(fit: Fit) -> Calibration:
    """Fit everything to the int8 trunk of `fit`. Raises FormatError as `calibration_inputs` and
    `fit_calibration`."""
    return fit_calibration(calibration_inputs(fit))


def calibration_inputs(fit: Fit) -> CalibrationInputs:
    """What the int8 trunk of `fit` gives for the sweeps that were trained on, held out and
    disturbed, in this order, and for augmented copies of the first two. Raises FormatError where
    none was held out: nothing could judge."""
    train, held, by = fit.train, fit.held, fit.about["held_out_by"]
    if by == "nothing":
        hold_out(train, fit.about["seed"])  # says why
    trunk, features, seed = fit.trunk(), [], fit.about["seed"]
    some = train.take(
        np.random.default_rng(seed + DISTURBED_SEED).permutation(len(train))[::ONE_IN]
    )
    (disturbed,) = copies(some, DISTURBED, seed + DISTURBED_SEED, 1)
    of_all = train, held, disturbed
    tenths = run(fit.trunk(tenths=True), np.concatenate([sweeps.samples for sweeps in of_all]))
    labels, groups = (
        np.concatenate(part)
        for part in zip(*((s.labels, s.group(by)) for s in of_all), strict=True)
    )
    role = np.repeat(np.arange(3), [len(sweeps) for sweeps in of_all])
    judging = displaced(fit.augmentation)
    for sweeps, change, drawn in (
        (train, fit.augmentation, seed),
        (held, judging, seed + HELD_COPIES_SEED),
    ):
        features += [run(trunk, copy.samples) for copy in copies(sweeps, change, drawn, COPIES)]
    sides = [np.tile(train.labels, COPIES), np.tile(held.labels, COPIES)]
    copied_groups = np.append(np.tile(train.group(by), COPIES), np.tile(held.group(by), COPIES))
    is_held = np.repeat([False, True], [len(side) for side in sides])
    copied = AugmentedCopies(
        np.concatenate(features), np.concatenate(sides), copied_groups, is_held
    )
    return CalibrationInputs(
        tenths, labels, groups, role == 1, fit.bands, copied, role == 2, fit.plan
    )


def fit_calibration(given: CalibrationInputs) -> Calibration:
    """Fit all of it. Raises FormatError as novelty.embed, and where there is only one group or
    nothing to judge by."""
    tenths, labels, groups, judged, fixed = (
        given.tenths,
        given.labels,
        given.groups,
        given.judged,
        given.fixed,
    )
    whole, classes, every = tenths[:, -1], int(labels.max()) + 1, np.ones(len(labels), bool)
    sound, more = ~given.disturbed, given.copied
    plan = given.plan or HeadPlan((HeadPart(tuple(range(whole.shape[1])), copies=True),))

    def naming_head(fit: Array) -> tuple[Array, Array]:
        """The head fitted to the groups in `fit`, bool [N]."""
        fit = fit & sound
        also = more.take(np.isin(more.groups, groups[fit]) & ~more.held)
        weight, bias = plan.fit((whole[fit], labels[fit], also.features, also.labels), classes)
        return weight.T, bias

    logits, numbers = early_exit.cross_fitted_logits(tenths, labels, groups, judged, fixed)
    class_mean_temperature = sufficient_temperature(logits[:, -1], labels[numbers], groups[numbers])
    row_of = {number: row for row, number in enumerate(numbers)}
    for fit, judges in novelty.parts(groups, judged):
        weight, bias = naming_head(fit)
        present = [number for number in judges if number in row_of]
        logits[[row_of[number] for number in present], -1] = whole[present] @ weight + bias
    temperatures = early_exit.fit_temperatures(logits, labels[numbers], groups[numbers])
    p = softmax(logits / temperatures[:, None])
    rule = early_exit.find_rule(p, labels[numbers])
    embedding, last = novelty.embed(whole, labels, fixed), float(temperatures[-1])
    steps = early_exit.heads(embedding(tenths), labels, classes).cooled(temperatures[:-1])
    distances = novelty.cross_fitted_distances(
        whole, labels, groups, (judged | (fixed > 0)) & sound, fixed
    )
    limit = novelty.limit(distances)
    held = HeldOut(numbers, p[:, -1], distances[numbers] <= limit)
    moved = None
    if more.held.any():
        weight, bias = naming_head(~np.isin(groups, groups[judged]))
        moved = fit_displacement(
            whole, labels, judged, fixed, more, (more.features[more.held] @ weight + bias) / last
        )
    weight, bias = naming_head(every)
    return Calibration(
        embedding,
        weight / last,
        bias / last,
        last,
        class_mean_temperature,
        steps,
        rule,
        limit,
        moved,
        held,
    )


def assemble_model(
    trunk: onnx.ModelProto,
    embedding: Embedding,
    head: tuple[Array, Array],
    steps: Heads | None = None,
    known: bool = True,
) -> onnx.ModelProto:
    """The model that a bundle holds: a trunk (float or int8) and what is fitted to it.

    trunk: `sweep` -> `features` float32 [1, F] and, where there are `steps`, `tenths` [1, D + 1,
    F]. head: weight [F, K], bias [K]. Outputs: `logits` [1, K], `early` [1, D, K] where there are
    `steps`, `embedding` [1, r] where `known`. The box leaves out what only `early` needs where it
    gives no early answers, so nothing else depends on the tenths.
    """
    model = onnx.ModelProto()
    model.CopyFrom(trunk)
    add = partial(_add, model.graph)
    whole, *tenths = [output.name for output in trunk.graph.output]
    weight, bias = (np.asarray(part, np.float32) for part in head)
    centred = _sixteen_bits(add, weight - weight.mean(1, keepdims=True), "head.weight")
    add("Gemm", whole, centred, bias - bias.mean(), output="logits")
    outputs: dict[str, list[int]] = {"logits": [1, len(bias)]}
    embedded = partial(_embedded, add, embedding)
    if known or steps is not None:
        _sixteen_bits(add, embedding.directions, DIRECTIONS)
        if embedding.selected:
            _sixteen_bits(add, embedding.turn, TURN)
        model.graph.initializer.append(numpy_helper.from_array(embedding.offset, OFFSET))
    if steps is not None:
        count = len(steps.weight)
        z = embedded(tenths[0], axis=2, output="head.each")
        # [1, D, r] -> [D, 1, r]: one head for each row
        rows = add("Slice", z, np.array([0]), np.array([count]), np.array([1]), output="head.first")
        rows = add("Transpose", rows, output="head.rows", perm=[1, 0, 2])
        rows = add(
            "MatMul", rows, _sixteen_bits(add, steps.weight, "early.weight"), output="head.steps"
        )
        add(
            "Transpose",
            add("Add", rows, steps.bias[:, None], output="head.said"),
            output="early",
            perm=[1, 0, 2],
        )
        outputs["early"] = [1, count, len(bias)]
    if known:
        embedded(whole, axis=1, output="embedding")
        outputs["embedding"] = [1, len(embedding.offset)]
    del model.graph.output[:]
    for name, shape in outputs.items():
        model.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    onnx.checker.check_model(model, full_check=True)
    return model


def _embedded(add: Callable[..., str], embedding: Embedding, x: str, axis: int, output: str) -> str:
    """Features [..., F], F being the axis `axis` -> what `embedding` makes of them; its constants
    are in the graph."""
    z, size = add("MatMul", x, DIRECTIONS, output=f"{output}.known"), len(embedding.directions)
    if embedding.selected:
        ends = (np.array([n]) for n in (size - embedding.selected, size, axis))
        z = add(
            "Concat",
            z,
            add("Slice", x, *ends, output=f"{output}.selected"),
            output=f"{output}.both",
            axis=axis,
        )
        z = add("MatMul", z, TURN, output=f"{output}.whole")
    return add("Add", z, OFFSET, output=output)


def _sixteen_bits(add: Callable[..., str], matrix: Array, name: str) -> str:
    """Matrices [F, n] or [D, F, n] in 16 bits, as quantize.sixteen_bits has them: half the bytes of
    what is largest in a bundle. onnxruntime turns them into floats once, when it opens the
    model."""
    whole, steps = sixteen_bits(matrix)
    return add(
        "Mul", add("Cast", whole, output=f"{name}.whole", to=TensorProto.FLOAT), steps, output=name
    )


def _add(
    graph: onnx.GraphProto, op: str, *inputs: str | Array, output: str, **attributes: Any
) -> str:
    """Add one node; arrays become constants. The name of its output."""
    names = []
    for i, value in enumerate(inputs):
        names.append(value if isinstance(value, str) else f"{output}.{i}")
        if not isinstance(value, str):
            graph.initializer.append(numpy_helper.from_array(np.array(value, order="C"), names[-1]))
    graph.node.append(helper.make_node(op, names, [output], name=output, **attributes))
    return output

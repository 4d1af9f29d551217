"""The room of moves. In: a node's inputs and settings. Out: type and shape of what it gives.

The rules of the operators that join, cut, pick and arrange numbers and leave them as they are, or make them of none. What
decides a size must be a constant of the file; a place that a sweep decides is looked at by onnxruntime, sweep by sweep.
"""

from __future__ import annotations

from math import prod

from appliance.bundle.onnx_check.shapes import PLACE, Call, Out, Value, axes, need, spread, together


def concat(call: Call) -> Out:
    """Concat."""
    kinds, shapes = {x.kind for x in call.inputs}, [list(x.shape) for x in call.inputs]
    axis = call.axis(len(shapes[0]))
    alike = all(
        len(s) == len(shapes[0]) and s[:axis] + s[axis + 1 :] == shapes[0][:axis] + shapes[0][axis + 1 :]
        for s in shapes
    )
    need(len(kinds) == 1 and alike, f"{sorted(kinds)} of {shapes} cannot be joined along axis {axis}")
    shapes[0][axis] = sum(s[axis] for s in shapes)
    return kinds.pop(), tuple(shapes[0])


def cut(call: Call) -> Out:
    """Slice."""
    x, n = call.inputs[0], len(call.inputs)
    starts, ends = call.constant(1), call.constant(2)
    along = axes(call.constant(3) if n > 3 else range(len(starts)), len(x.shape))
    steps = call.constant(4) if n > 4 else [1] * len(starts)
    need(len(starts) == len(ends) == len(along) == len(steps), "starts, ends, axes and steps differ in number")
    need(all(s >= 1 for s in steps), f"steps {steps} must be above 0")
    shape = list(x.shape)
    for axis, start, end, step in zip(along, starts, ends, steps, strict=True):
        shape[axis] = len(range(*slice(start, end, step).indices(shape[axis])))
    return x.kind, tuple(shape)


def gather(call: Call) -> Out:
    """Gather."""
    x, at = call.inputs
    axis = call.axis(len(x.shape), 0)
    _within(at, x.shape[axis])
    return x.kind, x.shape[:axis] + at.shape + x.shape[axis + 1 :]


def _within(at: Value, size: int) -> None:
    """Where the places are constants: each is there. Else onnxruntime looks, sweep by sweep."""
    if at.numbers is not None:
        need(bool(-size <= at.numbers.min() and at.numbers.max() < size), f"a place is out of {size}")


def gather_each(call: Call) -> Out:
    """GatherElements."""
    x, at = call.inputs
    _beside(call, x, at)
    return x.kind, at.shape


def scatter(call: Call) -> Out:
    """ScatterElements."""
    x, at, new = call.inputs
    _beside(call, x, at)
    need(new.shape == at.shape and new.kind == x.kind, "places and what is put there differ in shape or type")
    need(call.given.get("reduction", b"none") in (b"none", b"add"), "reduction must be none or add")
    return x.kind, x.shape


def _beside(call: Call, x: Value, at: Value) -> None:
    """Places lie in the tensor: as many dimensions, and none larger but along the axis."""
    axis = call.axis(len(x.shape), 0)
    fits = len(x.shape) == len(at.shape) and all(
        i == axis or a <= n for i, (a, n) in enumerate(zip(at.shape, x.shape, strict=True))
    )
    need(fits, f"places of {list(at.shape)} do not fit {list(x.shape)}")
    _within(at, x.shape[axis])


def extract(call: Call) -> Out:
    """ArrayFeatureExtractor: onnxruntime reads before the array where a place is negative."""
    x, at = call.inputs
    need(at.place, "places must come from TopK or ArgMax")
    need(x.shape != (), "nothing to choose from")
    return x.kind, (*(x.shape[:-1] or (1,)), prod(at.shape))


def reshape(call: Call) -> Out:
    """Reshape."""
    x, wanted = call.inputs[0], call.constant(1)
    need(call.given.get("allowzero", 0) == 0, "allowzero must be 0")
    need(all(n > 0 or n == -1 or (n == 0 and i < len(x.shape)) for i, n in enumerate(wanted)), f"{wanted} is no shape")
    shape = [n or x.shape[i] for i, n in enumerate(wanted)]
    if -1 in shape:
        others = prod(n for n in shape if n > 0)
        shape[shape.index(-1)] = prod(x.shape) // others
    need(-1 not in shape and prod(shape) == prod(x.shape), f"{list(x.shape)} cannot become {wanted}")
    return _as(x), tuple(shape)


def flatten(call: Call) -> Out:
    """Flatten."""
    x, axis = call.inputs[0], call.given.get("axis", 1)
    need(0 <= axis <= len(x.shape), f"axis {axis} of {len(x.shape)} dimensions")
    return _as(x), (prod(x.shape[:axis]), prod(x.shape[axis:]))


def _as(x: Value) -> str:
    return PLACE if x.place else x.kind


def unsqueeze(call: Call) -> Out:
    """Unsqueeze."""
    x, new = call.inputs[0], call.constant(1)
    left = iter(x.shape)
    rank = len(x.shape) + len(new)
    at = axes(new, rank)
    return x.kind, tuple(1 if i in at else next(left) for i in range(rank))


def transpose(call: Call) -> Out:
    """Transpose."""
    x = call.inputs[0]
    order = call.given.get("perm", list(range(len(x.shape)))[::-1])
    need(sorted(order) == list(range(len(x.shape))), f"perm {order} is no order of {len(x.shape)} dimensions")
    return x.kind, tuple(x.shape[i] for i in order)


def expand(call: Call) -> Out:
    """Expand."""
    wanted = call.constant(1)
    need(all(n > 0 for n in wanted), f"{wanted} is no shape")
    return call.inputs[0].kind, together(call.inputs[0].shape, tuple(wanted))


def filled(call: Call) -> Out:
    """ConstantOfShape."""
    value = call.given.get("value", Value("float32", (1,)))
    need(value.shape == (1,) and value.kind == "float32", "value must be one float")
    return "float32", tuple(call.constant(0))


def count(call: Call) -> Out:
    """Range."""
    (start,), (end,), (step,) = (call.numbers(i, 0) for i in range(3))
    need(all(abs(n) < 1 << 31 for n in (start, end, step)) and step != 0, f"{start} to {end} in steps of {step}")
    return spread(call)[0], (max(0, -((start - end) // step)),)

"""ST-HMP, learned dictionaries: the METHOD st-hmp, a graph of pooled sparse codes with a linear
SVM.

Madry, Bo, Kragic, Fox, ICRA 2014, built on hierarchical matching pursuit: Bo, Ren, Fox, NIPS 2011
and ISER 2012. The text of 2014 was not available. From the others: a dictionary learned with K-SVD
on patches minus their means, orthogonal matching pursuit with a fixed number of atoms, codes split
by sign, the largest of each over a pyramid of cells in space and in time, each cell divided by its
length (contrast normalisation), a linear SVM.

Our adaptation is to a skin that slides instead of a hand that closes. Texture is in time, so a
patch has several frames as well as taxels. Its taxels are its channels, and the mean of each is
subtracted, as for colours in their work. The grid is hardly larger than one patch, so there is one
layer. Several axes of a taxel are adjacent columns, which a patch holds together.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto
from sklearn.svm import LinearSVC

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate_studies.peers.linear_head import train_linear_head
from palpate_train.data.sets import Dataset
from palpate_train.models.methods import Method
from palpate_train.onnx_tools.graph_builder import GraphBuilder, GraphModel, run

Array = NDArray[Any]
FRAMES, SIDE, STEP = 16, 2, 8
"""Sizes of a patch: frames, taxels along each axis, and frames from one patch to the next. They
were fixed before any data was examined, at half the length of the first kernel of the recipe's
stages. In a short window patches are half as long as the window, and no patch is wider than the
grid."""
MIN_WINDOW = 8
"""Number of frames of the shortest window."""
ATOMS, ACTIVE = 100, 4
"""Number of atoms of the dictionary, and of the code of a patch."""
SAMPLED, ROUNDS = 4000, 8
"""Number of patches that the dictionary is learned from, and rounds of K-SVD."""
MIN_RESIDUAL = 0.01
"""Smallest squared length, of 1, of an atom's part that is orthogonal to the atoms chosen before;
smaller values are raised to it, so that division is safe."""
LEVELS = (1, 2, 4)
"""Levels of the pyramid in time: parts of the window. In space there are two: the whole grid, and
its quarters."""
CONTRAST = 0.1
"""Added to a cell's squared length, as in HMP: a silent cell stays silent."""


def train(sweeps: Dataset, inputs: Array, seed: int) -> GraphModel:
    """ST-HMP and a linear SVM on `inputs`, the raw counts [N, T, R, C] of `sweeps`.

    Raises FormatError if a window is too short, or if `sweeps` are too few.
    """
    format = sweeps.require_materials().format
    if format.window < MIN_WINDOW:
        raise FormatError(
            f"a window of {format.window} frames is too short for st-hmp; record at least "
            f"{MIN_WINDOW}"
        )
    rng = np.random.default_rng(seed)
    patches = sample_patches(inputs, rng)
    scale = 1 / max(float(np.sqrt(np.mean(patches**2))), 1e-6)
    atoms = learn_dictionary(patches * scale, rng)
    return train_linear_head(pooled(format, atoms, scale), _svm, sweeps, inputs, seed)


def sample_patches(inputs: Array, rng: np.random.Generator) -> Array:
    """Patches drawn from raw counts [N, T, R, C] or [N, T, R, C, A]: float64 [SAMPLED, frames, r, c
    * A], each column minus its mean in the patch."""
    frames, (rows, cols) = (
        min(FRAMES, inputs.shape[1] // 2),
        (min(SIDE, n) for n in inputs.shape[2:4]),
    )
    margins = np.array(inputs.shape[:4]) - (1, frames, rows, cols) + 1
    corners = rng.integers(0, margins, (SAMPLED, 4))
    cut = np.stack(
        [inputs[i, t : t + frames, r : r + rows, c : c + cols] for i, t, r, c in corners]
    ).astype(np.float64)
    centred: Array = cut - cut.mean(axis=1, keepdims=True)
    return centred.reshape(*centred.shape[:3], -1)


def learn_dictionary(patches: Array, rng: np.random.Generator) -> Array:
    """K-SVD (Aharon, Elad, Bruckstein 2006) on patches [n, frames, r, c]: atoms float32 [ATOMS,
    frames, r, c].

    Each atom in turn is removed; the main direction of the residual of its patches replaces it, by
    one step of power iteration (Rubinstein, Zibulevsky, Elad 2008). An atom that no patch uses
    becomes the patch with the largest residual. Atoms have the length 1, or 0 if the patches leave
    no residual.
    """
    x = patches.reshape(len(patches), -1)
    atoms = _unit(x[rng.choice(len(x), ATOMS, replace=False)])
    for _ in range(ROUNDS):
        code = encode(patches, atoms.reshape(-1, *patches.shape[1:])).astype(np.float64)
        left = x - code @ atoms
        worst = iter(np.argsort(-np.square(left).sum(1), kind="stable"))
        for k, atom in enumerate(atoms):
            users = np.flatnonzero(code[:, k])
            if not len(users):
                atoms[k] = _unit(x[next(worst)])
                continue
            without = left[users] + np.outer(code[users, k], atom)
            atoms[k] = _unit(code[users, k] @ without)
            code[users, k] = without @ atoms[k]
            left[users] = without - np.outer(code[users, k], atoms[k])
    return atoms.reshape(-1, *patches.shape[1:]).astype(np.float32)


def encode(patches: Array, atoms: Array) -> Array:
    """Codes float32 [n, ATOMS] of patches [n, frames, r, c], by the nodes that the box runs, in one
    long sweep."""
    n, frames, rows, cols = patches.shape
    g, format = GraphBuilder(), SweepFormat(rows, cols, 1.0, n * frames, "float32")
    g("Reshape", _codes(g, format, atoms, frames, 1.0), [1, -1], output="features")
    sweep = patches.reshape(1, n * frames, rows, cols).astype(np.float32)
    return run(g.model(format, "features", n * len(atoms)), sweep).reshape(n, len(atoms))


def pooled(format: SweepFormat, atoms: Array, scale: float) -> onnx.ModelProto:
    """`sweep` -> `features` float32 [1, F]: the largest codes of each cell of the pyramids, above
    zero and below.

    atoms: [ATOMS, frames, r, c * A]. scale: from raw counts to the scale of the patches that the
    atoms were learned from.
    """
    g, steps = GraphBuilder(), (format.window - atoms.shape[1]) // STEP + 1
    rows, cols = format.rows - atoms.shape[2] + 1, format.cols - atoms.shape[3] // format.axes + 1
    codes = g("Reshape", _codes(g, format, atoms, STEP, scale), [steps, rows, cols, -1])
    both = g("Concat", codes, g("Neg", codes), axis=3)
    times = [part for level in LEVELS if level <= steps for part in _parts(steps, level)]
    spaces = {
        (r, c): None for level in (1, 2) for r in _parts(rows, level) for c in _parts(cols, level)
    }
    cells = []
    for time in times:
        during = g("ReduceMax", _cut(g, both, 0, time), axes=[0])
        for r, c in spaces:
            cells.append(
                g("ReduceMax", _cut(g, _cut(g, during, 1, r), 2, c), axes=[1, 2], keepdims=0)
            )
    above = g("Relu", g("Concat", *cells, axis=0))
    length = g("Sqrt", g("Add", g("ReduceSumSquare", above, axes=[1]), g.constant(CONTRAST)))
    g("Reshape", g("Div", above, length), [1, -1], output="features")
    return g.model(format, "features", len(cells) * 2 * len(atoms))


def _parts(n: int, parts: int) -> list[tuple[int, int]]:
    """`n` positions in this many parts (first, last + 1), which overlap by one if they do not
    divide evenly."""
    return [(i * n // parts, -(-(i + 1) * n // parts)) for i in range(parts)]


def _cut(g: GraphBuilder, x: str, axis: int, part: tuple[int, int]) -> str:
    """`x` from part[0] to part[1] along `axis`."""
    return g("Slice", x, *([n] for n in (*part, axis)))


def _codes(g: GraphBuilder, format: SweepFormat, atoms: Array, step: int, scale: float) -> str:
    """Orthogonal matching pursuit of all patches of `sweep` at once: codes [patches, ATOMS], by
    time, row, column.

    Atoms sum to zero on each taxel, so their products with a patch do not depend on its means: one
    convolution computes them. After it the pursuit needs only the products of atoms with each other
    (batch OMP; Rubinstein et al. 2008).
    """
    flat = atoms.reshape(len(atoms), -1)
    shape = [1, 1, format.window, format.rows, format.cols * format.axes]
    x = g("Cast", g("Reshape", "sweep", shape), to=TensorProto.FLOAT)
    products = g("Conv", x, g.constant(atoms[:, None] * scale), strides=[step, 1, format.axes])
    left = g("Transpose", g("Reshape", products, [len(atoms), -1]), perm=[1, 0])
    return _pursuit(g, left, flat @ flat.T)


def _pursuit(g: GraphBuilder, left: str, gram: Array) -> str:
    """Codes [n, K] from products of n patches with K atoms, `left` [n, K], and of the atoms,
    `gram` [K, K].

    The atoms that a patch chooses are made orthogonal one after another (Cholesky); a direction is
    represented by its products with all atoms. At the end the triangular system is solved from its
    last row up.
    """
    products, least, zeros = (
        g.constant(gram),
        g.constant(MIN_RESIDUAL),
        g("Mul", left, g.constant(0.0)),
    )
    chosen: list[str] = []
    directions: list[str] = []
    lengths: list[str] = []
    amounts: list[str] = []
    triangle: list[list[str]] = []
    for _ in range(ACTIVE):
        best = g("ArgMax", g("Abs", left), axis=1, keepdims=0)
        at = g("Unsqueeze", best, [1])
        beside = [g("GatherElements", direction, at, axis=1) for direction in directions]
        new = g("Gather", products, best)
        for share, direction in zip(beside, directions, strict=True):
            new = g("Sub", new, g("Mul", share, direction))
        length = g("Sqrt", g("Max", g("GatherElements", new, at, axis=1), least))
        direction = g("Div", new, length)
        amount = g("Div", g("GatherElements", left, at, axis=1), length)
        left = g("Sub", left, g("Mul", amount, direction))
        for row, value in zip(
            (chosen, directions, lengths, amounts), (at, direction, length, amount), strict=True
        ):
            row.append(value)
        triangle.append(beside)
    values = _solved(g, amounts, lengths, triangle)
    return g(
        "ScatterElements",
        zeros,
        g("Concat", *chosen, axis=1),
        g("Concat", *values, axis=1),
        axis=1,
        reduction="add",
    )


def _solved(
    g: GraphBuilder, amounts: list[str], lengths: list[str], triangle: list[list[str]]
) -> list[str]:
    """The amounts of the chosen atoms themselves, by back substitution from the amounts of
    orthogonal directions."""
    solved: dict[int, str] = {}
    for i in reversed(range(ACTIVE)):
        amount = amounts[i]
        for later, value in solved.items():
            amount = g("Sub", amount, g("Mul", triangle[later][i], value))
        solved[i] = g("Div", amount, lengths[i])
    return [solved[i] for i in range(ACTIVE)]


def _unit(vectors: Array) -> Array:
    """Vectors [..., d] at length 1; a vector of zeros stays as it is."""
    scaled: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    return scaled


def _svm(features: Array, labels: Array) -> tuple[Array, Array]:
    """Coefficients and intercepts of a linear SVM, one material against the others."""
    machine = LinearSVC(random_state=0).fit(features, labels)
    return machine.coef_, machine.intercept_


METHODS = (
    Method(
        "st-hmp",
        "codes of learned dictionaries, pooled, linear SVM (Madry et al. 2014)",
        "raw",
        train,
    ),
)

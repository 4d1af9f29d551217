"""The models with random weights that `make bench` times next to the bundle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from palpate.sim import skin
from palpate_train.data.sets import Dataset
from palpate_train.models.recipe import graph, recipe
from palpate_train.models.recipe.architectures import STAGES
from palpate_train.models.recipe.bank import LEAST_FILTERS, POOLS, Bank
from palpate_train.onnx_tools.graph_builder import with_head
from palpate_train.onnx_tools.quantize import quantize


def write(folder: Path, seed: int = 0) -> tuple[Path, Path]:
    """Write the models that `make bench` times next to the bundle: fp32.onnx and
    paper_int8.onnx, both with random weights.

    The first is a trunk like that of the packaged bundle in float32, with stages and the fewest
    filters. The second is the paper's CNN in int8. Both take sweeps of the packaged bundle.
    """
    # here: both import PyTorch
    from palpate_studies.peers.paper_cnn import INT8_NODES, random_paper_cnn
    from palpate_train.models.recipe.stages import StagesNetwork

    rng, format, classes = np.random.default_rng(seed), skin.FORMAT, len(skin.MATERIALS)
    counts = rng.integers(0, 256, (4, format.window, *format.shape), np.uint8)
    sweeps = Dataset(
        counts, np.arange(4) % classes, skin.MATERIALS, format.rate_hz, {}, "random counts"
    )
    trunk = recipe.fixed_trunk(sweeps, seed)
    stages = StagesNetwork(format, classes, trunk.scale, norm=False).weights()
    filters = Bank.of(trunk.weights)
    filters = filters.take(np.arange(len(filters))[:: len(filters) // LEAST_FILTERS])
    architecture = replace(STAGES, pools=POOLS, distribution=True, spectrum=True)
    small = graph.trunk_graph(
        format, trunk.scale, {**trunk.weights, **stages, **filters.weights()}, architecture
    )
    size = small.graph.output[0].type.tensor_type.shape.dim[1].dim_value
    small = with_head(small, rng.standard_normal((classes, size)), np.zeros(classes))
    paper = quantize(random_paper_cnn(format, classes, rng), counts, INT8_NODES)
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "fp32.onnx", folder / "paper_int8.onnx"
    for path, model in zip(paths, (small, paper), strict=True):
        path.write_bytes(model.SerializeToString())
    return paths

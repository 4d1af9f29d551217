"""A trained method that is not of our family, as `palpate-train fit --method` writes it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset
from palpate_train.models.linear_head import hold_out
from palpate_train.models.methods import Method, Model, model_inputs
from palpate_train.models.recipe.fitted import WHAT, read_sides, sides_of, write

Array = NDArray[Any]


@dataclass(frozen=True)
class MethodFit:
    """A trained method. model: its graph, of `input` as in a manifest. reference: the float graph
    of a model in int8. train, held: the training sweeps and the others, split by the group
    `held_out_by`. about: JSON, how it was made."""

    model: onnx.ModelProto
    input: str
    train: Dataset
    held: Dataset
    held_out_by: str
    about: dict[str, Any]
    reference: onnx.ModelProto | None = None

    @classmethod
    def of(cls, method: Method, sweeps: Dataset, seed: int) -> tuple[Model, Self]:
        """`method`, trained on four fifths of the positions (else recordings) of `sweeps`; the
        others test it. Raises FormatError for a method that the box cannot run."""
        if method.library:
            raise FormatError(
                f"method {method.name!r} runs in {method.library} alone and has no graph; compare "
                "it with evaluate, and fit another"
            )
        train, held, by = hold_out(sweeps, seed)
        model = method.train(train, model_inputs(method.input, train), seed)
        about = {"method": method.name, "seed": seed, "ran": getattr(model, "ran", "")}
        precisions = getattr(model, "precisions", {})
        reference = precisions["float"].graph() if "float" in precisions else None
        return model, cls(model.graph(), method.input, train, held, by, about, reference)

    def save(self, path: Path) -> None:
        """Write it as one .npz without pickle."""
        graphs = {"model": self.model} | ({"reference": self.reference} if self.reference else {})
        arrays, meta = sides_of(self.train, self.held)
        arrays |= {k: np.frombuffer(v.SerializeToString(), np.uint8) for k, v in graphs.items()}
        meta |= {"input": self.input, "held_out_by": self.held_out_by, "about": self.about}
        write(path, arrays, meta)

    @classmethod
    def read(cls, name: str, arrays: Mapping[str, Array]) -> Self:
        """What `save` wrote into the file `name`. Raises FormatError if it is not whole."""
        try:
            meta = json.loads(str(arrays["meta"]))
            graphs = {
                key: onnx.load_from_string(arrays[key].tobytes())
                for key in ("model", "reference")
                if key in arrays
            }
            return cls(
                graphs["model"],
                meta["input"],
                *read_sides(arrays, meta),
                meta["held_out_by"],
                meta["about"],
                graphs.get("reference"),
            )
        except (KeyError, ValueError, TypeError) as e:
            raise FormatError(f"{name}: not {WHAT}; fit again: {e}") from e

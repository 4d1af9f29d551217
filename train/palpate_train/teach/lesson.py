"""The sweeps that a box is taught from: a folder of its recordings.

A person records next to a robot, so a folder may hold sweeps that training from a desktop would
refuse as a whole: without a material, of another format, damaged, or without a position that others
have. Such sweeps are left out and counted, or completed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.slide_check import SlidesAmong
from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate.sweeps.sweep_folder import (
    NOT_THIS,
    NoSlide,
    RecordedSweep,
    slides_alone,
    taught,
)
from palpate_train.data import labels, readers
from palpate_train.data.sets import Dataset

NOWHERE = "not named"
"""Position or session of a sweep without one, among sweeps that have one."""


@dataclass(frozen=True, eq=False)
class Lesson:
    """Sweeps to learn from. names: of the file of each sweep [N], without suffix. left_out: number
    of sweeps that are not among them, by reason. no_slides: the ones that are not slides.
    unchecked: what could not be seen of that, "" if all. strangers: raw counts [n, T, R, C] or [n,
    T, R, C, A] of sweeps over other things; None without any."""

    sweeps: Dataset
    names: tuple[str, ...]
    left_out: Mapping[str, int]
    no_slides: tuple[NoSlide, ...] = ()
    unchecked: str = ""
    strangers: NDArray[Any] | None = None

    @classmethod
    def read(cls, folder: Path) -> Lesson:
        """The sweeps in `folder`. Raises FormatError if there is none, or if a label cannot be
        sent."""
        readers.check_folder(folder)
        left_out: Counter[str] = Counter()
        of_both: tuple[list[RecordedSweep], list[RecordedSweep]] = [], []
        for one in taught(folder, left_out):
            of_both[one.sweep.material == NOT_THIS].append(one)
        if not of_both[0]:
            why = f" ({readers.counted(left_out)})" if left_out else ""
            raise FormatError(f"{folder}: no sweep can be taught{why}; record some with a material")
        wanted = of_both[0][-1].format
        kept, others = (_of_format(wanted, sweeps, left_out) for sweeps in of_both)
        check = SlidesAmong(kept[0].format)
        slides, unchecked = check.among(
            (one.sweep.frames.taxels for one in kept), [one.sweep.material for one in kept]
        )
        kept, no_slides = slides_alone(kept, slides)
        left_out |= {"no slide": len(no_slides)} if no_slides else {}
        sweeps = readers.from_recorded(readers.named(kept, NOWHERE), folder, Dataset)
        names = tuple(one.path.stem for one in kept)
        strangers = np.stack([one.sweep.frames.taxels for one in others]) if others else None
        return cls(labels.check(sweeps), names, left_out, no_slides, unchecked, strangers)

    @property
    def _beside(self) -> str:
        """The last sweep that is not a slide, as the end of a message."""
        return f" ({self.no_slides[-1].text})" if self.no_slides else ""

    def repeated(self) -> Lesson:
        """Only materials with two sweeps or more, which can be judged. Raises FormatError if fewer
        than two are left."""
        counts = np.bincount(self.sweeps.labels)
        many = np.flatnonzero(counts >= 2)
        if len(many) < 2:
            raise FormatError(
                f"{len(many)} of the materials have two sweeps or more, and a model tells at least "
                f"two apart; record two of another material{self._beside}"
            )
        kept = np.isin(self.sweeps.labels, many)
        part = self.sweeps.take(kept)
        part = replace(
            part,
            labels=np.searchsorted(many, part.labels),
            materials=tuple(part.materials[k] for k in many),
        )
        names = tuple(name for name, keep in zip(self.names, kept, strict=True) if keep)
        return replace(self, sweeps=part, names=names)


def _of_format(
    wanted: SweepFormat, sweeps: Sequence[RecordedSweep], left_out: Counter[str]
) -> list[RecordedSweep]:
    """The sweeps of this format; the others are counted."""
    same = [one for one in sweeps if one.format == wanted]
    left_out += Counter({"another format": len(sweeps) - len(same)})
    return same

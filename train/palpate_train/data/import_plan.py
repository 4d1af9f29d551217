"""The options of an import: how files become sweeps."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from palpate.core.errors import FormatError
from palpate.core.types import DATA_TYPES
from palpate_train.data import sampling
from palpate_train.data.file_names import NamePattern
from palpate_train.data.label_table import LabelTable

GRID = re.compile(r"[1-9]\d{0,2}x[1-9]\d{0,2}(x[1-8])?")
LENGTH = re.compile(r"(\d+(?:\.\d+)?)(ms|s)|([1-9]\d*)")
AXES = ("frame", "row", "column", "axis", "taxel")
"""Names of the axes of an array. A taxel is a place of the grid, read row by row."""
DATE = "date"
"""The unit of times that are written as dates."""


def grid_shape(grid: str) -> tuple[int, ...]:
    """Rows, columns, and axes if there are several, of a --grid; () without one. Raises
    FormatError."""
    if grid and not GRID.fullmatch(grid):
        raise FormatError(
            f"--grid {grid} cannot be read; write ROWSxCOLUMNS or ROWSxCOLUMNSxAXES: 4x4, 4x4x3"
        )
    sizes = tuple(map(int, grid.split("x"))) if grid else ()
    return sizes[:2] if sizes[2:] == (1,) else sizes


@dataclass(frozen=True)
class Length:
    """A length of time, in seconds, milliseconds or frames. option: its name in error messages.

    Raises FormatError if the text is not a length.
    """

    text: str
    option: str

    def __post_init__(self) -> None:
        if not (found := LENGTH.fullmatch(self.text)) or not float(found[1] or found[3]):
            raise FormatError(
                f"{self.option} {self.text} cannot be read; "
                "write 2s, 500ms, or a number of frames, 1500"
            )

    def frames(self, rate_hz: float) -> int:
        """The length in frames, at least 1."""
        found = LENGTH.fullmatch(self.text)
        assert found
        if found[3]:
            return int(found[3])
        return max(round(float(found[1]) * rate_hz * (1e-3 if found[2] == "ms" else 1)), 1)


@dataclass(frozen=True)
class ImportPlan:
    """How files become sweeps; each attribute is an option of `palpate-train import`.

    pattern: None takes every file; then `fields` must say where the material stands.
    grid: ROWSxCOLUMNS or ROWSxCOLUMNSxAXES, "" if the arrays already have that shape.
    columns: the taxels' columns, "" for all numbers except the time.
    time: COLUMN:UNIT; rate_hz: frames per second. One of the two is needed.
    every: from the start of one window to the start of the next; None takes only the middle
    window.
    dtype: data type of the counts, "" to keep the recorded type.
    variable: the array to read from a file with several; a pattern in braces reads each array whose
    name matches as a recording with these fields.
    transpose: whether files hold taxels x frames.
    renames: new names of materials by their old names.
    axes: the axes of the arrays in their order, names of AXES with commas; "" if the shape must
    show them.
    decimal: the decimal sign of texts, "" if each text must show it.
    fields: columns that hold a field of every frame, such as material or session, by field.
    labels: fields of each file, see label_table; empty without one.
    Raises FormatError if an option cannot be read.
    """

    pattern: NamePattern | None
    grid: str = ""
    columns: str = ""
    time: str = ""
    rate_hz: float | None = None
    window: Length = Length("2s", "--window")
    every: Length | None = None
    dtype: str = ""
    variable: str = ""
    transpose: bool = False
    renames: Mapping[str, str] = field(default_factory=dict)
    axes: str = ""
    decimal: str = ""
    fields: Mapping[str, str] = field(default_factory=dict)
    labels: LabelTable = field(default_factory=dict)

    def __post_init__(self) -> None:
        _ = self.shape
        if not self.time and not self.rate_hz:
            raise FormatError(
                "the frame rate is not known; give --rate HZ, or --time COLUMN:UNIT if a column "
                "holds times"
            )
        if self.time and self.time.rpartition(":")[2] not in (*sampling.UNITS_S, DATE):
            raise FormatError(
                f"--time {self.time} names no unit; "
                f"write {self.time}:s, :ms, :us, :ns, :min, :h or :d, or :{DATE} for dates with a "
                "clock time"
            )
        if self.dtype and self.dtype not in DATA_TYPES:
            raise FormatError(
                f"--dtype {self.dtype} is unknown; use one of {', '.join(DATA_TYPES)}"
            )
        if self.decimal not in ("", ".", ","):
            raise FormatError(f"--decimal {self.decimal} is unknown; use . or ,")
        self._check_axes()
        self._check_fields()
        _ = self.variables

    def _check_axes(self) -> None:
        names = self.axes.split(",") if self.axes else []
        bad = [name for name in names if name not in AXES or names.count(name) > 1]
        if bad or (names and "frame" not in names):
            raise FormatError(
                f"--axes {self.axes} cannot be read; name each axis of the array once: "
                "row,column,frame or frame,row,column,axis or taxel,frame"
            )
        if names and self.transpose:
            raise FormatError("--axes already says where the frames stand; leave --transpose out")

    def _check_fields(self) -> None:
        in_names = self.names[: len(self.names) - len(self.fields)]
        if "material" not in (*in_names, *self.fields):
            given = (f" in {one.option} {one.text!r}" for one in self.patterns)
            raise FormatError(
                f"where the material stands is not known{' and'.join(given)}; give --pattern or "
                "--variable with {material}, --labels FILE with a column material, or --field "
                "material=COLUMN if a column holds it"
            )
        if both := [name for name in in_names if in_names.count(name) > 1]:
            raise FormatError(
                f"{both[0]} stands in two of --pattern and --variable and --labels; call one of "
                "them something else"
            )
        if twice := [name for name in in_names if name in self.fields]:
            raise FormatError(
                f"{twice[0]} stands in --field and in a name or in --labels; give one of them"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, columns, and axes if there are several; () without --grid."""
        return grid_shape(self.grid)

    @property
    def order(self) -> tuple[str, ...]:
        """The axes that --axes or --transpose gives, () without them."""
        if self.transpose:
            return "taxel", "frame"
        return tuple(self.axes.split(",")) if self.axes else ()

    @property
    def names(self) -> list[str]:
        """The names of all fields of a recording."""
        in_names = (name for one in self.patterns for name in one.names)
        return [*in_names, *self.labelled, *self.fields]

    @property
    def of_files(self) -> tuple[str, ...]:
        """The names of the fields that are known before a file is read."""
        return (*(self.pattern.names if self.pattern else ()), *self.labelled)

    @property
    def labelled(self) -> tuple[str, ...]:
        """The names of the fields in the table of labels."""
        return tuple(next(iter(self.labels.values()), {}))

    @property
    def variables(self) -> NamePattern | None:
        """The pattern of --variable, None if it is a name. Raises FormatError if it cannot be
        read."""
        if "{" not in self.variable:
            return None
        return NamePattern(self.variable, "--variable")

    @property
    def patterns(self) -> list[NamePattern]:
        """The patterns of --pattern and --variable."""
        return [one for one in (self.pattern, self.variables) if one]

    def pattern_of(self, name: str) -> NamePattern | None:
        """The pattern that has the field `name`, None if a column has it."""
        return next((one for one in self.patterns if name in one.names), None)

"""Outputs the verdict as a class code on GPIO lines: class bits and RESULT VALID. Separate from
gpio_lines.py, which must not import numpy, since `cli.lower_outputs` needs to start fast."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.core.errors import ConfigError
from palpate.core.observer import Observer
from palpate.core.types import Status, Verdict
from palpate.io.gpio_lines import Lines


class LineSink(Observer):
    """Outputs the verdict as a code: 1 + the label's index in the manifest, or 0."""

    def __init__(self, lines: Lines, labels: Sequence[str]) -> None:
        check_bits(lines.capacity, labels)
        self._lines = lines
        self._code = {label: i + 1 for i, label in enumerate(labels)}

    def answered(self, verdict: Verdict) -> None:
        """Output the code and raise RESULT VALID."""
        self._lines.result(self._code[verdict.label] if verdict.status is Status.OK else 0)


def check_bits(codes: int, labels: Sequence[str]) -> None:
    """Raises ConfigError if `codes` are too few for the labels and the code 0."""
    if codes <= len(labels):
        needed = f"{len(labels)} labels and the code 0 do not fit output.class_bits"
        raise ConfigError(f"{needed}, which have {codes} codes; wire more GPIO lines, or none")

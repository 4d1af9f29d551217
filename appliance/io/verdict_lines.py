"""The verdict as a code on GPIO lines. In: verdicts. Out: class bits and RESULT VALID on Lines.

Apart from gpio_lines.py, which must not load numpy: the lines are lowered with it before a robot has noticed.
"""

from __future__ import annotations

from collections.abc import Sequence

from appliance.core.errors import ConfigError
from appliance.core.types import Status, Verdict
from appliance.io.gpio_lines import Lines


class LineSink:
    """The verdict as a code on GPIO: 0 where there is no sure label, else 1 + its place in the manifest."""

    def __init__(self, lines: Lines, labels: Sequence[str]) -> None:
        check_bits(lines.capacity, labels)
        self._lines = lines
        self._code = {label: i + 1 for i, label in enumerate(labels)}

    def send(self, verdict: Verdict) -> None:
        """Show the code and raise RESULT VALID."""
        self._lines.result(self._code[verdict.label] if verdict.status is Status.OK else 0)


def check_bits(codes: int, labels: Sequence[str]) -> None:
    """Raises ConfigError where so many codes cannot tell the labels apart, and 0 beside them."""
    if codes <= len(labels):
        raise ConfigError(
            f"{len(labels)} labels and the code 0 do not fit output.class_bits, which tell {codes} apart; "
            "wire more lines, or none"
        )

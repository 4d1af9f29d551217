"""Which skin there is. In: settings and devices. Out: the form of its sweeps, before there is a bundle."""

from __future__ import annotations

import re
from contextlib import closing

from appliance.core.config import SensorConfig
from appliance.core.devices import Devices
from appliance.core.errors import ConfigError, FormatError, SensorMismatch
from appliance.core.types import SweepFormat
from appliance.io import usb_sensor

WINDOW_S = 2.0
"""Length of a sweep's window where nothing else is asked for (paper, sec. II.B)."""
_FORM = re.compile(r"(\d{1,9})x(\d{1,9})(?:x(\d{1,9}))?:(\w+):(\d{1,9}(?:\.\d+)?)", re.ASCII)


def described(text: str) -> SweepFormat:
    """The form that a person describes as ROWSxCOLUMNS[xAXES]:TYPE:RATE, for example "5x3:float32:100". Raises
    ConfigError."""
    found = _FORM.fullmatch(text.strip())
    if not found:
        raise ConfigError(
            f"--format {text}: not understood; give rows x columns (x axes), data type and frames per second, "
            "for example 5x3:float32:100 or 4x4x3:int16:250"
        )
    rows, cols, axes, dtype, rate = found.groups()
    try:
        return _form(int(rows), int(cols), dtype, float(rate), int(axes or 1))
    except FormatError as e:
        raise ConfigError(f"--format {text}: {e}") from e


def announced(settings: SensorConfig, devices: Devices) -> SweepFormat:
    """The form that the skin announces, with a window of WINDOW_S. Raises SensorError if there is none that does."""
    with closing(usb_sensor.open_link(settings, devices.backend, devices.clock)) as board:
        _, skin = usb_sensor.ask(board)
    try:
        return _form(skin.rows, skin.cols, skin.dtype, skin.rate_hz, skin.axes)
    except FormatError as e:
        raise SensorMismatch(f"the skin announces a form that cannot be: {e}; check its firmware") from e


def _form(rows: int, cols: int, dtype: str, rate_hz: float, axes: int) -> SweepFormat:
    return SweepFormat(rows, cols, rate_hz, max(1, round(WINDOW_S * rate_hz)), dtype, axes)

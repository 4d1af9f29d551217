"""The skin of a box: its profile, its sensor, and the format of its sweeps."""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from palpate.core.config import Config, SkinConfig
from palpate.core.devices import Devices
from palpate.core.errors import ConfigError, FormatError, SensorAbsent, SensorMismatch
from palpate.core.settings_files import SITE
from palpate.core.types import SweepFormat
from palpate.io import skin_profile
from palpate.io.sensor import SkinLink, TransferObserver
from palpate.io.skin_profile import SkinProfile
from palpate.io.usb_sensor import LinkSensor, UsbSensor, ask, open_link

OWN = SITE.parent / "skins"
"""Profiles written by the owner of the box. They replace delivered profiles of the same name."""
_DESCRIPTION = re.compile(r"(\d{1,9})x(\d{1,9})(?:x(\d{1,9}))?:(\w+):(\d{1,9}(?:\.\d+)?)", re.ASCII)


def folders(settings: Config) -> list[Path]:
    """Folders of profiles; the first that has a profile has priority."""
    return list(dict.fromkeys((OWN, settings.folder / "skins")))


def profile(settings: Config) -> SkinProfile:
    """The profile that the settings name, with their changes. Raises ConfigError."""
    return skin_profile.adapted(
        skin_profile.load(settings.skin.profile, folders(settings)), settings.skin
    )


def sensor(
    settings: Config, format: SweepFormat, devices: Devices, tap: TransferObserver | None = None
) -> LinkSensor:
    """The sensor of the settings, for sweeps of `format`. Raises ConfigError."""
    chosen = profile(settings)
    if chosen.codec == "palpate":
        return UsbSensor(_config(settings, chosen), format, devices.clock, devices.backend, tap)
    # boxes whose skin speaks PROTOCOL.md do without these modules
    from palpate.io.serial_sensor import SerialSensor, opener

    opened = opener(devices.clock, devices.wait, chosen)
    return SerialSensor(settings.skin, chosen, format, devices.clock, tap, open_port=opened)


def open_readout(settings: Config, devices: Devices) -> SkinLink:
    """The opened board of a skin of PROTOCOL.md. Raises ConfigError, SensorError."""
    chosen = profile(settings)
    if chosen.codec != "palpate":
        raise ConfigError(
            f'skin.profile = "{settings.skin.profile}" (codec "{chosen.codec}") does not speak'
            " PROTOCOL.md; `palpate check` tests this skin"
        )
    return open_link(_config(settings, chosen), devices.backend, devices.clock)


def announced(settings: Config, devices: Devices, wanted: SweepFormat | None = None) -> SweepFormat:
    """The format of the skin's sweeps without a bundle: as announced by the readout board or
    written in the profile, with a window of skin_profile.WINDOW_S. wanted: its rate is used if the
    skin can be set to it.

    Raises ConfigError, or SensorError if the readout board cannot be asked.
    """
    chosen = profile(settings)
    if chosen.codec != "palpate":
        if wanted and wanted.rate_hz in chosen.rates_hz:
            chosen = replace(chosen, rate_hz=wanted.rate_hz)
        return chosen.format
    try:
        board = open_readout(settings, devices)
    except SensorAbsent as e:
        hint = "or name another skin with --skin; `palpate skin detect` says which"
        raise SensorAbsent(f"{e}, {hint}") from e
    with closing(board):
        skin = ask(board)[1]
    try:
        return skin_profile.with_window(skin.rows, skin.cols, skin.rate_hz, skin.dtype, skin.axes)
    except FormatError as e:
        raise SensorMismatch(f"the skin's format is invalid: {e}; check its firmware") from e


def described(text: str) -> SweepFormat:
    """The format ROWSxCOLUMNS[xAXES]:TYPE:RATE, as "5x3:float32:100". Raises ConfigError."""
    found = _DESCRIPTION.fullmatch(text.strip())
    if not found:
        raise ConfigError(
            f"--format {text}: not understood; give rows x columns (x axes), type and rate, for"
            " example 5x3:float32:100 or 4x4x3:int16:250"
        )
    rows, cols, axes, dtype, rate = found.groups()
    try:
        return skin_profile.with_window(int(rows), int(cols), float(rate), dtype, int(axes or 1))
    except FormatError as e:
        raise ConfigError(f"--format {text}: {e}") from e


def _config(settings: Config, chosen: SkinProfile) -> SkinConfig:
    return replace(settings.skin, baud=chosen.baud)

"""Skin profiles: TOML files that describe the bytes of a skin, read into a checked SkinProfile. The
fields of SkinProfile are the schema; firmware_config/skins/matrix.toml explains each for users."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Literal

from palpate.core.config import SkinConfig
from palpate.core.errors import ConfigError
from palpate.core.schema import Within, custom, keys, read_table
from palpate.core.settings_files import read_toml
from palpate.core.text import closest, shown
from palpate.core.types import DATA_TYPES, MOST_AXES, SweepFormat
from palpate.io import checksums, wire_numbers

DEFAULT = "palpate"
"""The profile of PROTOCOL.md, whose readout board announces grid, type and rate."""
WINDOW_S = 2.0
"""Length of a sweep's window if no other is set (paper, sec. II.B)."""
FEW_FRAMES = 200
"""A window with fewer frames gets a warning. At 100 Hz, vibrations up to 50 Hz are visible: at
20 mm/s a texture with ridges 0.4 mm apart, about the finest that feels rough to a hand. Materials
with finer textures then differ only by stiffness and shape."""
SLIDE_MM_S = 20
"""Speed of sliding at which the warning computes the finest texture."""
MARKS = ("sequence", "time", "checksum")
"""Abilities that a skin may lack."""
NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
"""Valid names of profiles, and so of their files."""
_GRID = re.compile(r"([1-9][0-9]{0,2})x([1-9][0-9]{0,2})")
_USB_ID = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})")
_BYTE = rf"([0-9a-fA-F]{{2}}|{{(period_ms|bytes|{'|'.join(checksums.NAMED)})}})"
_COMMAND = re.compile(rf"(?s:(?=.{{1,128}}\Z)((?!hex:).*|hex:(\s*{_BYTE})+\s*))", re.ASCII)
_NEEDED = ("about", "source", "codec")


def _hexadecimal(most: int) -> Any:
    def read(value: Any) -> bytes | None:
        try:
            data = bytes.fromhex(value) if isinstance(value, str) else None
        except ValueError:
            return None
        return data if data is not None and len(data) <= most else None

    return custom(b"", f'up to {most} bytes in hexadecimal, such as "aa 55"', read)


def _several(allowed: str, form: re.Pattern[str]) -> Any:
    def read(value: Any) -> tuple[str, ...] | None:
        texts = value if isinstance(value, list) else [None]
        good = all(isinstance(text, str) and form.fullmatch(text) for text in texts)
        return tuple(map(str, texts)) if good else None

    return custom((), allowed, read)


def _checksum() -> Any:
    def read(value: Any) -> str | None:
        fits = isinstance(value, str) and (not value or checksums.parsed(value))
        return value if fits else None

    names = ", ".join(checksums.NAMED)
    return custom("", f'"", {names}, or parameters: "crc8 poly=1d init=ff xorout=00"', read)


def _number() -> Any:
    types = ", ".join(f'"{kind}"' for kind in wire_numbers.TYPES)
    several = 'or one for each value of a taxel: "int8 int8 uint8"'
    return custom("uint8", f"one of {types}, {several}", wire_numbers.known)


@dataclass(frozen=True, slots=True)
class SkinProfile:
    """The bytes that a skin sends; the template matrix.toml explains each field. rows, cols: before
    the turns of `orientation`. Raises ConfigError for values that contradict each other."""

    about: str = ""
    source: str = ""
    measured: str = ""
    unit: Annotated[str, Within(0, 16)] = ""
    codec: Literal[
        "palpate", "fixed", "text", "papillarray", "xela-can", "robotiq-tsf", "segments", "modbus"
    ] = "palpate"
    usb_ids: tuple[str, ...] = _several('USB ids such as ["1a86:7523"]', _USB_ID)
    baud: Annotated[int, Within(1200, 4_000_000)] = 115200
    start: tuple[str, ...] = _several('commands such as ["f{rate}\\n"] or ["hex:9a 00"]', _COMMAND)
    poll: tuple[str, ...] = _several('commands such as ["r"] or ["hex:01 42"]', _COMMAND)
    stop: tuple[str, ...] = _several('commands such as ["stop\\n"] or ["hex:9a 00"]', _COMMAND)
    tare: tuple[str, ...] = _several('commands such as ["z\\n"]', _COMMAND)
    tare_s: Annotated[float, Within(0.0, 60.0)] = 0.0
    marker: bytes = _hexadecimal(16)
    trailer: bytes = _hexadecimal(16)
    skip_before: Annotated[int, Within(0, 4096)] = 0
    skip_after: Annotated[int, Within(0, 4096)] = 0
    sequence: Literal["", "uint8", "uint16", "uint32"] = ""
    sequence_at: Annotated[int, Within(0, 1 << 20)] = 0
    sequence_order: Literal["", "little", "big"] = ""
    checksum: str = _checksum()
    checksum_from: Annotated[int, Within(0, 4096)] = 0
    checksum_order: Literal["", "little", "big"] = ""
    index: Annotated[str, Within(0, 64)] = ""
    index_at: Annotated[int, Within(0, 4096)] = 0
    length: Literal["", "uint8", "uint16", "uint32"] = ""
    length_at: Annotated[int, Within(0, 4096)] = 0
    length_of: Literal["bytes", "numbers"] = "bytes"
    segment: Annotated[int, Within(0, 1 << 16)] = 0
    zeros: bool = False
    unit_id: Annotated[int, Within(0, 255)] = 1
    function: Literal[3, 4] = 3
    register: Annotated[int, Within(0, 65535)] = 0
    lines: Literal["rows", "frames", "taxels"] = "rows"
    skip_columns: tuple[Annotated[int, Within(0, 4095)], ...] = ()
    prefix: Annotated[str, Within(0, 64)] = ""
    around: Annotated[str, Within(0, 16384)] = ""
    decimal: Literal[".", ","] = "."
    line_end: Literal["\n", "\r"] = "\n"
    number: str = _number()
    byte_order: Literal["little", "big"] = "little"
    rows: Annotated[int, Within(1, 255)] = 4
    cols: Annotated[int, Within(1, 255)] = 4
    values: Annotated[int, Within(1, 64)] = 1
    take: tuple[Annotated[int, Within(0, 63)], ...] = (0,)
    orientation: tuple[Literal["transpose", "flip-rows", "flip-columns"], ...] = ()
    rate_hz: Annotated[float, Within(0.1, 100_000.0)] = 100.0
    rates_hz: tuple[Annotated[float, Within(0.1, 100_000.0)], ...] = ()

    def __post_init__(self) -> None:
        if why := _contradiction(self):
            raise ConfigError(why)

    @property
    def ids(self) -> list[tuple[int, int]]:
        """USB ids (vendor, product) of its port."""
        return [(int(one[:4], 16), int(one[5:], 16)) for one in self.usb_ids]

    @property
    def lacks(self) -> tuple[str, ...]:
        """The MARKS that its frames lack. Without a sequence losses cannot be seen."""
        has: tuple[str, ...] = MARKS if self.codec in ("palpate", "papillarray") else ()
        if self.codec == "modbus":
            has = ("checksum",)
        if self.codec in ("fixed", "segments"):
            has = ("sequence",) * bool(self.sequence) + ("checksum",) * bool(self.checksum)
        return tuple(mark for mark in MARKS if mark not in has)

    @property
    def body(self) -> int:
        """Bytes of the numbers of a frame on the wire."""
        return self.numbers * wire_numbers.size(self.number)

    @property
    def numbers(self) -> int:
        """Numbers of a frame on the wire."""
        return self.rows * self.cols * self.values

    @property
    def data_type(self) -> str:
        return wire_numbers.data_type(self.number)

    @property
    def format(self) -> SweepFormat:
        """The format of its sweeps, rows along the sliding, a window of WINDOW_S."""
        turned = "transpose" in self.orientation
        grid = (self.cols, self.rows) if turned else (self.rows, self.cols)
        return with_window(*grid, self.rate_hz, self.data_type, len(self.take))

    def commands(self, texts: Sequence[str], rate_hz: float) -> list[bytes]:
        """Commands as bytes. {rate} becomes frames per second in decimal, {period_ms} milliseconds:
        decimal in a text, one byte in a command that begins with hex:. There, {bytes} becomes
        the size of a frame's numbers, and {crc8} or another name this checksum of all bytes before.
        """
        period = max(1, min(255, round(1000 / rate_hz)))
        return [
            self._binary(text[4:].replace("{period_ms}", f"{period:02x}"))
            if text.startswith("hex:")
            else text.replace("{rate}", f"{rate_hz:g}")
            .replace("{period_ms}", str(period))
            .encode("latin-1", "replace")
            for text in texts
        ]

    def _binary(self, text: str) -> bytes:
        body = self.body.to_bytes(2, self.byte_order)
        before, sign, after = text.replace("{bytes}", body.hex()).rpartition("{")
        if not sign:
            return bytes.fromhex(after)
        data = self._binary(before)
        name, _, rest = after.partition("}")
        checksum = checksums.NAMED[name]
        order = self.checksum_order or self.byte_order
        order = "little" if self.codec == "modbus" else order
        return data + checksum.of(data).to_bytes(checksum.size, order) + bytes.fromhex(rest)

    def json(self) -> dict[str, Any]:
        """All fields by name, for JSON; `from_json` reads them."""
        return {
            name: value.hex() if isinstance(value, bytes) else value
            for name, value in asdict(self).items()
        }


_KEYS = keys(SkinProfile)
_BINARY = ("fixed", "segments")
_OF_CODEC = {
    "marker trailer skip_before skip_after": _BINARY,
    "checksum checksum_from checksum_order": _BINARY,
    "sequence sequence_at sequence_order": ("fixed",),
    "length length_at length_of segment zeros index_at": ("segments",),
    "index": ("segments", "text"),
    "unit_id function register": ("modbus",),
    "skip_columns prefix around decimal line_end": ("text",),
}
"""Keys that belong to some codecs."""
_VALUES = {"papillarray": (6, "float32"), "xela-can": (3, "uint16"), "robotiq-tsf": (1, "uint16")}
"""Numbers of a taxel and their type, in the codecs that define them."""


def _contradiction(p: SkinProfile) -> str:
    """The contradiction between these values, "" for none."""
    if p.codec == "fixed" and not (p.marker or p.trailer):
        return 'codec = "fixed" needs a marker or a trailer; give one, or take "text"'
    for names, codecs in _OF_CODEC.items():
        wrong = [n for n in names.split() if getattr(p, n) != _KEYS[n].default]
        if wrong and p.codec not in codecs:
            only = " and ".join(f'codec = "{codec}"' for codec in codecs)
            return f'only {only} has {" and ".join(wrong)}; remove it from "{p.codec}"'
    if why := _outside(p) or _of_parts(p) or _of_numbers(p):
        return why
    if p.codec == "palpate" and (p.usb_ids or p.start or p.stop or p.tare or p.poll):
        return (
            'usb_ids, start, stop, poll and tare are not for codec = "palpate"; see skin.link,'
            " skin.usb"
        )
    if p.codec == "robotiq-tsf" and p.rows * p.cols not in (28, 56):
        sizes = "neither one finger (7 x 4) nor two (14 x 4)"
        return f"{p.rows} x {p.cols} taxels are {sizes}; correct rows and cols"
    return ""


def _of_numbers(p: SkinProfile) -> str:
    """Why the numbers of a taxel do not fit, "" if they do."""
    kinds = len(p.number.split())
    if kinds not in (1, p.values):
        return f'number = "{p.number}" has {kinds} types for {p.values} values; give one for each'
    binary = (*_BINARY, "modbus")
    if p.codec not in binary and any(kind not in DATA_TYPES for kind in p.number.split()):
        return f'number = "{p.number}" is for codec = "fixed"; write number = "float32"'
    if p.codec == "modbus" and wire_numbers.size(p.number) not in (2, 4):
        return f'number = "{p.number}" fills no register; write number = "uint16"'
    take = {*p.take}
    if not 0 < len(p.take) == len(take) <= MOST_AXES or max(take) >= p.values:
        allowed = f"1 to {MOST_AXES} different ones of 0 to {p.values - 1}"
        return f"take = {list(p.take)} is not {allowed}; number the wanted values"
    if p.codec in _VALUES and (p.values, p.number) != _VALUES[p.codec]:
        values, kind = _VALUES[p.codec]
        return f'codec = "{p.codec}" needs values = {values} and number = "{kind}"'
    return ""


def _of_parts(p: SkinProfile) -> str:
    """The contradiction between keys of parts, "" for none."""
    if p.codec == "text":
        if p.prefix and (p.index or p.lines == "rows"):
            wanted = "write it into index" if p.index else 'set lines = "frames"'
            return f'prefix = "{p.prefix}" needs a frame on each line; {wanted}'
        if p.index and p.index.count("#") not in (1, 2):
            return f'index = "{p.index}" needs # for the number of the line; write "R#:" or "#,"'
        if p.lines == "taxels" and not p.index:
            return 'lines = "taxels" needs the number of a taxel; give its place, as index = "#,"'
        if p.index and p.lines == "frames":
            return f'index = "{p.index}" needs a part on each line; set lines = "rows" or "taxels"'
    if p.codec != "segments":
        return ""
    if not p.marker:
        return 'codec = "segments" needs a marker; give the bytes that begin a part'
    if p.index not in ("", *FIELD_BYTES):
        return f'index = "{p.index}" is no type; write one of {", ".join(FIELD_BYTES)}'
    for key, kind, at in (("index", p.index, p.index_at), ("length", p.length, p.length_at)):
        if kind and at + FIELD_BYTES[kind] > p.skip_before:
            return f"{key}_at = {at} is among the numbers; count its bytes in skip_before"
    if p.segment not in (0, p.numbers) and not p.index:
        return f"segment = {p.segment} needs the type of a part's number; give one as index"
    if p.zeros and ("float" in p.number or " " in p.number):
        return f'number = "{p.number}" has no runs of zeros; write zeros = false'
    if p.segment > p.numbers:
        return f"segment = {p.segment} is more than a frame of {p.numbers}; correct rows and cols"
    return ""


FIELD_BYTES = {"uint8": 1, "uint16": 2, "uint32": 4}
"""Bytes of a length or of the number of a part."""


def _outside(p: SkinProfile) -> str:
    """Why a part of a frame of fixed length lies where it cannot lie, "" if none does."""
    end = p.skip_before + p.body
    if p.codec != "fixed":
        end = 1 << 20  # parts of a frame differ in length
    if p.sequence_at and not p.sequence:
        return 'sequence_at needs the type of the count; give one, such as sequence = "uint8"'
    if not (p.sequence_at <= p.skip_before or end <= p.sequence_at <= end + p.skip_after):
        allowed = f"0 to skip_before ({p.skip_before}), or {end} to {end + p.skip_after}"
        return f"sequence_at = {p.sequence_at} is among the numbers; use {allowed}"
    if p.checksum_from and not p.checksum:
        return 'checksum_from needs a checksum; give one, such as checksum = "crc8"'
    if p.checksum_from >= len(p.marker) + end + p.skip_after:
        return f"checksum_from = {p.checksum_from} is behind the numbers; 0 is the whole frame"
    return ""


PALPATE = SkinProfile()
"""The profile that is used if no file defines another."""


def load(name: str, folders: Sequence[Path]) -> SkinProfile:
    """The profile NAME.toml in the first folder that has it. DEFAULT needs no file. A name that
    ends in .toml is a path. Raises ConfigError with the file, the key, the value and the allowed
    values."""
    there = {name: Path(name)} if name.endswith(".toml") else names(folders)
    if name == DEFAULT and name not in there:
        return PALPATE
    if name not in there:
        near = closest(name, there)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(there) or 'none'}"
        where = " or ".join(map(str, folders))
        raise ConfigError(f"skin.profile = {shown(name)} has no profile in {where}; {hint}")
    path = there[name]
    return _made(read_toml(path), str(path))


def from_json(table: Any, where: str) -> SkinProfile:
    """The profile that `json` wrote, checked like a file. Raises ConfigError."""
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: {shown(table)} is not a skin profile; record with one")
    return _made(table, where)


def _made(table: dict[str, Any], where: str) -> SkinProfile:
    values = read_table(_KEYS, table, where)
    missing = next((name for name in _NEEDED if not values.get(name)), None)
    if missing:
        raise ConfigError(f"{where}: {missing} is missing; matrix.toml explains each key")
    try:
        return SkinProfile(**values)
    except ConfigError as e:
        raise ConfigError(f"{where}: {e}") from e


def names(folders: Sequence[Path]) -> dict[str, Path]:
    """The profiles in these folders, by name; the first folder has priority."""
    found: dict[str, Path] = {}
    for folder in folders:
        for path in sorted(folder.glob("*.toml")):
            if NAME.fullmatch(path.stem):
                found.setdefault(path.stem, path)
    return found


def adapted(profile: SkinProfile, config: SkinConfig) -> SkinProfile:
    """The profile with skin.grid and skin.rate_hz. Raises ConfigError."""
    if profile.codec == "palpate" and (config.grid or config.rate_hz):
        key = "grid" if config.grid else "rate_hz"
        raise ConfigError(f"skin.{key} is announced by a skin of PROTOCOL.md; remove it")
    grid = _GRID.fullmatch(config.grid)
    if config.grid and not (grid and max(map(int, grid.groups())) <= 255):
        allowed = "use rows x columns, such as 12x32"
        raise ConfigError(f"skin.grid = {config.grid!r} is not allowed; {allowed}")
    changes: dict[str, Any] = {}
    if grid:
        changes |= {"rows": int(grid[1]), "cols": int(grid[2])}
    if config.rate_hz:
        if profile.rates_hz and config.rate_hz not in profile.rates_hz:
            allowed = ", ".join(f"{rate:g}" for rate in profile.rates_hz)
            why = f"skin.rate_hz = {config.rate_hz:g} cannot be set on this skin"
            raise ConfigError(f"{why}; use one of {allowed}")
        changes["rate_hz"] = config.rate_hz
    return replace(profile, **changes)


def with_window(rows: int, cols: int, rate_hz: float, dtype: str, axes: int) -> SweepFormat:
    """A format with a window of WINDOW_S. Raises FormatError."""
    return SweepFormat(rows, cols, rate_hz, max(1, round(WINDOW_S * rate_hz)), dtype, axes)


def warning(format: SweepFormat) -> str:
    """A warning for a skin that is too slow for textures, "" for a faster skin."""
    if format.window >= FEW_FRAMES:
        return ""
    finest = ceil(20 * SLIDE_MM_S / format.rate_hz) / 10
    return (
        f"{format.window} frames in a window, at {format.rate_hz:g} Hz: at {SLIDE_MM_S} mm/s"
        f" textures finer than {finest:g} mm cannot be told apart; slide slower"
    )

"""The settings of the box, from TOML files and `--set` options.

Layers, each overriding the layers before it: the defaults below, `skin.toml`, `board-NAME.toml`,
`/etc/palpate/palpate.toml`, `--set`. The dataclasses are the schema: the files have the types
and limits of their fields. Each value has its source.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_type_hints

from palpate.core import settings_files
from palpate.core.errors import ConfigError
from palpate.core.runtime_folder import FEED, RUNTIME, STATUS
from palpate.core.schema import Key, Within, custom, fixed, gpio_line, keys, read_table, unknown
from palpate.core.settings_files import SITE
from palpate.core.text import shown

UNIT = re.compile(r"[a-z][a-z0-9-]{0,7}", re.ASCII)
"""Name of a unit (palpate@NAME); longer ones would leave no room for the label in a sentence."""
_USB = re.compile(r"([0-9a-f]{4}):([0-9a-f]{4})(?::(.+))?", re.ASCII | re.IGNORECASE)


def _usb(value: Any) -> str | None:
    """The reader of skin.usb, for `custom`."""
    known = isinstance(value, str) and value.isprintable() and _USB.fullmatch(value)
    return value if known else None


@dataclass(frozen=True, slots=True)
class SkinConfig:
    """The skin and the way to read it.

    profile: name of its profile in skins/NAME.toml. grid: "ROWSxCOLUMNS" if it differs from the
    profile, else "". rate_hz: frames per second if they differ from the profile, else 0. tare: send
    the profile's tare command whenever the skin is found; the skin must be unloaded then.
    fingertip: the side of the grid at the end of the finger, for pictures; "" if unknown. usb: USB
    ids of the board, and its serial number if several are connected, as in "1209:7ac7:E661";
    profiles with ids of their own use the serial number alone. link: "vendor" (bulk transfers),
    "acm" (a serial port over USB, without the kernel's driver), or "serial" (any serial port, with
    the kernel's driver). port: path of this serial port; "" finds the port by its USB ids.
    silence_ms: after this time without a frame the skin counts as silent and is started again.
    """

    profile: str = "palpate"
    grid: str = ""
    rate_hz: Annotated[float, Within(0.0, 100_000.0)] = 0.0
    tare: bool = False
    fingertip: Literal["", "first-row", "last-row", "first-column", "last-column"] = ""
    usb: str = custom("1209:7ac7", 'USB ids such as "1209:7ac7" or "1209:7ac7:SERIAL"', _usb)
    link: Literal["vendor", "acm", "serial"] = "vendor"
    port: str = ""
    silence_ms: Annotated[int, Within(1, 60_000)] = 500
    baud: int = fixed(0)  # of the serial port; 0: the profile's
    read_bytes: int = fixed(4096)  # whole USB packets (512): a smaller read can overflow
    timeout_ms: int = fixed(100)  # a read waits this long, and with it edges and commands
    retry_ms: int = fixed(250)  # between two searches for a missing skin

    @property
    def vendor_id(self) -> int:
        return int(self.usb[:4], 16)

    @property
    def product_id(self) -> int:
        return int(self.usb[5:9], 16)

    @property
    def serial(self) -> str:
        """Serial number of the board, "" for any."""
        return self.usb[10:]


@dataclass(frozen=True, slots=True)
class TriggerConfig:
    """Start and stop of sweeps.

    mode: "two-lines": rising edges of `start` and `stop`. "one-line": `start` rises and falls,
    `stop` is not used. "serial": commands on the serial line. "key": the space bar. "timed": by the
    clock, a sweep of 3 s every 5 s (`run` and `record` have options for other times). start, stop:
    the robot's GPIO lines, by the kernel's names (`gpioinfo` lists them); "" means not wired.
    new_object: a GPIO line whose rising edge announces another object. active_low: inverts all
    three lines, and pulls open inputs up instead of down. glitch_us: shorter pulses do not count.
    """

    mode: Literal["two-lines", "one-line", "serial", "key", "timed"] = "two-lines"
    start: str = gpio_line()
    stop: str = gpio_line()
    new_object: str = gpio_line()
    active_low: bool = False
    glitch_us: Annotated[int, Within(1, 1_000_000)] = 500
    storm_edges: int = fixed(2000)  # more edges in one burst come from a broken wire
    every_s: float = fixed(5.0)  # timed: from one START to the next (--every)
    sweep_s: float = fixed(3.0)  # timed: from START to STOP (--sweep)

    @property
    def by_lines(self) -> bool:
        """Whether GPIO lines start and stop sweeps."""
        return self.mode in ("two-lines", "one-line")


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """The box's GPIO lines to the robot; "" means not wired. ready, busy, result_valid, fault,
    decided: PROTOCOL.md, part 3. class_bits: the class code, lowest bit first. settle_us: time from
    setting these lines to the rise of `result_valid`."""

    ready: str = gpio_line()
    busy: str = gpio_line()
    result_valid: str = gpio_line()
    fault: str = gpio_line()
    decided: str = gpio_line()
    class_bits: tuple[str, ...] = field(
        default=(), metadata={"line": True, "allowed": 'names such as ["GPIO16"]'}
    )
    settle_us: Annotated[int, Within(1, 1_000_000)] = 200


@dataclass(frozen=True, slots=True)
class SweepConfig:
    """Limits of a sweep. max_duration_s: a sweep without a stop edge for this long is answered
    `long`."""

    max_duration_s: Annotated[float, Within(0.1, 3600.0)] = 12.0
    late_ms: int = fixed(500)  # longest wait for frames after the stop edge
    lead_ms: int = fixed(500)  # early answers: from the start edge to the window
    # (with 500 ms the window is the middle of the paper's three seconds)


@dataclass(frozen=True, slots=True)
class SerialConfig:
    """The serial line to the robot. port: a device path, "" for none. baud: bits per second,
    8N1."""

    port: str = ""
    baud: Annotated[int, Within(1200, 4_000_000)] = 115200
    queue: int = fixed(64)  # sentences that wait for a slow reader; then the oldest is dropped
    state_s: float = fixed(1.0)  # between two STA sentences


@dataclass(frozen=True, slots=True)
class ClassifierConfig:
    """The classifier.

    bundle: path of a bundle; "" for the bundle that was deployed last, or else the packaged one.
    allow_unsigned: let an unsigned `bundle` answer a robot. fuse: rule by which the sweeps of one
    object are fused into one answer; "none" answers each sweep alone. early: answer while the
    finger still slides, as soon as the bundle's rule allows. min_probability: least probability for
    status ok; 0 takes the bundle's threshold. max_sweeps: after this many fused sweeps of one
    object below `min_probability` the answer is `undecided`, and the next sweep begins another
    object; 0 means no limit. conflict: consequence of a sweep that contradicts the sweeps fused
    before it: "new" begins another object, "refuse" answers `conflict`, "fuse" fuses all sweeps
    until NEW OBJECT, also after `max_sweeps`. object_s: longest pause between two sweeps of one
    object, in seconds; 0 means no limit. strangers: the limit beyond which a material is `unknown`;
    a strict one gives fewer untaught materials a label, and fewer taught ones theirs. The card of a
    bundle has both shares for each.
    """

    bundle: str = ""
    allow_unsigned: bool = False
    fuse: Literal["product", "vote", "none"] = "product"
    early: bool = False
    min_probability: Annotated[float, Within(0.0, 1.0)] = 0.0
    max_sweeps: Annotated[int, Within(0, 1000)] = 5
    conflict: Literal["new", "refuse", "fuse"] = "new"
    object_s: Annotated[float, Within(0.0, 86_400.0)] = 60.0
    strangers: Literal["strict", "balanced", "loose"] = "balanced"


UNTIL_NEW_OBJECT = ClassifierConfig(max_sweeps=0, conflict="fuse", object_s=0.0)
"""With these settings only NEW OBJECT ends an object."""


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """The folders of the box.

    folder: bundles, recordings and black box (layout: deployment/store.py). keys: folder of
    `allowed_signers`, the accepted keys in the format of ssh-keygen, of `counter`, that of the last
    delivery, and of `enrolment/`, this box's key for its own labels. runtime: folder of the status
    file and of the feed's socket (PROTOCOL.md, part 4); "" for neither. black_box: number of latest
    sweeps to keep, 0 for none. trial_sweeps: a new bundle is committed once it has given a label to
    this many sweeps, or the skin has streamed for 600 s.
    """

    folder: str = "/var/lib/palpate"
    keys: str = "/etc/palpate"
    runtime: str = RUNTIME
    black_box: Annotated[int, Within(0, 100_000)] = 0
    trial_sweeps: Annotated[int, Within(1, 100_000)] = 20
    trial_s: float = fixed(600.0)  # streaming time after which the trial ends as well

    @property
    def signers(self) -> Path:
        """The file of the keys whose bundles are accepted."""
        return Path(self.keys) / "allowed_signers"

    @property
    def least_counter(self) -> Path:
        """The file of root with the counter of the last delivery; older bundles are refused."""
        return Path(self.keys) / "counter"

    @property
    def enrolment_key(self) -> Path:
        """The folder of this box's key for enrolments."""
        return Path(self.keys) / "enrolment"

    @property
    def status(self) -> Path | None:
        """The file that `palpate status` reads."""
        return Path(self.runtime) / STATUS if self.runtime else None

    @property
    def runtime_folder(self) -> Path | None:
        """The folder of the status file, None for none."""
        return Path(self.runtime) if self.runtime else None

    @property
    def feed(self) -> Path | None:
        return Path(self.runtime) / FEED if self.runtime else None

    def needed_feed(self) -> Path:
        """The feed, for programs that read it. Raises ConfigError if it is off."""
        if not self.feed:
            raise ConfigError('store.runtime = "" turns the feed off; set it to a folder')
        return self.feed


@dataclass(frozen=True, slots=True)
class WatchConfig:
    """The page of `palpate watch --web`. address: where it listens, then further host names by
    which browsers may ask for it, separated by spaces. Addresses beyond this machine need tokens
    and certificate. shifts: when shifts begin, for the count of a shift."""

    address: str = "127.0.0.1"
    shifts: str = "06:00 14:00 22:00"
    folder: str = fixed("/etc/palpate/watch")  # token-ROLE, certificate.pem and key.pem


@dataclass(frozen=True, slots=True)
class TeachConfig:
    """Teaching at the robot (`palpate teach`). allow: whether this box may learn materials by
    itself, and run a bundle that it has taught. serial: whether the robot may teach it by the
    serial line: TEACH, USE and FORGET, and the commands of a recording."""

    allow: bool = True
    serial: bool = False
    memory_mb: int = fixed(768)  # most private memory of the process that learns
    limit_s: float = fixed(900.0)  # longest time that it may take


@dataclass(frozen=True, slots=True)
class BridgeConfig:
    """`palpate bridge` on the box; its options override these values.

    address: where it listens, at the port of its kind. allow_writes: whether peers may start, stop,
    tare and abort. A bridge has no password. short: sentences of at most 80 characters on TCP, for
    controllers whose strings hold no more. fingers: units whose answers `palpate bridge fuse`
    fuses and sends on serial.port, separated by spaces, as in "left right". broker: of
    `palpate bridge mqtt`, as mqtt://HOST:PORT or mqtts://HOST:PORT. login: file with its user and
    password, on a line each. ca: file with the certificates that it trusts; "": the system's. name:
    of the box in the network; "": the computer's. memory: file of `palpate bridge memory`. opcua:
    folder of `palpate bridge opcua` for its certificate and `login`, a file as for MQTT. anonymous:
    whether everybody may read there.
    """

    address: str = "127.0.0.1"
    allow_writes: bool = False
    short: bool = False
    fingers: str = ""
    broker: str = "mqtt://127.0.0.1:1883"
    login: str = ""
    ca: str = ""
    name: str = ""
    memory: str = "/var/lib/palpate-memory/verdicts.db"
    opcua: str = "/var/lib/palpate-opcua"
    anonymous: bool = False


@dataclass(frozen=True, slots=True)
class Config:
    """All settings. board: the board file's name, "" for none. folder: where the files are, skins/
    among them. sources: "section.key" -> "code", the file's name or "--set"; "board" -> "code", the
    file's name or "--board"."""

    board: str
    skin: SkinConfig
    trigger: TriggerConfig
    output: OutputConfig
    sweep: SweepConfig
    serial: SerialConfig
    classifier: ClassifierConfig
    store: StoreConfig
    watch: WatchConfig
    teach: TeachConfig
    bridge: BridgeConfig
    sources: Mapping[str, str] = field(compare=False)
    folder: Path = field(default=SITE.parent, compare=False)

    def kept(self, folder: str) -> Path:
        """A folder of sweeps in the store."""
        return Path(self.store.folder) / folder


_SECTIONS: Mapping[str, Any] = MappingProxyType(
    {n: h for n, h in get_type_hints(Config).items() if is_dataclass(h)}
)
_KEYS: Mapping[str, Key] = MappingProxyType(
    {f"{s}.{last}": key for s, group in _SECTIONS.items() for last, key in keys(group).items()}
)


def load(
    board: str | None,
    sets: Sequence[str] = (),
    *,
    folder: Path | None = None,
    site: Path = SITE,
    unit: str = "",
) -> Config:
    """All layers as one Config.

    board: NAME of a `board-NAME.toml`. None or "" takes `board = "NAME"` in `site`; without it no
    GPIO line is wired. sets: "section.key=value", the value in TOML or a bare string. folder: where
    `skin.toml` and the boards' files are; None means `firmware_config/` next to the package, in an
    installation `/etc/palpate`. site: must exist unless it is SITE. unit: name of one of several
    units; its settings are NAME.toml next to SITE, its default folders have its name. Raises
    ConfigError with file, key, value and the allowed values.
    """
    if unit:
        if not UNIT.fullmatch(unit):
            allowed = "use up to 8 small letters, digits and hyphens, as in palpate@left"
            raise ConfigError(f"--unit {shown(unit)} is not a unit's name; {allowed}")
        site = SITE.with_name(f"{unit}.toml")
    layers = settings_files.read(board, sets, folder=folder, site=site)
    values = {name: key.default for name, key in _KEYS.items()}
    if unit:
        values |= {name: f"{values[name]}-{unit}" for name in ("store.folder", "store.runtime")}
    sources = {"board": Path(layers.named_in).name} | dict.fromkeys(_KEYS, "code")
    for where, table in layers.tables:
        name_of = Path(where).name
        for name, value in _checked(table, where):
            values[name], sources[name] = value, name_of
    _check_lines(values, sources)
    groups = {
        section: group(**{key: values[f"{section}.{key}"] for key in keys(group)})
        for section, group in _SECTIONS.items()
    }
    frozen = MappingProxyType(sources)
    return Config(board=layers.board, sources=frozen, folder=layers.folder, **groups)


def describe(config: Config) -> str:
    """One line per value, `section.key = value # source`: TOML that can be loaded."""
    values = {"board": json.dumps(config.board)}
    for name in _KEYS:
        section, _, last = name.partition(".")
        value = getattr(getattr(config, section), last)
        values[name] = json.dumps(value, ensure_ascii=False)
    return "\n".join(
        f"{f'{name} = {value}':<36}   # {config.sources[name]}" for name, value in values.items()
    )


def _checked(table: Mapping[str, Any], where: str) -> Iterator[tuple[str, Any]]:
    """Each value of a layer with its full name, as its field's type."""
    for section, content in table.items():
        if section not in _SECTIONS:
            if section == "board":
                raise ConfigError(
                    f"{where}: board is chosen elsewhere; set it in {SITE}, or give --board"
                )
            raise unknown(section, [*_SECTIONS, "board"], where, _KEYS)
        if not isinstance(content, dict):
            given = f"{where}: {section} = {shown(content)}"
            raise ConfigError(f"{given} is not a section; write [{section}], its keys below")
        named = {f"{section}.{last}": value for last, value in content.items()}
        yield from read_table(_KEYS, named, where).items()


def _check_lines(values: Mapping[str, Any], sources: Mapping[str, str]) -> None:
    """Raise ConfigError if one GPIO line has two meanings."""
    taken: dict[str, str] = {}
    for name in (n for n, key in _KEYS.items() if "line" in key.metadata):
        for line in filter(None, [values[name]] if isinstance(values[name], str) else values[name]):
            if line in taken:
                first = f"{taken[line]} ({sources[taken[line]]})"
                twice = f"{sources[name]}: {name} = {line!r} is the GPIO line of {first} already"
                raise ConfigError(f'{twice}; give each its own line, or ""')
            taken[line] = name

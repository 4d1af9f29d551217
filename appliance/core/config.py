"""The settings of the box. In: TOML files and `--set` options. Out: one frozen `Config` that knows
each value's source.

Layers, each overriding those before it: the defaults below, `sensor.toml`, `board-NAME.toml`,
`/etc/palpate/palpate.toml`, `--set`. The dataclasses are the schema: a field's type and limits say
what a file may hold.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_type_hints

from appliance.core.errors import ConfigError
from appliance.core.schema import Key, closest, gpio_line, keys, number, read_table, shown

SITE = Path("/etc/palpate/palpate.toml")
"""The settings of this robot's installation; the file may be missing."""
FEED_SCHEMA = 1
"""Version of the feed's lines (PROTOCOL.md, part 4), for who writes and who reads them."""


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """Which skin it is, where, and how it is read.

    skin: name of its profile in skins/NAME.toml. grid: "ROWSxCOLUMNS" in place of the profile's, ""
    for that. rate_hz: frames per second in place of the profile's, 0 for that. tare: send the
    profile's command for it whenever the skin is found, which must be unloaded then. fingertip: the
    side of the grid that is nearest to the end of the finger, for pictures; "" where nobody has
    said it. vendor_id, product_id: USB ids. serial: the board's serial number, "" for any. link:
    "vendor" (bulk transfers), "acm" (a serial port over USB, without the kernel's driver), or
    "serial" (any serial port, with the kernel's driver). port: path of this serial port; "" finds
    the one with the ids. baud: its bits per second, 0 takes the profile's. Profiles of other
    protocols have ids of their own and use `port`, `serial` and `baud`. read_bytes: size of one
    read, in whole USB packets. timeout_ms: longest wait of one read. silence_ms: time without a
    frame after which the skin counts as lost. retry_ms: time between two searches for a missing
    skin.
    """

    skin: str = "palpate"
    grid: str = ""
    rate_hz: float = number(0.0, 0.0, 100_000.0)
    tare: bool = False
    fingertip: Literal["", "first-row", "last-row", "first-column", "last-column"] = ""
    vendor_id: int = number(0x1209, 1, 0xFFFF, hex=True)
    product_id: int = number(0x7AC7, 1, 0xFFFF, hex=True)
    serial: str = ""
    link: Literal["vendor", "acm", "serial"] = "vendor"
    port: str = ""
    baud: int = number(0, 0, 4_000_000)
    read_bytes: int = number(4096, 512, 1 << 20, step=512)
    timeout_ms: int = number(100, 1, 1_000)
    silence_ms: int = number(500, 1, 60_000)
    retry_ms: int = number(250, 1, 60_000)


@dataclass(frozen=True, slots=True)
class TriggerConfig:
    """What starts and stops a sweep: the robot's lines, by the kernel's names (`gpioinfo`; "" means
    not wired), or not a line.

    mode: "two-lines": rising edges of `start` and `stop`. "one-line": `start` rises and falls,
    `stop` is not used. "serial": commands on the serial line. "key": the space bar. "timed": a
    sweep of `sweep_s` every `every_s`. new_object: its rising edge announces another object.
    active_low: inverts all three lines. bias: the inputs' resistor. glitch_us: time for which a
    level must hold to count. storm_edges: largest number of edges in one burst; more are taken for
    a broken wire. every_s: with "timed", seconds from one START to the next. sweep_s: with "timed",
    seconds from START to STOP.
    """

    mode: Literal["two-lines", "one-line", "serial", "key", "timed"] = "two-lines"
    start: str = gpio_line()
    stop: str = gpio_line()
    new_object: str = gpio_line()
    active_low: bool = False
    bias: Literal["pull-down", "pull-up", "disabled", "as-is"] = "pull-down"
    glitch_us: int = number(500, 1, 1_000_000)
    storm_edges: int = number(2000, 2, 1_000_000)
    every_s: float = number(5.0, 0.1, 3600.0)
    sweep_s: float = number(3.0, 0.1, 3600.0)

    @property
    def by_lines(self) -> bool:
        """Whether GPIO lines start and stop sweeps."""
        return self.mode in ("two-lines", "one-line")


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """The box's lines to the robot; "" means not wired.

    ready, busy, result_valid, fault, decided: PROTOCOL.md, part 3. class_bits: the class code,
    lowest bit first. settle_us: time from setting them to the rise of `result_valid`.
    """

    ready: str = gpio_line()
    busy: str = gpio_line()
    result_valid: str = gpio_line()
    fault: str = gpio_line()
    decided: str = gpio_line()
    class_bits: tuple[str, ...] = field(default=(), metadata={"line": True})
    settle_us: int = number(200, 1, 1_000_000)


@dataclass(frozen=True, slots=True)
class SweepConfig:
    """Limits of a sweep. max_duration_s: without a stop edge for this long the sweep is answered
    `long`.

    late_ms: longest wait after the stop edge for frames of the window. lead_ms: time from the start
    edge to the first frame of the window for early answers (500 is the middle of the paper's three
    seconds).
    """

    max_duration_s: float = number(12.0, 0.1, 3600.0)
    late_ms: int = number(500, 1, 60_000)
    lead_ms: int = number(500, 0, 60_000)


@dataclass(frozen=True, slots=True)
class SerialConfig:
    """The serial line to the robot. port: a device path, "" for none. baud: bits per second, 8N1.

    queue: largest number of sentences that wait for a slow reader; then the oldest is dropped.
    state_s: time between two STA sentences.
    """

    port: str = ""
    baud: int = number(115200, 1200, 4_000_000)
    queue: int = number(64, 1, 65_536)
    state_s: float = number(1.0, 0.05, 3600.0)


@dataclass(frozen=True, slots=True)
class ClassifierConfig:
    """The network. bundle: path of a bundle; "" for the one that was deployed last, or else the
    packaged one. allow_unsigned: let a robot be answered by a `bundle` that nobody signed.

    fuse: rule by which the sweeps of one object are fused into one answer; "none" answers each by
    itself. early: answer while the finger still slides, as soon as the bundle's rule allows.
    min_probability: least probability for status ok; 0 takes the bundle's threshold. max_sweeps:
    after this many fused sweeps of one object below `min_probability` the answer is `undecided`; 0
    means no limit.
    """

    bundle: str = ""
    allow_unsigned: bool = False
    fuse: Literal["product", "vote", "none"] = "product"
    early: bool = False
    min_probability: float = number(0.0, 0.0, 1.0)
    max_sweeps: int = number(0, 0, 1000)


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """What the box stores. folder: bundles, recordings and black box (layout: deployment/store.py).

    signers: file of the keys whose bundles are accepted, in the format ALLOWED SIGNERS of
    ssh-keygen. enrolment_key: folder of the key with which this box signs the labels that it
    enrolled (deployment/enrolment_key.py). status: the file that `palpate status` reads, "" for
    none. trial_sweeps, trial_s: a new bundle is committed once it has named this many sweeps, or
    the skin has streamed for this long. black_box: number of latest sweeps to keep, 0 for none.
    """

    folder: str = "/var/lib/palpate"
    signers: str = "/etc/palpate/allowed_signers"
    enrolment_key: str = "/etc/palpate/enrolment"
    status: str = "/run/palpate/status.json"
    trial_sweeps: int = number(20, 1, 100_000)
    trial_s: float = number(600.0, 1.0, 1e6)
    black_box: int = number(0, 0, 100_000)


@dataclass(frozen=True, slots=True)
class FeedConfig:
    """What the box offers to programs that watch it (PROTOCOL.md, part 4). socket: path of the
    feed, "" for none."""

    socket: str = "/run/palpate/feed.sock"


@dataclass(frozen=True, slots=True)
class WatchConfig:
    """The page of `palpate watch --web`. address: where it listens; beyond this machine only with
    token and certificate.

    names: further host names by which browsers may ask for it, separated by spaces. folder: token,
    certificate.pem and key.pem.
    """

    address: str = "127.0.0.1"
    names: str = ""
    folder: str = "/etc/palpate/watch"


@dataclass(frozen=True, slots=True)
class BridgeConfig:
    """`palpate bridge` on the box, where no option says otherwise. address: where it listens, at
    the port of its kind.

    allow_writes: whether peers may start, stop, tare and abort. A bridge has no password.
    """

    address: str = "127.0.0.1"
    allow_writes: bool = False


@dataclass(frozen=True, slots=True)
class Config:
    """All settings. board: the board file's name, "" for none. folder: where the files are, skins/
    among them.

    sources: "section.key" -> "code", the file's name or "--set"; "board" -> "code", the file's name
    or "--board".
    """

    board: str
    sensor: SensorConfig
    trigger: TriggerConfig
    output: OutputConfig
    sweep: SweepConfig
    serial: SerialConfig
    classifier: ClassifierConfig
    store: StoreConfig
    feed: FeedConfig
    watch: WatchConfig
    bridge: BridgeConfig
    sources: Mapping[str, str] = field(compare=False)
    folder: Path = field(default=SITE.parent, compare=False)


_SECTIONS: Mapping[str, Any] = MappingProxyType(
    {n: h for n, h in get_type_hints(Config).items() if is_dataclass(h)}
)
_KEYS: Mapping[str, Key] = MappingProxyType(
    {
        f"{section}.{last}": key
        for section, group in _SECTIONS.items()
        for last, key in keys(group).items()
    }
)


def load(
    board: str | None, sets: Sequence[str] = (), *, folder: Path | None = None, site: Path = SITE
) -> Config:
    """All layers as one Config.

    board: NAME of a `board-NAME.toml`; None or "" takes `board = "NAME"` in `site`, and without
    that no line is wired. sets: "section.key=value", the value in TOML or a bare string. folder:
    where `sensor.toml` and the boards' files are; None means `firmware_config/` beside the package,
    in an installation `/etc/palpate`. site: must exist unless it is SITE. Raises ConfigError naming
    the file, the key, the value and what is allowed.
    """
    folder = folder or _folder()
    of_site = _read(site, needed=site != SITE)
    in_site = of_site.pop("board", "")
    board, named_in = (
        (board, "--board") if board else (in_site, "code" if in_site == "" else str(site))
    )
    layers = [(folder / "sensor.toml", _read(folder / "sensor.toml", needed=False))]
    if board != "":
        path = _board_file(folder, board, named_in)
        layers.append((path, _read(path, needed=True)))
    layers += [(site, of_site), *((Path("--set"), _parse_set(text)) for text in sets)]
    values = {name: key.default for name, key in _KEYS.items()}
    sources = {"board": Path(named_in).name} | dict.fromkeys(_KEYS, "code")
    for where, table in layers:
        for name, value in _checked(table, str(where)):
            values[name], sources[name] = value, where.name
    _check_lines(values, sources)
    groups = {
        s: group(**{f.name: values[f"{s}.{f.name}"] for f in fields(group)})
        for s, group in _SECTIONS.items()
    }
    return Config(board=board, sources=MappingProxyType(sources), folder=folder, **groups)


def describe(config: Config) -> str:
    """One line per value, `section.key = value   # source`; the text is TOML that can be loaded as
    a site file."""
    values = {"board": json.dumps(config.board)}
    for name, key in _KEYS.items():
        section, _, last = name.partition(".")
        value = getattr(getattr(config, section), last)
        values[name] = (
            f"0x{value:04x}" if "hex" in key.limits else json.dumps(value, ensure_ascii=False)
        )
    return "\n".join(
        f"{f'{name} = {value}':<36}   # {config.sources[name]}" for name, value in values.items()
    )


def boards(folder: Path | None = None) -> dict[str, Path]:
    """The delivered boards' files by name; folder: as for `load`."""
    return {
        path.stem.removeprefix("board-"): path
        for path in sorted((folder or _folder()).glob("board-*.toml"))
    }


def _folder() -> Path:
    beside = Path(__file__).resolve().parents[2] / "firmware_config"
    return beside if beside.is_dir() else SITE.parent


def _read(path: Path, *, needed: bool) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError as e:
        if not needed:
            return {}
        raise ConfigError(f"{path}: no such file; check the path") from e
    except OSError as e:
        raise ConfigError(
            f"{path}: cannot be read: {str(e.strerror).lower()}; check who may read it"
        ) from e
    except (ValueError, RecursionError) as e:  # no TOML or no UTF-8; deeply nested brackets
        raise ConfigError(
            f"{path}: not TOML: {str(e).lower()}; write key = value, strings in quotes"
        ) from e


def _board_file(folder: Path, board: Any, where: str) -> Path:
    known = boards(folder)
    if not (isinstance(board, str) and board in known):
        there = ", ".join(known) or "none"
        raise ConfigError(
            f"{where}: board = {shown(board)} has no board-NAME.toml in {folder}; boards there: "
            f"{there}"
        )
    return known[board]


def _parse_set(text: str) -> dict[str, Any]:
    """`section.key=value` as the table that a file with this line gives."""
    name, equals, value = text.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot):
        raise ConfigError(f"--set {text}: not understood; use --set section.key=value")
    try:
        (parsed,) = tomllib.loads(f"value = {value}").values()
    except (ValueError, RecursionError):
        parsed = value.strip()
    return {section: {key: parsed}}


def _checked(table: Mapping[str, Any], where: str) -> Iterator[tuple[str, Any]]:
    """Each value of a layer with its full name, converted to its field's type."""
    for section, content in table.items():
        if section not in _SECTIONS:
            if section == "board":
                raise ConfigError(
                    f"{where}: board is chosen in {SITE}, or with --board; move it there"
                )
            raise _unknown(section, [*_SECTIONS, "board"], where)
        if not isinstance(content, dict):
            raise ConfigError(
                f"{where}: {section} = {shown(content)} is not a section; write [{section}], its "
                "keys below"
            )
        named = {f"{section}.{last}": value for last, value in content.items()}
        yield from read_table(
            _KEYS,
            named,
            unknown=lambda name: _unknown(name, [*_KEYS], where),
            refused=lambda why: ConfigError(f"{where}: {why}"),
        ).items()


def _unknown(name: str, known: list[str], where: str) -> ConfigError:
    """The error for an unknown name; a key of that name in another section is suggested before a
    similar spelling."""
    last = name.rpartition(".")[2]
    near = [k for k in _KEYS if k.endswith(f".{last}")] or closest(name, known)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    return ConfigError(f"{where}: {name if name.isprintable() else shown(name)} is unknown; {hint}")


def _check_lines(values: Mapping[str, Any], sources: Mapping[str, str]) -> None:
    """Raises ConfigError where one line is given two meanings."""
    taken: dict[str, str] = {}
    for name in (n for n, key in _KEYS.items() if "line" in key.limits):
        for line in filter(None, [values[name]] if isinstance(values[name], str) else values[name]):
            if line in taken:
                first = f"{taken[line]} ({sources[taken[line]]})"
                raise ConfigError(
                    f"{sources[name]}: {name} = {line!r} is the line of {first} already; give "
                    'each its own line, or ""'
                )
            taken[line] = name

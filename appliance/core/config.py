"""The settings of the box. In: TOML files and `--set` options. Out: one frozen `Config` that knows each value's source.

Layers, the later wins: the defaults below, `sensor.toml`, `board-NAME.toml`, `/etc/palpate/palpate.toml`, `--set`.
The dataclasses are the schema: a field's type and limits say what a file may hold, and nothing is listed twice.
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
"""What the person who set up this robot has changed; may be missing."""


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """Where the skin is and how it is read.

    vendor_id, product_id: USB ids. serial: the board's serial number, "" for any. link: the interface that is used,
    "vendor" (bulk) or "acm" (a serial port over USB).
    read_bytes: size of one read, whole USB packets. timeout_ms: how long one read waits. silence_ms: the skin counts as
    lost after so long without a frame. retry_ms: how often a missing skin is looked for.
    """

    vendor_id: int = number(0x1209, 1, 0xFFFF, hex=True)
    product_id: int = number(0x7AC7, 1, 0xFFFF, hex=True)
    serial: str = ""
    link: Literal["vendor", "acm"] = "vendor"
    read_bytes: int = number(4096, 512, 1 << 20, step=512)
    timeout_ms: int = number(100, 1, 1_000)
    silence_ms: int = number(500, 1, 60_000)
    retry_ms: int = number(250, 1, 60_000)


@dataclass(frozen=True, slots=True)
class TriggerConfig:
    """The robot's lines into the box. A line is named as the kernel names it (`gpioinfo`); "" is not wired.

    mode: "two-lines": rising edges of `start` and `stop`. "one-line": `start` rises and falls, `stop` is not used.
    new_object: its rising edge says that another object comes. active_low: all three mean the opposite level.
    bias: the inputs' resistor. glitch_us: a level counts once it has held so long. storm_edges: more edges than this in
    one burst are a broken wire, not a robot.
    """

    mode: Literal["two-lines", "one-line"] = "two-lines"
    start: str = gpio_line()
    stop: str = gpio_line()
    new_object: str = gpio_line()
    active_low: bool = False
    bias: Literal["pull-down", "pull-up", "disabled", "as-is"] = "pull-down"
    glitch_us: int = number(500, 1, 1_000_000)
    storm_edges: int = number(2000, 2, 1_000_000)


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """The box's lines to the robot: ready, busy, result_valid, fault, decided as in PROTOCOL.md, part 3. "" is not wired.

    class_bits: the answer's code, lowest bit first. settle_us: how long they stand before `result_valid` rises.
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
    """What may be a sweep. max_duration_s: without a stop edge for so long the sweep is answered `long`.

    late_ms: how long frames of the window may come after the stop edge. lead_ms: from the start edge to the first frame
    of the window of early answers (500 is the middle of the paper's three seconds).
    """

    max_duration_s: float = number(12.0, 0.1, 3600.0)
    late_ms: int = number(500, 1, 60_000)
    lead_ms: int = number(500, 0, 60_000)


@dataclass(frozen=True, slots=True)
class SerialConfig:
    """The serial line to the robot. port: a device path, "" for none. baud: bits a second, 8N1.

    queue: sentences that wait for a slow reader before the oldest is dropped. state_s: time between two STA sentences.
    """

    port: str = ""
    baud: int = number(115200, 1200, 4_000_000)
    queue: int = number(64, 1, 65_536)
    state_s: float = number(1.0, 0.05, 3600.0)


@dataclass(frozen=True, slots=True)
class ClassifierConfig:
    """The network. bundle: a bundle's path; "" for the one that was deployed last, or else the packaged one.

    fuse: how the sweeps of one object become one answer; "none": they do not. early: answer while the finger still
    slides, as soon as the bundle's rule allows. min_probability: least probability for status ok; 0 takes the bundle's threshold.
    max_sweeps: fused sweeps of one object below `min_probability` after which the answer is `undecided`; 0 is no limit.
    """

    bundle: str = ""
    fuse: Literal["product", "vote", "none"] = "product"
    early: bool = False
    min_probability: float = number(0.0, 0.0, 1.0)
    max_sweeps: int = number(0, 0, 1000)


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """What the box keeps. folder: bundles, recordings, the black box (store.py says what lies where).

    signers: whose bundles are taken, in the form of ssh-keygen's ALLOWED SIGNERS. status: the file that `palpate status`
    reads, "" for none. trial_sweeps, trial_s: a new bundle stays once it has named so many sweeps, or the skin has
    streamed for so long. black_box: so many of the latest sweeps are kept, 0 for none.
    """

    folder: str = "/var/lib/palpate"
    signers: str = "/etc/palpate/allowed_signers"
    status: str = "/run/palpate/status.json"
    trial_sweeps: int = number(20, 1, 100_000)
    trial_s: float = number(600.0, 1.0, 1e6)
    black_box: int = number(0, 0, 100_000)


@dataclass(frozen=True, slots=True)
class Config:
    """All settings. board: the board file's name, "" for none.

    sources: "section.key" -> "code", the file's name or "--set"; "board" -> "code", the file's name or "--board".
    """

    board: str
    sensor: SensorConfig
    trigger: TriggerConfig
    output: OutputConfig
    sweep: SweepConfig
    serial: SerialConfig
    classifier: ClassifierConfig
    store: StoreConfig
    sources: Mapping[str, str] = field(compare=False)


_SECTIONS: Mapping[str, Any] = MappingProxyType({n: h for n, h in get_type_hints(Config).items() if is_dataclass(h)})
_KEYS: Mapping[str, Key] = MappingProxyType(
    {f"{section}.{last}": key for section, group in _SECTIONS.items() for last, key in keys(group).items()}
)


def load(board: str | None, sets: Sequence[str] = (), *, folder: Path | None = None, site: Path = SITE) -> Config:
    """All layers as one Config.

    board: NAME of a `board-NAME.toml`; None or "" leaves the choice to `board = "NAME"` in `site`; else none is wired.
    sets: "section.key=value", the value in TOML or a bare string. folder: where `sensor.toml` and the boards are; None
    is `firmware_config/` beside the package, in an installation `/etc/palpate`. site: must exist if it is not SITE.
    Raises ConfigError, naming the file, the key, the value and what is allowed.
    """
    folder = folder or _folder()
    of_site = _read(site, needed=site != SITE)
    in_site = of_site.pop("board", "")
    board, named_in = (board, "--board") if board else (in_site, "code" if in_site == "" else str(site))
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
    groups = {s: group(**{f.name: values[f"{s}.{f.name}"] for f in fields(group)}) for s, group in _SECTIONS.items()}
    return Config(board=board, sources=MappingProxyType(sources), **groups)


def describe(config: Config) -> str:
    """One line a value, `section.key = value   # source`; the text is TOML that loads again as a site file."""
    values = {"board": json.dumps(config.board)}
    for name, key in _KEYS.items():
        section, _, last = name.partition(".")
        value = getattr(getattr(config, section), last)
        values[name] = f"0x{value:04x}" if "hex" in key.limits else json.dumps(value, ensure_ascii=False)
    return "\n".join(f"{f'{name} = {value}':<32}   # {config.sources[name]}" for name, value in values.items())


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
        raise ConfigError(f"{path}: cannot be read: {str(e.strerror).lower()}; check who may read it") from e
    except (ValueError, RecursionError) as e:  # of TOML, with the line, or of UTF-8; brackets in brackets
        raise ConfigError(f"{path}: not TOML: {str(e).lower()}; write key = value, strings in quotes") from e


def _board_file(folder: Path, board: Any, where: str) -> Path:
    boards = {path.stem.removeprefix("board-"): path for path in sorted(folder.glob("board-*.toml"))}
    if not (isinstance(board, str) and board in boards):
        there = ", ".join(boards) or "none"
        raise ConfigError(f"{where}: board = {shown(board)} has no board-NAME.toml in {folder}; boards there: {there}")
    return boards[board]


def _parse_set(text: str) -> dict[str, Any]:
    """`section.key=value` as the table that a file would give."""
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
    """Each value of a layer with its full name, as its field's type."""
    for section, content in table.items():
        if section not in _SECTIONS:
            raise _unknown(section, [*_SECTIONS, "board"], where)
        if not isinstance(content, dict):
            raise ConfigError(
                f"{where}: {section} = {shown(content)} is not a section; write [{section}], its keys below"
            )
        named = {f"{section}.{last}": value for last, value in content.items()}
        yield from read_table(
            _KEYS, named,
            unknown=lambda name: _unknown(name, [*_KEYS], where), refused=lambda why: ConfigError(f"{where}: {why}"),
        ).items()  # fmt: skip


def _unknown(name: str, known: list[str], where: str) -> ConfigError:
    """A right key in the wrong section is told before a key that only looks alike."""
    last = name.rpartition(".")[2]
    known = [k for k in known if k != name]
    near = [k for k in _KEYS if k.endswith(f".{last}")] or closest(name, known)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    return ConfigError(f"{where}: {name if name.isprintable() else shown(name)} is unknown; {hint}")


def _check_lines(values: Mapping[str, Any], sources: Mapping[str, str]) -> None:
    """Every line has one meaning."""
    taken: dict[str, str] = {}
    for name in (n for n, key in _KEYS.items() if "line" in key.limits):
        for line in filter(None, [values[name]] if isinstance(values[name], str) else values[name]):
            if line in taken:
                first = f"{taken[line]} ({sources[taken[line]]})"
                raise ConfigError(
                    f'{sources[name]}: {name} = {line!r} is the line of {first} already; give each its own line, or ""'
                )
            taken[line] = name

"""The command `palpate teach`: a session of teaching, or a single step of it."""

from __future__ import annotations

import argparse
import getpass
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from importlib.util import find_spec

from palpate.cli import record_command
from palpate.cli.common import load_settings
from palpate.cli.options import TEACH_PORT
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.errors import ApplianceError, ConfigError, FormatError
from palpate.core.log import log
from palpate.core.names import composed
from palpate.deployment.enrolment_key import TAUGHT, EnrolmentKey
from palpate.learn import install, materials
from palpate.learn.process import News
from palpate.learn.program import NOTHING, TaughtLesson, TeachingProgram
from palpate.learn.session import refuse_trained
from palpate.runtime import assembly
from palpate.sweeps import unknown_sweeps
from palpate.sweeps.recording import Labels
from palpate.sweeps.sweep_folder import RecordedSweep, SweepFolder


def run(args: argparse.Namespace) -> int:
    """Teach the box, until its bundle is made, Ctrl-C or SIGTERM."""
    settings = load_settings(args)
    install.check_allowed(settings)
    if args.forget is not None:
        return _forget(settings, args.forget)
    if args.unknown is not None and not _adopt(args, settings):
        return 0
    if args.use and not args.labels and args.web is None:
        return _use(args, settings)
    if args.sim and settings.sources["store.folder"] == "code":
        raise ConfigError(
            "--sim must not teach a box: name a folder for simulated sweeps with --set "
            "store.folder=DIR"
        )
    if not args.labels and args.web is None:
        return _in_json(args, lambda: _assess(args, settings))
    _check_key(settings)
    taught = args.labels, args.position, args.session, args.good, args.by
    lesson = TaughtLesson(*taught, _options(args), capture=args.capture)
    if args.web is not None:
        _session(args, without_lines(args, settings), lesson, args.web)
        return 0
    _session(args, settings, lesson)
    try:
        _assess(args, settings)
    except install.TeachingFailed as e:  # the sweeps are stored; there are too few so far
        print(f"teach: {e}")
    return _use(args, settings) if args.use else 0


def _check_key(settings: Config) -> None:
    """Raises ConfigError before anything is recorded, if nothing could be taught. A folder of keys
    that a person chooses gets a key."""
    key = EnrolmentKey(settings.store.enrolment_key)
    if settings.sources["store.keys"] == "--set" and key.make():
        log.info(f"teach: {key.folder} has a new key; run with the same --set store.keys")
    key.check(TAUGHT)


def until_taught(args: argparse.Namespace, settings: Config) -> int:
    """The service of a box that has no bundle for its skin: it records and can be taught, and READY
    stays low. It ends once a bundle was made, which runs from the next start on."""
    address = page_address(settings)
    log.warning(
        f"{NOTHING}: READY stays low; teach the box on its page, {address} (systemctl start "
        "palpate-teach starts it at once), or by palpate teach; or deploy a bundle"
    )
    lesson = TaughtLesson(options=_options(args), waits=address, capture=args.capture)
    _session(args, without_lines(args, settings), lesson)
    return 0


def page_address(settings: Config) -> str:
    """The address of the page of teaching, or the reason why there is none."""
    from palpate.web.access import Access

    if not find_spec("tornado"):
        return "no page (pages need palpate[page])"
    try:
        install.check_allowed(settings)
        return Access.configured(settings.watch, TEACH_PORT, secret=False).url(TEACH_PORT)
    except ConfigError as e:
        return f"no page ({e})"


def without_lines(args: argparse.Namespace, settings: Config) -> Config:
    """The settings with sweeps by command, as from a page, where no GPIO line is wired."""
    if args.sim or settings.trigger.start or not settings.trigger.by_lines:
        return settings
    return replace(settings, trigger=replace(settings.trigger, mode="serial"))


def _session(
    args: argparse.Namespace, settings: Config, lesson: TaughtLesson, web: int | None = None
) -> None:
    """Record sweeps and teach them, also on a page at the port `web`."""
    with ExitStack() as stack:
        devices, format = record_command.open_skin(args, settings)
        program = TeachingProgram(settings, devices, format, lesson)
        format = program.format
        talk = program.about, program.obey, program.names.label
        pages = record_command.page(web, settings, format, devices, *talk, teaching=True)
        for page in pages:
            stack.enter_context(page)
        program.run(pages, next((page.server.address for page in pages), lesson.waits))


def _options(args: argparse.Namespace) -> list[str]:
    """The options of the settings, for the process that makes a bundle."""
    options = ["--board", args.board] if args.board else []
    options += ["--config-dir", str(args.config_dir)] if args.config_dir else []
    options += ["--unit", args.unit] if args.unit else []
    sets = [*args.set, *([f"skin.profile={args.skin}"] if args.skin else [])]
    return options + [word for one in sets for word in ("--set", one)]


@contextmanager
def _sweeps(settings: Config) -> Iterator[SweepFolder]:
    """The folder of the recorded sweeps. Raises ConfigError if another program uses it."""
    path = settings.kept("sweeps")
    try:
        with closing(SweepFolder(path, None)) as folder:
            yield folder
    except OSError as e:
        raise ConfigError(f"{path}: {e.strerror}; use the page, or stop that program") from e


def _forget(settings: Config, material: str) -> int:
    """Teach the sweeps of a material, by its label or its name, so far no longer."""
    with _sweeps(settings) as folder:
        name, held = composed(material.strip()), [*folder.sidecars()]
        called = [one for _, one in held if name in (one.get("material"), one.get("display"))]
        material = Labels(str(called[0].get("material")) if called else name).material
        if not called and name not in assembly.running(settings).bundle.enrolled:
            raise ConfigError(f"there is no material {name!r} to forget; name a recorded material")
        folder.forget(material, [n for n, one in held if one.get("material") == material])
    print(f"{material}: its sweeps so far are no longer taught; they stay in {folder.folder}")
    return 0


def _adopt(args: argparse.Namespace, settings: Config) -> bool:
    """Take kept sweeps of one unknown material as sweeps of the label, which then needs no more of
    them; returns whether there is a label. Without one, list them."""
    kept = settings.kept("black-box")
    found = unknown_sweeps.groups(kept, assembly.running(settings).bundle.id)
    if not args.labels:
        print("\n".join(map(str, found)) or "no unknown material was seen twice")
        return False
    group, (label, *others) = unknown_sweeps.chosen(found, args.unknown, kept), args.labels
    if others:
        raise ConfigError(f"--unknown takes sweeps of one material; leave out --label {others[0]}")
    Labels(material=label)
    store = assembly.store(settings)
    base = install.base(store, None)
    refuse_trained(materials.trained(base.bundle) if base else (), [label])
    with _sweeps(settings) as folder:
        for path in group.paths.values():
            try:
                folder.adopt(RecordedSweep.load(path), label)
            except FormatError as e:
                log.warning(f"teach: left out: {e}")
    log.info(f"teach: {label}: {group}")
    args.labels = []
    return True


def _assess(args: argparse.Namespace, settings: Config) -> None:
    found = install.assessed(settings, assembly.store(settings), SystemClock())
    print(json.dumps(found) if args.json else install.described(found), flush=True)


def _in_json(args: argparse.Namespace, act: Callable[[], object]) -> int:
    """Do something; with --json an error is a line of JSON as well."""
    try:
        act()
    except (ApplianceError, OSError) as e:
        if not args.json:
            raise
        code, text = 1, f"{e}; see to the disk (df -h), and try again"
        if isinstance(e, ApplianceError):
            code, text = e.exit_code, str(e)
        print(json.dumps({"type": "error", "text": text}), flush=True)
        return code
    return 0


def _use(args: argparse.Namespace, settings: Config) -> int:

    def tell(news: News) -> None:
        if args.json and news["type"] == "step":
            print(json.dumps(news), flush=True)
        elif news["type"] == "step":
            left = f", about {news['left_s']:.0f} s left" if news["left_s"] else ""
            log.info(f"teach: {news['step']}: {100 * news['done']:.0f} % done{left}")
        else:
            told.update(news)

    def teach() -> None:
        by = args.by or getpass.getuser()
        sha = install.install(settings, assembly.store(settings), by, SystemClock(), tell)
        text = f"bundle {sha[:8]} with {', '.join(told['labels'])} is installed, on trial"
        if args.json:
            print(json.dumps({**told, "type": "taught", "sha": sha, "text": text}), flush=True)
        else:
            print(f"{text} from the next start on: systemctl restart palpate")

    told: News = {}
    return _in_json(args, teach)

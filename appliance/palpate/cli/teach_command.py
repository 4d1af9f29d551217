"""The command `palpate teach`: a session of teaching, or a single step of it."""

from __future__ import annotations

import argparse
import getpass
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from palpate.cli import record_command
from palpate.cli.common import Facts, load_settings
from palpate.cli.options import TEACH_PORT
from palpate.cli.reporting import capture, feed, status
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.disk_thread import DiskThread
from palpate.core.errors import ApplianceError, ConfigError, FormatError
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.core.names import TypedNames
from palpate.core.observer import Observer
from palpate.core.types import SweepFormat
from palpate.deployment.enrolment_key import TAUGHT, EnrolmentKey
from palpate.deployment.signed import SignedBundle
from palpate.io import skins
from palpate.io.robot_link import Command, Port
from palpate.io.verdict_lines import check_bits
from palpate.learn import install, materials
from palpate.learn.enrolment import slide_check
from palpate.learn.hand_over import HandOver
from palpate.learn.process import News
from palpate.learn.session import TeachingSession, refuse_trained
from palpate.learn.teacher import Teacher
from palpate.runtime import assembly
from palpate.service.systemd import Notifier
from palpate.signal.slide_check import SlidesAmong
from palpate.sweeps import unknown_sweeps
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_folder import RecordedSweep, SweepFolder

if TYPE_CHECKING:
    from palpate.web.record import RecordPage

NOTHING, GOOD = "nothing taught yet", 8
"""The model of a box that is being taught, in status and feed; and its wanted number of sweeps."""


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
    if args.labels or args.web is not None:
        EnrolmentKey(settings.store.enrolment_key).check(TAUGHT)
        Session(args, settings).run()
        if args.web is not None:
            return 0
        try:
            _assess(args, settings)
        except install.TeachingFailed as e:  # the sweeps are stored; there are too few so far
            print(f"teach: {e}")
        return _use(args, settings) if args.use else 0
    return _in_json(args, lambda: _assess(args, settings))


def until_taught(args: argparse.Namespace, settings: Config) -> int:
    """The service of a box that has no bundle for its skin: it records and can be taught, and READY
    stays low. It ends once a bundle was made, which runs from the next start on."""
    address = page_address(settings)
    log.warning(
        f"{NOTHING}: READY stays low; teach the box on its page, {address} (systemctl start "
        "palpate-teach starts it at once), or by palpate teach; or deploy a bundle"
    )
    defaults = {"labels": [], "good": GOOD, "position": "1", "session": "", "web": None}
    defaults |= {"unknown": None, "use": False, "by": "", "format": None, "window": None}
    taught = argparse.Namespace(**vars(args) | defaults)
    Session(taught, without_lines(args, settings), waits=address).run()
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


@contextmanager
def _sweeps(settings: Config) -> Iterator[SweepFolder]:
    """The folder of the recorded sweeps. Raises ConfigError if another program uses it."""
    path = settings.kept("sweeps")
    try:
        folder = SweepFolder(path, None)
        try:
            yield folder
        finally:
            folder.close()
    except OSError as e:
        raise ConfigError(f"{path}: {e.strerror}; use the page, or stop that program") from e


def _forget(settings: Config, material: str) -> int:
    """Teach the sweeps of a material so far no longer."""
    Labels(material=material)
    with _sweeps(settings) as folder:
        own = [n for n, about in folder.sidecars() if about.get("material") == material]
        folder.forget(material, own)
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
    """Print the assessment of the recorded sweeps."""
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
    """Make a bundle of all sweeps, sign and install it."""

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


def by_page(args: argparse.Namespace, settings: Config) -> Config:
    """The settings of a session: where no GPIO line is wired, the page starts and stops sweeps."""
    return settings if args.web is None else without_lines(args, settings)


def without_lines(args: argparse.Namespace, settings: Config) -> Config:
    """The settings with sweeps by command where no GPIO line is wired."""
    if args.sim or settings.trigger.start or not settings.trigger.by_lines:
        return settings
    return replace(settings, trigger=replace(settings.trigger, mode="serial"))


class Session:
    """Records and assesses until a bundle is made; with a page, then tries it until DONE.

    waits: address of the page to which the service hands over, or the reason why there is none. It
    runs even if nothing can start a sweep; "" outside of the service.
    """

    def __init__(self, args: argparse.Namespace, settings: Config, *, waits: str = "") -> None:
        self._waits = waits
        self._args, self._settings, self._stopped = args, by_page(args, settings), StopFlag()
        self._obey: Callable[[Command], list[object]] = _not_now
        self._names = TypedNames()
        self._about: Callable[[], Mapping[str, Any]] = dict
        self._done, self._again, self._address = False, "", waits
        bits = settings.output.class_bits
        self._base: SignedBundle | None = None
        self._codes = 1 << len(bits) if bits else 0
        self._tried: tuple[str, ...] = ()

    def run(self) -> None:
        """Run until all sweeps are recorded; with a page until DONE."""
        with ExitStack() as stack:
            devices, format = record_command.open_skin(self._args, self._settings)
            self._base = install.base(assembly.store(self._settings), format)
            if self._base:  # sweeps as long as those of its materials
                format = self._base.bundle.format
                materials.check_settings(self._settings)
            pages = self._page(format, devices)
            for page in pages:
                stack.enter_context(page)
            made = self._teach(devices, format, pages)
            while made and pages and not self._ended:
                self._again = ""
                self._try(devices, pages)
                if self._again and not self._ended:
                    made = self._teach(devices, format, pages)

    @property
    def _ended(self) -> bool:
        return self._done or self._stopped()

    def _page(self, format: SweepFormat, devices: Devices) -> list[RecordPage]:
        if self._args.web is None:
            return []
        from palpate.web.access import Access
        from palpate.web.record import RecordPage

        access = Access.configured(self._settings.watch, self._args.web)
        page = RecordPage(
            access,
            format,
            devices.source,
            devices.wire(self._settings).trigger,
            lambda: self._about(),
            lambda command: self._obey(command),
            SystemClock(),
            skins.profile(self._settings).unit,
            self._names.label,
            teaching=True,
        )
        self._address = page.server.address
        log.info(f"page: {self._address}")
        return [page]

    def _teach(self, devices: Devices, format: SweepFormat, pages: list[RecordPage]) -> bool:
        """Record and assess; returns whether a bundle was made."""
        args, settings = self._args, self._settings
        with ExitStack() as stack:
            port, disk = self._port(devices), DiskThread()
            say = port.say if port else lambda line: None
            labels = Labels(self._again, args.position, args.session)
            to, names = (settings.kept("sweeps"), format, labels), self._names
            recording = RecordingSession(*to, devices.clock, say, args.good, disk, names)
            stack.callback(recording.close)
            session = self._lesson(recording, say)
            stack.callback(session.close)
            teacher = Teacher(session, args.labels if not self._again else [], args.good)
            self._about = lambda: self._shown(recording.about() | {"teach": session.about()})
            box = assembly.recorder(
                settings,
                format,
                devices,
                port,
                stack,
                capture=capture(args, settings, format, stack),
                observers=[
                    disk,
                    *self._observers(recording, session, format, devices),
                    teacher,
                    *pages,
                ],
                commands={**session.recording_commands, **self._by_robot(session.commands)},
                ordered=bool(pages or self._waits),
                serving=False,
                slides=slide_check(self._base.bundle) if self._base else SlidesAmong(format),
            )
            orders = {**session.recording_commands, **session.commands, "DONE": self._finish}
            self._obey = self._orders(orders, box.obey)
            session.by = "the page" if pages else args.by or getpass.getuser()
            over = (lambda: self._ended, lambda: session.taught, lambda: teacher.done)
            box.run(lambda: any(end() for end in over) or devices.finished(box.answered))
            self._obey = _not_now
            return bool(session.taught)

    def _lesson(self, recording: RecordingSession, say: Callable[[bytes], None]) -> TeachingSession:
        """The session beside a recording. Raises ConfigError for a --label that it refuses."""
        if self._base:  # it has the materials of an earlier session by now
            self._base = install.base(assembly.store(self._settings), self._base.bundle.format)
        base = self._base.bundle if self._base else None
        session = TeachingSession(
            recording,
            self._settings.teach,
            self._command,
            say,
            codes=self._codes,
            base=base.manifest.labels if base else (),
            trained=materials.trained(base) if base else (),
        )
        if self._args.labels:
            session.admit(*self._args.labels)
        return session

    def _try(self, devices: Devices, pages: list[RecordPage]) -> None:
        """Classify with the new bundle, on trial as in the service."""
        settings = self._settings
        choice = assembly.store(settings).choose()
        with ExitStack() as stack:
            trial, disk = [stack.enter_context(choice.trial)] if choice.trial else [], DiskThread()
            for one in trial:
                one.disk = disk
            port = self._port(devices)
            m = choice.bundle.manifest
            self._tried = m.labels
            shown = {
                "model": f"{m.name} {m.version}",
                "labels": m.labels,
                "displays": m.displays,
                "taught": m.taught or f"taught into it: {', '.join(choice.bundle.enrolled)}",
            }
            self._about = lambda: self._shown({"trying": shown})
            facts: Facts = {"model": lambda: f"{m.name} {m.version}, {m.taught}"}
            box = assembly.box(
                settings,
                choice.bundle,
                devices,
                port,
                stack,
                observers=[disk, Notifier(SystemClock()), *trial, *status(settings, facts), *pages],
                commands=self._by_robot({"TEACH": self._teach_again}),
                ordered=bool(pages),
            )
            orders = {"TEACH": self._teach_again, "DONE": self._finish}
            self._obey = self._orders(orders, box.obey)
            box.run(lambda: self._ended or bool(self._again) or devices.finished(box.answered))
            self._obey = _not_now

    def _observers(
        self,
        recording: RecordingSession,
        session: TeachingSession,
        format: SweepFormat,
        devices: Devices,
    ) -> list[Observer]:
        facts: Facts = {
            "model": lambda: NOTHING,
            "recorded": lambda: recording.about()["missing"],
            "teach": session.about,
            "page": lambda: self._address,
        }
        settings, runtime = self._settings, self._settings.store.runtime_folder
        page = self._waits.startswith("http")
        waits = [HandOver(runtime, SystemClock())] if page and runtime else []
        return [
            Notifier(SystemClock(), note=f"; {NOTHING}: {self._address}" if self._waits else ""),
            *waits,
            recording,
            session,
            *status(settings, facts),
            *feed(settings, format, devices.source, {"bundle": "", "labels": []}, facts),
        ]

    def _orders(
        self,
        orders: Mapping[str, Callable[[str], list[object]]],
        obey: Callable[[Command], list[object]],
    ) -> Callable[[Command], list[object]]:
        """Carries out an order of the page: those of the session, and those of the box."""

        def carry_out(command: Command) -> list[object]:
            own = orders.get(command.name)
            return own(command.text) if own else obey(command)

        return carry_out

    def _by_robot(
        self, commands: Mapping[str, Callable[[str], list[object]]]
    ) -> dict[str, Callable[[str], list[object]]]:
        """The commands that the serial line carries, if the settings allow them to a robot."""
        own = {name: act for name, act in commands.items() if name != "DISCARD"}
        return own if self._settings.teach.serial else dict.fromkeys(own, _forbidden)

    def _port(self, devices: Devices) -> Port | None:
        sentences = self._settings.serial.port or not sys.stdout.isatty()
        return assembly.port(self._settings, devices) if sentences else None

    def _shown(self, about: dict[str, Any]) -> dict[str, Any]:
        return about | {"good": self._args.good}

    def _command(self, by: str) -> list[str]:
        """The command of the process that makes a bundle, with the same settings."""
        args = self._args
        options = ["--board", args.board] if args.board else []
        options += ["--config-dir", str(args.config_dir)] if args.config_dir else []
        options += ["--unit", args.unit] if args.unit else []
        sets = [*args.set, *([f"skin.profile={args.skin}"] if args.skin else [])]
        options += [word for one in sets for word in ("--set", one)]
        return install.command(options, by)

    def _teach_again(self, label: str) -> list[object]:
        label = label.strip()
        Labels(material=label)
        refuse_trained(materials.trained(self._base.bundle) if self._base else (), [label])
        if self._codes:
            check_bits(self._codes, [*dict.fromkeys((*self._tried, label))])
        self._again = label
        return [self._again]

    def _finish(self, _: str) -> list[object]:
        self._done = True
        return []


def _forbidden(_: str) -> list[object]:
    raise ApplianceError("the robot may not teach this box; set teach.serial = true to allow it")


def _not_now(command: Command) -> list[object]:
    raise ApplianceError(f"{command.name} is not possible at this moment; try again")

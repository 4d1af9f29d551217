"""Steps that several commands share: settings, bundle, a local page."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.errors import BundleDenied, ConfigError
from palpate.core.log import log

if TYPE_CHECKING:
    from palpate.bundle.bundle import Bundle
    from palpate.web.server import PageServer


def load_settings(args: argparse.Namespace) -> Config:
    """The settings with the changes that a command's options make. Raises ConfigError."""
    sets = list(args.set)
    for key, option in (("profile", "skin"), ("port", "skin_port")):
        if value := getattr(args, option, None):
            sets.append(f"skin.{key}={value}")
    every, sweep = getattr(args, "every", None), getattr(args, "sweep", None)
    mode = getattr(args, "trigger", None)
    if every is not None or sweep is not None:
        if mode not in (None, "timed"):
            raise ConfigError(
                f"--every and --sweep are for --trigger timed, not for {mode}; leave them out"
            )
        mode = "timed"
    sets += [f"trigger.mode={mode}"] if mode else []
    settings = config.load(args.board, sets, folder=args.config_dir, unit=args.unit)
    times = {name: s for name, s in (("every_s", every), ("sweep_s", sweep)) if s is not None}
    if times:
        settings = replace(settings, trigger=replace(settings.trigger, **times))
    return settings


def load_bundle(settings: Config, *, answers: bool = True) -> Bundle:
    """The bundle of the settings; see assembly.running. Raises BundleDenied without the rights."""
    from palpate.runtime import assembly

    try:
        return assembly.running(settings, answers=answers).bundle
    except PermissionError as e:
        how = "use the service's rights: sudo -u palpate palpate ..., with the same command"
        raise BundleDenied(f"{e.filename}: this user may not read the bundle; {how}") from e


def local_page(name: str, port: int | None, stack: ExitStack) -> list[PageServer]:
    """The server of a page for browsers on this machine, if there is a port."""
    if port is None:
        return []
    from palpate.web.access import Access
    from palpate.web.server import PageServer

    server = stack.enter_context(PageServer(name, Access(port), SystemClock().now_ns))
    log.info(f"page: {server.address}")
    return [server]

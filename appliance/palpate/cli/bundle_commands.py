"""The command `palpate bundles`: list, install, verify, commit, roll back, promote."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.cli.common import load_settings
from palpate.core.clock import SystemClock
from palpate.core.config import Config, StoreConfig
from palpate.core.errors import ApplianceError, BundleError
from palpate.core.types import SweepFormat
from palpate.deployment.signed import PACKAGER
from palpate.deployment.state import MOST_STARTS, PACKAGED, StoreState
from palpate.deployment.store import SHA, Store
from palpate.io.usb_sensor import fits
from palpate.runtime import assembly
from palpate.service import status

NEXT = "from the next start on: systemctl restart palpate"


@dataclass(frozen=True, slots=True)
class ListedBundle:
    """One bundle of the store. sha and signature are empty for the packaged bundle. role: current,
    on trial, previous (`rollback` returns to it), candidate, left, kept, or damaged. detail:
    progress of the trial, reason for leaving the bundle, or its damage."""

    sha: str
    id: str
    name: str
    version: str
    counter: int
    signer: str
    role: str
    detail: str


def entries(store: Store) -> list[ListedBundle]:
    """The bundles of the store, in the order of their roles."""
    current, state = store.current, store.state
    folder = store.bundles.folder
    names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    shas = (*filter(SHA.fullmatch, names), PACKAGED)
    listed = [_entry(store, sha, current, state) for sha in shas]
    order = ("current", "on trial", "previous", "candidate", "left", "kept", "damaged")
    return sorted(listed, key=lambda e: order.index(e.role))


def lines(listed: Iterable[ListedBundle]) -> list[str]:
    rows = [("role", "id", "bundle", "counter", "signed by", "")]
    for e in listed:
        name = f"{e.name} {e.version}"
        rows.append((e.role, e.id, name, str(e.counter), e.signer, e.detail))
    wide = [max(len(row[i]) for row in rows) for i in range(5)]
    return ["  ".join([*map(str.ljust, row[:5], wide), row[5]]).rstrip() for row in rows]


def _entry(store: Store, sha: str, current: str, state: StoreState) -> ListedBundle:
    role, detail = _role(sha, current, state, store.settings)
    try:
        if sha == PACKAGED:
            loaded, signer = bundle.load(bundle.DEFAULT), PACKAGER
        else:
            signed = store.bundles.get(sha)
            loaded, signer = signed.bundle, signed.signer
    except BundleError as e:
        why = " ".join(filter(None, (role, detail, str(e))))
        return ListedBundle(sha, sha[:8], "?", "?", 0, "?", "damaged", why)
    m = loaded.manifest
    return ListedBundle(sha, loaded.id, m.name, m.version, m.counter, signer, role, detail)


def _role(sha: str, current: str, state: StoreState, settings: StoreConfig) -> tuple[str, str]:
    standing = state.of(sha)
    if sha == current and standing.committed:
        return "current", ""
    if sha == current:
        trial = f"start {standing.starts} of {MOST_STARTS}"
        trial += f", {standing.sweeps} of {settings.trial_sweeps} sweeps"
        trial += f", {standing.streamed_s:.0f} of {settings.trial_s:.0f} s"
        return "on trial", f"{trial}, as of its last start or end"
    if sha == state.of(current).previous:
        return "previous", ""
    if sha == state.candidate != PACKAGED:
        return "candidate", ""
    return ("kept", "") if standing.committed else ("left", standing.why or "another was deployed")


def run_list(args: argparse.Namespace) -> int:
    from palpate.deployment import shadow

    settings = load_settings(args)
    store, folder = assembly.store(settings), Path(settings.store.folder) / "shadow"
    listed, agreement = entries(store), shadow.read(folder)
    text = lines(listed)
    if agreement and store.state.candidate.startswith(agreement.candidate):
        text += agreement.lines(folder)
    print(json.dumps([asdict(e) for e in listed], indent=1) if args.json else "\n".join(text))
    return 0


def run_install(args: argparse.Namespace) -> int:
    """Put a signed bundle into the store."""
    settings = load_settings(args)
    store = assembly.store(settings)
    skin = None if args.other_skin else streaming(settings, store)
    sha = store.install(args.folder, args.shadow, lambda new: suits(new, skin))
    how = "it is the candidate"
    if not args.shadow:
        committed = store.state.of(sha).committed
        how = "it is committed already" if committed else f"it runs on trial {NEXT}"
    if settings.classifier.bundle:
        how += "; it does not run while the settings name another bundle: classifier.bundle"
    print(f"bundle {sha[:8]} is installed; {how}")
    return 0


def streaming(settings: Config, store: Store) -> SweepFormat | None:
    """The format of the skin that streams into the service, None if it is not known."""
    try:
        if not settings.store.status:
            return None
        report = status.read(settings.store.status, SystemClock().now_ns())
        running = store.running().bundle
    except ApplianceError:  # `palpate status` and `palpate bundles` say what is wrong with them
        return None
    runs = report["running"] and report["streams"] and report["bundle"] == running.id
    return running.format if runs else None


def suits(new: Bundle, skin: SweepFormat | None) -> None:
    """Raise BundleError if `new` is for another skin than the streaming one (None: not known)."""
    if skin and not fits(skin, new.format):
        raise BundleError(
            f"bundle {new.id} is for a skin of {new.format}, and the skin that streams has {skin};"
            " it would answer no sweep; if another skin comes with it, use --other-skin (make"
            " deploy OTHER_SKIN=1)"
        )


def run_verify(args: argparse.Namespace) -> int:
    """Examine a bundle as `install` does, without its counter."""
    signed = assembly.store(load_settings(args)).examine(args.folder)
    m = signed.bundle.manifest
    kind = f"{m.name} {m.version}, counter {m.counter}, signed by {signed.signer}"
    print(f"bundle {signed.bundle.id}: {kind}; all is well")
    return 0


def run_commit(args: argparse.Namespace) -> int:
    print("committed" if assembly.store(load_settings(args)).commit() else "nothing is on trial")
    return 0


def run_rollback(args: argparse.Namespace) -> int:
    sha = assembly.store(load_settings(args)).rollback()
    print(f"{f'bundle {sha[:8]}' if sha else 'the packaged bundle'} runs {NEXT}")
    return 0


def run_promote(args: argparse.Namespace) -> int:
    print(f"bundle {assembly.store(load_settings(args)).promote()[:8]} runs on trial {NEXT}")
    return 0

"""The store, told. In: a store. Out: an entry for each of its bundles, and lines for a person."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appliance.bundle import bundle
from appliance.core.errors import BundleError
from appliance.deployment.state import MOST_STARTS, PACKAGED, StoreState
from appliance.deployment.store import SHA, Store

if TYPE_CHECKING:
    from appliance.core.config import StoreConfig


@dataclass(frozen=True, slots=True)
class ListedBundle:
    """One bundle of the store; sha "" for the packaged one, which nobody signed.

    role: current, on trial, previous (what `palpate rollback` goes back to), candidate, left, kept, or damaged.
    detail: how far its trial is, why it was left, what is wrong with it.
    """

    sha: str
    id: str
    name: str
    version: str
    counter: int
    signer: str
    role: str
    detail: str


def entries(store: Store) -> list[ListedBundle]:
    """The store's bundles, those that matter most first."""
    current, ledger = store.current, store.state
    there = sorted(p.name for p in store.bundles.folder.iterdir()) if store.bundles.folder.is_dir() else []
    told = [_entry(store, sha, current, ledger) for sha in (*filter(SHA.fullmatch, there), PACKAGED)]
    order = ("current", "on trial", "previous", "candidate", "left", "kept", "damaged")
    return sorted(told, key=lambda e: order.index(e.role))


def lines(told: Iterable[ListedBundle]) -> list[str]:
    """A table for a person."""
    rows = [(e.role, e.id, f"{e.name} {e.version}", str(e.counter), e.signer, e.detail) for e in told]
    rows = [("role", "id", "bundle", "counter", "signed by", ""), *rows]
    wide = [max(len(row[i]) for row in rows) for i in range(5)]
    return ["  ".join([*(t.ljust(w) for t, w in zip(row, wide, strict=False)), row[-1]]).rstrip() for row in rows]


def _entry(store: Store, sha: str, current: str, ledger: StoreState) -> ListedBundle:
    role, detail = _role(sha, current, ledger, store.settings)
    try:
        if sha == PACKAGED:
            found, signer = bundle.load(bundle.DEFAULT), "palpate"
        else:
            held = store.bundles.get(sha)
            found, signer = held.bundle, held.signer
    except BundleError as e:
        return ListedBundle(sha, sha[:8], "?", "?", 0, "?", "damaged", " ".join(filter(None, (role, detail, str(e)))))
    m = found.manifest
    return ListedBundle(sha, found.id, m.name, m.version, m.counter, signer, role, detail)


def _role(sha: str, current: str, ledger: StoreState, how: StoreConfig) -> tuple[str, str]:
    standing = ledger.of(sha)
    if sha == current and standing.committed:
        return "current", ""
    if sha == current:
        return "on trial", (
            f"start {standing.starts} of {MOST_STARTS}, {standing.sweeps} of {how.trial_sweeps} sweeps, "
            f"{standing.streamed_s:.0f} of {how.trial_s:.0f} s, as of its last start or end"
        )
    if sha == ledger.of(current).previous:
        return "previous", ""
    if sha == ledger.candidate != PACKAGED:
        return "candidate", ""
    return ("kept", "") if standing.committed else ("left", standing.why or "another was deployed")

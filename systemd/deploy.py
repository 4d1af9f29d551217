"""Delivers a bundle to boxes, and prints a line for each box.

A box does not trust the copied files: `palpate bundles install` checks signature, manifest, model
and golden sweeps with the box's runtime, and the bundle runs on trial from the next start on. If
the delivery is interrupted at any moment, the box has the old bundle or the new bundle; run the
command again to finish.
"""

from __future__ import annotations

import io
import json
import sys
import tarfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from fleet import PALPATE, Failed, FleetBox, each, options
from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.config import StoreConfig
from palpate.core.errors import ApplianceError, BundleError
from palpate.deployment import signature
from palpate.inference.classifier import Classifier

READY_S, STARTS = 60, 5
"""Limits for READY, in seconds and in failed starts. After three failed starts a box goes back by
itself, so after five there is no hope."""
MOST_STATUS = 1 << 20
"""Most bytes that are read of a status file."""
COUNTER = str(StoreConfig().least_counter)
"""Root's file with the counter of the last delivery."""
LIMIT_S = 300
"""Time limit for each box."""


@dataclass(frozen=True)
class BundleArchive:
    """A bundle as it is copied to boxes. sha: its name in their stores. name: for messages.
    counter: of its manifest. archive: a tar of its files."""

    sha: str
    name: str
    counter: int
    archive: bytes


def main(argv: list[str] | None = None) -> int:
    """Deliver to all boxes; the exit code."""
    parser = options("Delivers a signed bundle to boxes, where it runs on trial.", LIMIT_S)
    parser.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    parser.add_argument(
        "--signers", type=Path, metavar="FILE", help="also check the signature here, with this file"
    )
    parser.add_argument(
        "--shadow", action="store_true", help="as the candidate, which classifies in the background"
    )
    parser.add_argument(
        "--other-skin",
        action="store_true",
        help="the bundle is for another skin than the box has now, which will be changed with it",
    )
    args = parser.parse_args(argv)
    try:
        packed = checked(args.bundle, args.signers)
    except ApplianceError as e:
        print(f"palpate: {e}", file=sys.stderr)
        return e.exit_code
    return each(args, lambda box: deliver(box, packed, args.shadow, args.other_skin))


def checked(folder: Path, signers: Path | None) -> BundleArchive:
    """The bundle in `folder`, once it has passed its checks and golden sweeps here. Raises
    ApplianceError if it fails."""
    files = bundle.files(folder)
    loaded = bundle.from_files(files, str(folder))
    Classifier(loaded, SystemClock()).self_test()
    if bundle.SIGNATURE not in files:
        raise BundleError(f"{folder} is not signed; sign it with palpate-train sign")
    if signers:
        signature.verify(files[bundle.MANIFEST], files[bundle.SIGNATURE], signers)
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    m = loaded.manifest
    sha = bundle.name(files)
    return BundleArchive(sha, f"{m.name} {m.version} ({loaded.id})", m.counter, archive.getvalue())


def deliver(box: FleetBox, packed: BundleArchive, shadow: bool, other_skin: bool) -> str:
    """Install the bundle on one box, or make it the candidate there; the line for this box."""
    store, status = where(box)
    if not shadow and _runs(box, packed, store, status):
        box.run("noting its counter", raised(packed.counter), user="root")
        return f"{packed.name} runs already"
    file, incoming = f".palpate-{packed.sha[:16]}.tar", f"{store}/incoming"
    box.put(io.BytesIO(packed.archive), file)
    # also removes files of an interrupted delivery
    fresh = (
        f"umask 077; mkdir -p {incoming} && find {incoming} -mindepth 1 -delete && "
        f"mkdir {incoming}/{packed.sha}"
    )
    box.run("copying", f"{fresh} && tar -x -C {incoming}/{packed.sha}", user="palpate", stdin=file)
    box.run("tidying up", f"rm {file}")
    how = (" --shadow" if shadow else "") + (" --other-skin" if other_skin else "")
    install = f"{PALPATE} bundles install {incoming}/{packed.sha}{how}"
    box.run("checking it there", install, user="palpate", limit_s=120)
    box.run("tidying up", f"rm -r {incoming}/{packed.sha}", user="palpate")
    if not shadow:
        box.run("noting its counter", raised(packed.counter), user="root")
    return outcome(box, packed, ready=box.restart(READY_S, STARTS), shadow=shadow)


def raised(counter: int, file: str = COUNTER) -> str:
    """The command that lets a box refuse bundles with a lower counter, also when the state of its
    store is removed. An earlier, higher counter stays."""
    return (
        f'umask 022; [ "$(cat {file} 2> /dev/null || echo 0)" -ge {counter} ] || '
        f"{{ echo {counter} > {file}.new && sync -f {file}.new && mv {file}.new {file}; }}"
    )


def where(box: FleetBox) -> tuple[str, str]:
    """Paths on the box: the folder of its store and its status file. Raises Failed if the box would
    not use a delivered bundle."""
    lacks = "{ echo 'no Palpate is installed there; make install HOST=... first' >&2; exit 1; }"
    settings = tomllib.loads(
        box.run(
            "asking for its settings", f"test -x {PALPATE} || {lacks}; {PALPATE} check --settings"
        )
    )
    if own := settings["classifier"]["bundle"]:
        raise Failed(
            f"its settings name a bundle, classifier.bundle = {own!r}; remove this setting first"
        )
    folder, runtime = (str(settings["store"][key]) for key in ("folder", "runtime"))
    return folder, f"{runtime}/status.json"


def _runs(box: FleetBox, packed: BundleArchive, store: str, status: str) -> bool:
    """Whether the box runs the bundle now, and will after a restart. A status that cannot be read
    counts as another bundle."""
    look = f"readlink {store}/current && head -c {MOST_STATUS} {status}"
    # as the service's user, which owns the file: the file may be a link
    seen = box.run("asking what runs", f"{{ {look}; }} 2>/dev/null || true", user="palpate")
    link, _, text = seen.partition("\n")
    try:
        bundle = json.loads(text)["bundle"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return False
    return link == f"bundles/{packed.sha}" and bundle == packed.sha[:8]


def outcome(box: FleetBox, packed: BundleArchive, *, ready: bool, shadow: bool) -> str:
    """The present role of the bundle on the box, in words. Raises Failed if the box has gone back
    already."""
    listed = json.loads(
        box.run("asking for its bundles", f"{PALPATE} bundles --json", user="palpate")
    )
    entry = next((one for one in listed if one["sha"] == packed.sha), None)
    if entry is None or entry["role"] not in ("current", "on trial", "candidate"):
        raise Failed(
            "the box went back to its earlier bundle: "
            f"{entry['detail'] if entry else 'the bundle is gone'}"
        )
    if shadow != (entry["role"] == "candidate"):
        raise Failed(f"the bundle is {entry['role']} there; another delivery ran at the same time")
    role = f"{entry['role']}: {entry['detail']}" if entry["detail"] else entry["role"]
    if not ready and box.result["waits"].startswith("skin mismatch"):
        raise Failed(
            f"the bundle is {role}, but {box.result['waits']}; palpate bundles rollback goes back"
        )
    if not ready:
        return f"{packed.name} is {role}; READY waits: {box.result['waits']}"
    lost = f"{box.result['lost_s']} s without classifying; " if "lost_s" in box.result else ""
    return f"{packed.name} is READY {box.result['ready_s']} s after the command; {lost}{role}"


if __name__ == "__main__":
    sys.exit(main())

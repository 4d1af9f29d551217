"""Delivers a bundle to boxes. In: which boxes, the bundle's folder. Out: a line for each box.

What is copied to a box is not trusted there: `palpate install` checks signature, manifest, model and golden sweeps with the
box's own runtime and has it run from the next start on, on trial. Cut at any moment, the box has the old bundle or the
new one; run the command again to finish.
"""

from __future__ import annotations

import io
import json
import sys
import tarfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from fleet import PALPATE, Box, Failed, each, options

from appliance.bundle import bundle
from appliance.core.clock import SystemClock
from appliance.core.errors import ApplianceError, BundleError
from appliance.deployment import signature
from appliance.inference.classifier import Classifier

READY_S, STARTS = 60, 5
"""After three starts in vain a box goes back by itself: one that does not come up then will not."""
LIMIT_S = 300
"""For all of one box."""


@dataclass(frozen=True)
class Parcel:
    """What goes to the boxes. sha: of the manifest, hexadecimal. name: for a person. archive: a tar of its files."""

    sha: str
    name: str
    archive: bytes


def main(argv: list[str] | None = None) -> int:
    """Deliver to all boxes; the exit code."""
    parser = options("Delivers a signed bundle to boxes, where it runs on trial.", LIMIT_S)
    parser.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    parser.add_argument("--signers", type=Path, metavar="FILE", help="check the signature here, too, by this file")
    parser.add_argument("--shadow", action="store_true", help="as the candidate, which classifies beside")
    args = parser.parse_args(argv)
    try:
        parcel = checked(args.bundle, args.signers)
    except ApplianceError as e:
        print(f"palpate: {e}", file=sys.stderr)
        return e.exit_code
    return each(args, lambda box: deliver(box, parcel, args.shadow))


def checked(folder: Path, signers: Path | None) -> Parcel:
    """The bundle in `folder`, when it does here what its manifest says. Raises ApplianceError where it does not."""
    files = bundle.files(folder)
    held = bundle.made(files, str(folder))
    Classifier(held, SystemClock()).self_test()
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
    m = held.manifest
    sha = bundle.digest(files[bundle.MANIFEST])
    return Parcel(sha, f"{m.name} {m.version} ({held.id})", archive.getvalue())


def deliver(box: Box, parcel: Parcel, shadow: bool) -> str:
    """Have one box run the bundle, or take it as its candidate; its line."""
    store, status = where(box)
    if not shadow and _runs(box, parcel, store, status):
        return f"{parcel.name} runs already"
    file, incoming = f".palpate-{parcel.sha[:16]}.tar", f"{store}/incoming"
    box.put(io.BytesIO(parcel.archive), file)
    # what an earlier one left there goes, too
    fresh = f"umask 077; mkdir -p {incoming} && find {incoming} -mindepth 1 -delete && mkdir {incoming}/{parcel.sha}"
    box.run("copying", f"{fresh} && tar -x -C {incoming}/{parcel.sha}", user="palpate", stdin=file)
    box.run("tidying up", f"rm {file}")
    install = f"{PALPATE} install {incoming}/{parcel.sha}{' --shadow' if shadow else ''}"
    box.run("checking it there", install, user="palpate", limit_s=120)
    box.run("tidying up", f"rm -r {incoming}/{parcel.sha}", user="palpate")
    return told(box, parcel, ready=box.restart(READY_S, STARTS), shadow=shadow)


def where(box: Box) -> tuple[str, str]:
    """The folder of the box's store and the file of its status. Raises Failed where a bundle would not be used."""
    lacks = "{ echo 'no Palpate is installed there; make install HOST=... first' >&2; exit 1; }"
    settings = tomllib.loads(box.run("asking for its settings", f"test -x {PALPATE} || {lacks}; {PALPATE} config"))
    if own := settings["classifier"]["bundle"]:
        raise Failed(f"its settings name a bundle, classifier.bundle = {own!r}; take that out of them first")
    return settings["store"]["folder"], settings["store"]["status"]


def _runs(box: Box, parcel: Parcel, store: str, status: str) -> bool:
    """Whether the box's program runs the bundle now, and will after a start, too."""
    look = f"readlink {store}/current && cat {status}"
    link, _, said = box.run("asking what runs", f"{look} || true", user="root").partition("\n")
    return link == f"bundles/{parcel.sha}" and bool(said) and json.loads(said)["bundle"] == parcel.sha[:8]


def told(box: Box, parcel: Parcel, *, ready: bool, shadow: bool) -> str:
    """What became of the bundle, in words. Raises Failed where the box has left it already."""
    listed = json.loads(box.run("asking for its bundles", f"{PALPATE} bundles --json", user="palpate"))
    entry = next((one for one in listed if one["sha"] == parcel.sha), None)
    if entry is None or entry["role"] not in ("current", "on trial", "candidate"):
        raise Failed(f"the box went back to what it had: {entry['detail'] if entry else 'the bundle is gone'}")
    if shadow != (entry["role"] == "candidate"):
        raise Failed(f"the bundle is {entry['role']} there; somebody else was at work, too")
    role = f"{entry['role']}: {entry['detail']}" if entry["detail"] else entry["role"]
    if not ready and box.told["waits"].startswith("skin mismatch"):
        raise Failed(f"the bundle is {role}, but {box.told['waits']}; palpate rollback goes back")
    if not ready:
        return f"{parcel.name} is {role}; READY waits: {box.told['waits']}"
    lost = f"{box.told['lost_s']} s without classifying; " if "lost_s" in box.told else ""
    return f"{parcel.name} is READY {box.told['ready_s']} s after the command; {lost}{role}"


if __name__ == "__main__":
    sys.exit(main())

"""Alters a signed bundle in every way, and counts the alterations that a box accepts; each is a
failure.

`python -m tests.campaigns.flips --out build/flips.json` flips every bit of a manifest and random
bits of the other files, swaps each file with that of another signed bundle, and tries bundles that
are unsigned, wrongly signed, truncated or older. It does the same with a bundle into which the box
has enrolled a label, including all or some bits of its enrolment. Each is installed like a
delivered bundle, with `Store.install`. Bits of the signature's own file do not count: its line
ends, for example, may differ without changing the signature.
"""

import argparse
import io
import json
import platform
import random
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.core.errors import BundleError
from palpate.core.provenance import commit
from palpate.core.storage import put
from palpate.deployment import signature
from palpate.deployment.enrolment_key import KEY
from tests.cuts.scene import stage
from tests.factories import deliveries, install_scripts
from tests.factories.deliveries import Delivery

Files = dict[str, bytes]
Case = tuple[str, str, Files]
"""An alteration: its kind, a description, and the files."""
FLIPS = 1000
PLAIN: dict[str, Any] = {"figures": {}, "made": {}}
"""The bundles have no figures and no history: two thirds of a manifest, which a box only shows."""
ENROLLED = "enrolled: "
"""Prefix of the kinds of alterations of a bundle with an enrolled label."""
FLIPPED = f"a bit of {bundle.MANIFEST} flipped"


def flipped(files: Files, name: str, bit: int) -> Files:
    """The files with one bit of one file flipped."""
    data = bytearray(files[name])
    data[bit // 8] ^= 1 << bit % 8
    return files | {name: bytes(data)}


def flips(files: Files, name: str, count: int | None, seed: int) -> Iterator[Case]:
    """The files with each bit of one file flipped (None), or with each of `count` random bits."""
    bits: Sequence[int] = range(8 * len(files[name]))
    if count is not None:
        bits = sorted(random.Random(f"{seed} {name}").sample(bits, min(count, len(bits))))
    kind = FLIPPED.replace(bundle.MANIFEST, name)
    return ((kind, f"bit {bit}", flipped(files, name, bit)) for bit in bits)


def swaps(one: Files, other: Files) -> Iterator[Case]:
    """Each file, and each pair of files, replaced by those of another signed bundle."""
    names = sorted(one)
    for i, name in enumerate(names):
        yield "a file swapped", name, one | {name: other[name]}
        for second in names[i + 1 :]:
            swapped = one | {n: other[n] for n in (name, second)}
            yield "two files swapped", f"{name}, {second}", swapped


def without(files: Files, name: str) -> Files:
    """All other files."""
    return {n: data for n, data in files.items() if n != name}


def another(key: Path) -> Files:
    """A bundle that shares no file with the default; its weights differ slightly."""
    held = deliveries.files(4, None, **PLAIN)
    model = bytearray(held[bundle.MODEL])
    model[len(model) // 2] ^= 1
    held[bundle.MODEL] = bytes(model)
    for name in held.keys() & {bundle.GOLDEN, bundle.MEANS}:
        with np.load(io.BytesIO(held[name])) as arrays:
            packed = io.BytesIO()
            np.savez(packed, **arrays)
        held[name] = packed.getvalue()
    return deliveries.signed(held, key)


def enrolled(box: Delivery, bits: int | None, seed: int) -> Iterator[Case]:
    """All alterations of a bundle into which the box has enrolled a label."""
    one, other = (
        deliveries.enrolled(made, box.enrolment_key)
        for made in (deliveries.files(3, box.key, **PLAIN), another(box.key))
    )
    parts = (bundle.ENROLMENT, bundle.ENROLMENT_SIGNATURE)
    yield "not signed", "", without(one, bundle.ENROLMENT_SIGNATURE)
    yield "a base not signed", "", without(one, bundle.SIGNATURE)
    foreign, own = install_scripts.enrolment_key(box.folder / "foreign"), one[bundle.ENROLMENT]
    box_key = box.enrolment_key.folder / KEY
    for who, signed in (
        ("another box", foreign.sign(own)),
        ("a signer", signature.sign(own, box.key)),
        ("the box, for bundles", signature.sign(own, box_key)),
    ):
        yield "wrongly signed", who, one | {bundle.ENROLMENT_SIGNATURE: signed}
    for version in (1, 0):
        base = deliveries.files(version, box.key)
        yield "older", str(version), deliveries.enrolled(base, box.enrolment_key)
    by_box = deliveries.signed(deliveries.files(3, None, name="by the box"), box_key)
    yield "a base signed by the box", "", deliveries.enrolled(by_box, box.enrolment_key)
    yield "labels of another bundle", "", one | {name: other[name] for name in parts}
    for name in sorted(one.keys() - set(parts)):
        yield "a file swapped", name, one | {name: other[name]}
    for cut in (0, 1, len(own) // 2, len(own) - 1):
        yield "a file cut", str(cut), one | {bundle.ENROLMENT: own[:cut]}
    yield "a file longer", "", one | {bundle.ENROLMENT: own + b"\0"}
    for name in sorted(one.keys() - {bundle.SIGNATURE, bundle.ENROLMENT_SIGNATURE}):
        yield from flips(one, name, FLIPS if bits is None else 10, seed)


def others(files: Files, box: Delivery) -> Iterator[Case]:
    """Unsigned, wrongly signed, cut, older."""
    text = files[bundle.MANIFEST]
    yield "not signed", "", without(files, bundle.SIGNATURE)
    unknown = deliveries.key(box.folder / "unknown")
    yield "signed by an unknown key", "", files | {bundle.SIGNATURE: signature.sign(text, unknown)}
    for space in ("file", "git", "palpate", "palpate-bundle2", " "):
        signed = signature.sign(text, box.key, space)
        yield "signed for another use", space, files | {bundle.SIGNATURE: signed}
    for name, data in sorted(files.items()):
        yield "a file missing", name, without(files, name)
        for kept in (0, 1, len(data) // 2, len(data) - 1)[: 4 - (name == bundle.SIGNATURE)]:
            yield "a file cut", f"{name} at {kept}", files | {name: data[:kept]}
        if name != bundle.SIGNATURE:
            yield "a file longer", name, files | {name: data + b"\0"}
    yield "counter not higher", "", deliveries.files(2, box.key, version="other")
    yield "older", "", deliveries.files(1, box.key)
    yield "never counted", "", deliveries.files(0, box.key)
    yield "runtime too new", "", deliveries.files(9, box.key, runtime="99.0.0")


def cases(box: Delivery, manifest_bits: int | None, seed: int) -> Iterator[Case]:
    """All alterations. manifest_bits: number of drawn bits of its manifest, None for all."""
    good, other = deliveries.files(3, box.key, **PLAIN), another(box.key)
    assert not any(good[name] == other[name] for name in good)
    yield from others(good, box)
    yield from swaps(good, other)
    yield from flips(good, bundle.MANIFEST, manifest_bits, seed)
    for name in sorted(good.keys() - {bundle.MANIFEST, bundle.SIGNATURE}):
        yield from flips(good, name, FLIPS if manifest_bits is None else 10, seed)
    for kind, which, files in enrolled(box, manifest_bits, seed):
        yield f"{ENROLLED}{kind}", which, files


def tried(box: Delivery, case: Case) -> str:
    """The box's refusal of an alteration; "" if it accepts it."""
    incoming = box.folder / "altered"
    shutil.rmtree(incoming, ignore_errors=True)
    deliveries.put(incoming, case[2])
    try:
        box.store.install(incoming)
    except BundleError as e:
        return str(e)
    return ""


def believed(box: Delivery, files: Files) -> bool:
    """Whether the signature alone fits the manifest."""
    with suppress(BundleError):
        verify, signed = signature.verify, files[bundle.SIGNATURE]
        return bool(verify(files[bundle.MANIFEST], signed, box.how.signers))
    return False


def campaign(
    folder: Path, manifest_bits: int | None, seed: int, every: int = 0
) -> dict[str, dict[str, int]]:
    """For each kind of alteration: the number tried, the number accepted, and the number of
    refusals that changed the running bundle. Also the number of flipped manifests that the
    signature alone accepts; the box checks it after it has read them.

    every: prints a line after this many alterations, 0 for none.
    """
    box = Delivery(folder)
    box.committed(1)
    current = box.committed(2)
    counts: dict[str, Counter[str]] = {}
    for n, case in enumerate(cases(box, manifest_bits, seed), 1):
        count = counts.setdefault(case[0], Counter(tried=0, accepted=0, believed=0, changed=0))
        message = tried(box, case)
        count["tried"] += 1
        count["accepted"] += not message
        count["believed"] += (
            case[0] == FLIPPED
            and "does not fit the manifest" not in message
            and believed(box, case[2])
        )
        count["changed"] += box.store.current != current
        if every and n % every == 0:
            print(f"{n}: {case[0]}, {case[1]}", flush=True)
    for good in (deliveries.files(3, box.key), another(box.key)):
        # otherwise the campaign would prove nothing
        box.store.install(box.copied(deliveries.enrolled(good, box.enrolment_key)))
        box.store.install(box.copied(good))
    return {kind: dict(count) for kind, count in counts.items()}


def main() -> int:
    """Run the campaign and write its figures; 1 if any alteration was accepted."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.flips",
        description="Counts the altered bundles that a box accepts.",
    )
    parser.add_argument("--out", type=Path, default=Path("build/flips.json"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--bits", type=int, help="flip this many random bits of the manifest (all of them)"
    )
    args = parser.parse_args()
    with stage() as folder:
        found = campaign(Path(folder), args.bits, args.seed, every=1000)
    total = {
        name: sum(count[name] for count in found.values())
        for name in ("tried", "accepted", "believed", "changed")
    }
    result = {"total": total, "kinds": found, "seed": args.seed, "commit": commit()}
    result["machine"] = platform.machine()
    put(args.out, (json.dumps(result, indent=1) + "\n").encode(), parents=True)
    print("\n".join(f"{kind}: {count}" for kind, count in [*found.items(), ("total", total)]))
    return int(total["accepted"] + total["believed"] + total["changed"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())

"""The list of all that the box adds to Debian, with licences: a software bill of materials.

`python systemd/sbom.py OUT.json` writes CycloneDX 1.5 (ECMA-424). Versions and hashes come from
appliance/teach.lock, which has all of the box, licences from the installed packages.
"""

from __future__ import annotations

import json
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "appliance" / "teach.lock"
ENTRY = re.compile(
    r"(?m)^([a-z0-9-]+)==(\S+?)(?: ;[^\\\n]*)? \\\n((?:    --hash=sha256:\w+(?: \\)?\n)+)"
)
OF_DEBIAN = ("python3", "libusb-1.0-0", "openssh-client")
"""Packages of Debian that the box needs; their licences are in /usr/share/doc."""
KNOWN = {"wait-for2": "Apache-2.0"}
"""Licences of packages that are not installed for every version of Python."""


def components(lock: str) -> list[dict[str, Any]]:
    """A component for each entry of a lock."""
    found = []
    for name, version, hashes in ENTRY.findall(lock):
        digests = re.findall(r"sha256:(\w+)", hashes)
        found.append(
            {
                "type": "library",
                "name": name,
                "version": version,
                "purl": f"pkg:pypi/{name}@{version}",
                "licenses": [{"license": {"name": licence(name)}}],
                "properties": [{"name": "sha256 of a wheel", "value": d} for d in digests],
            }
        )
    return found


def licence(name: str) -> str:
    """The licence that an installed package states. Raises SystemExit if it is not installed, or
    states none."""
    if name in KNOWN:
        return KNOWN[name]
    try:
        about = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        sys.exit(f"palpate: {name} is not installed here; run make desktop")
    classified = [c for c in about.get_all("Classifier") or [] if c.startswith("License ::")]
    expression, text = (
        "".join(about.get_all(key) or []).strip() for key in ("License-Expression", "License")
    )
    named = text if "\n" not in text else ""  # a name, or the whole text
    stated = expression or named or "".join(classified[:1])
    if not stated:
        sys.exit(f"palpate: {name} states no licence; look it up and add it here")
    return stated.rpartition(":: ")[2]


def document(lock: str) -> dict[str, Any]:
    """The whole document."""
    from palpate import __version__

    own = {"type": "application", "name": "palpate", "version": __version__}
    debian = [{"type": "library", "name": n, "group": "debian"} for n in OF_DEBIAN]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own | {"licenses": [{"license": {"id": "MIT"}}]}},
        "components": components(lock) + debian,
    }


def main() -> None:
    """Write the document to the file that is named."""
    target = Path(sys.argv[1])
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps(document(LOCK.read_text("utf-8")), indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()

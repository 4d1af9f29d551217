"""Draws the pictures of README: the page of a box at work, and the demo in a terminal.

`python -m tests.campaigns pictures`. The page shows an invented shift on a simulated skin. Each
picture names the bundle that it was taken with.
"""

import re
import struct
import subprocess
import sys
from io import StringIO
from pathlib import Path
from zlib import crc32

from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text

from palpate.bundle import bundle
from palpate.web.access import Access
from tests.factories import feed_lines
from tests.factories.browser import launched, until
from tests.factories.paths import ROOT
from tests.factories.shown_page import Shown, opened

PAGE, DEMO = ROOT / "docs" / "watch" / "page.png", ROOT / "docs" / "demo.svg"
SIZE = 1280, 900
COLUMNS = 98
INVENTED = str(feed_lines.hello()["bundle"])
"""The bundle of the invented shift, also of examples in the documents."""
KEY = b"Bundle\0"
COLOURS = {
    r"✓|(?<=-> )(wood|plastic rough|foam|metal|paper)\b": "green",
    r"unknown|unsure": "yellow",
}
COLOURS |= {r"sensor-lost|✗": "red"}
"""Colours of the demo, as on a terminal."""


def page(path: Path) -> None:
    """Write the page at work as PNG."""
    shown = Shown(Access(0))
    with launched() as browser, shown:
        shown.shift()
        shown.board.take(feed_lines.hello(source="sim"))
        seen = opened(browser, shown, *SIZE)
        until(lambda: "16 taxels" in str(seen.page.get_attribute("#signal", "aria-label")))
        seen.page.evaluate("Promise.all(document.getAnimations().map((one) => one.finished))")
        seen.page.screenshot(path=path)
    path.write_bytes(stamped(path.read_bytes(), INVENTED))


def demo(path: Path) -> None:
    """Write the output of `palpate demo --virtual` as SVG, which asks for nothing outside of it."""
    command = [sys.executable, "-m", "palpate", "demo", "--virtual"]
    run = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    console = Console(record=True, width=COLUMNS, file=StringIO())
    for line in ["$ make demo", *run.stdout.splitlines()]:
        text = Text(line)
        for pattern, colour in COLOURS.items():
            text.highlight_regex(pattern, colour)
        console.print(text, soft_wrap=True)
    svg = console.export_svg(title="make demo", theme=MONOKAI, unique_id="demo")
    svg = re.sub(r"(?s)@font-face \{.*?\}\s*", "", svg).replace("Fira Code", "DejaVu Sans Mono")
    path.write_text(svg.replace("</svg>", f"<!-- bundle {loaded()} --></svg>"), "utf-8")


def loaded() -> str:
    """The id of the packaged bundle, which the demo runs."""
    return bundle.load(bundle.DEFAULT).id


def stamped(png: bytes, of: str) -> bytes:
    """A PNG with the id of a bundle in a text chunk, before its last chunk, IEND."""
    content = b"tEXt" + KEY + of.encode("ascii")
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", crc32(content))
    return png[:-12] + chunk + png[-12:]


def bundle_of(path: Path) -> str:
    """The id of the bundle that a picture names, "" if it names none."""
    found = re.search(rb"(?:bundle |Bundle\0)([0-9a-f]{8})", path.read_bytes())
    return found[1].decode("ascii") if found else ""


def main() -> int:
    """Draw both; the exit code."""
    demo(DEMO)
    page(PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The folder of a running box, and the names in it, for the box and for programs next to it.
`palpate status` finds its file by this module alone: scripts call it often."""

import os

RUNTIME = "/run/palpate"
"""Default of store.runtime."""
STATUS, FEED, LAST_FAILURE = "status.json", "feed.sock", "last-failure.json"
"""The file of `palpate status`, the socket of the feed, and the reason of the last end."""
FEED_SCHEMA = 1
"""Version of the feed's lines (PROTOCOL.md, part 4), for writer and readers."""
SITE = "/etc/palpate/palpate.toml"
"""The settings of this robot's installation; the file may be missing."""
_HERE = os.path.realpath(__file__)
CHECKOUT = os.path.normpath(f"{_HERE}/../../../../firmware_config")


def settings_folder() -> str:
    """firmware_config/ of this checkout; in an installation the folder of SITE."""
    return CHECKOUT if os.path.isdir(CHECKOUT) else os.path.dirname(SITE)


def is_default() -> bool:
    """Whether no settings file speaks of store.runtime. They are not parsed, which would take more
    time than all the rest of `palpate status`."""
    folder = settings_folder()
    try:
        names = [name for name in os.listdir(folder) if name.endswith(".toml")]
    except FileNotFoundError:
        names = []
    except OSError:
        return False  # who reads the settings says why
    return not any(map(_speaks_of_it, [*(os.path.join(folder, name) for name in names), SITE]))


def _speaks_of_it(path: str) -> bool:
    """Whether a settings file may set store.runtime; an unreadable file may."""
    try:
        with open(path, "rb") as f:
            return b"runtime" in f.read()
    except FileNotFoundError:
        return False
    except OSError:
        return True

"""Reads frames from the bytes of skins that do not speak PROTOCOL.md, in pure functions, and counts
the bytes outside of frames.

A codec accepts any bytes without raising, and invents no frame: bytes that are not enclosed as the
profile describes are garbage.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module

from palpate.io.skin_codecs.frames import Decoded, Rest, arranged
from palpate.io.skin_profile import SkinProfile

__all__ = ["Codec", "Decoded", "Rest", "arranged", "codec"]

Codec = Callable[[Rest, bytes], Decoded]
"""Converts the rest of earlier bytes and new bytes to their content."""
_MODULES = {"xela-can": "xela", "robotiq-tsf": "robotiq"}
"""Of the codecs that have another name than their module."""


def codec(profile: SkinProfile) -> Codec:
    """The codec of a profile that does not speak PROTOCOL.md."""
    # a box has one skin, so it needs one of these modules
    name = _MODULES.get(profile.codec, profile.codec)
    return partial(import_module(f"{__name__}.{name}").decode, profile)

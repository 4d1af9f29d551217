"""The bytes of skins that do not speak PROTOCOL.md, in pure functions. In: bytes, with what earlier
ones left over. Out: frames, and how many bytes belonged to none.

No received bytes make a codec raise, and none invents a frame: what is not enclosed by what its
profile says is garbage.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module

from appliance.io.skin_codecs.frames import Decoded, Rest, arranged
from appliance.io.skin_profile import SkinProfile

__all__ = ["Codec", "Decoded", "Rest", "arranged", "codec"]

Codec = Callable[[Rest, bytes], Decoded]
"""What was left over and new bytes -> what they contained."""
_MODULES = {
    "fixed": "fixed",
    "text": "text",
    "papillarray": "papillarray",
    "xela-can": "xela",
    "robotiq-tsf": "robotiq",
}


def codec(profile: SkinProfile) -> Codec:
    """The codec of a profile that does not speak PROTOCOL.md."""
    # a box has one skin, so it reads one of these modules
    return partial(import_module(f"{__name__}.{_MODULES[profile.codec]}").decode, profile)

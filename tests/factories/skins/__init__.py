"""Emulated skins that exist: the bytes that each sends over its serial line (`wires`), and a
terminal on which it is plugged in (`player`). They were written from published layouts, not from
the decoders of `palpate.io`, which read them."""

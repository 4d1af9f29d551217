"""Emulated skins that people own: what each of them sends over its serial line (`wires`), and a
terminal on which it is plugged in (`player`). Written from published layouts, not from the decoders
of `appliance.io`, which read it.
"""

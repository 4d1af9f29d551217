"""The numbers on which several fits agree, each once: what a step may cost, how much of training a
limit keeps, and how far beyond it a limit lies. They have no unit unless their text gives one."""

LOST = 0.005
"""Half a point: the largest share of right answers that quantization, fewer filters or an early
answer may cost, and the least that a rule has to save (docs/decisions/0005)."""
KEPT = 1 - LOST
"""Share of known sweeps within a limit. The robot gets no answer to the others, whatever the
network computes (docs/decisions/0005)."""
KEPT_COPIES = 0.99
"""The same for altered copies, of which a few lie further, because gains differ."""
OUTER = 0.02
"""Share of the training sweeps that a range leaves out at each end, since a few measures are
wrong."""
MARGIN = 0.05
"""A limit lies this share of a value beyond the outermost that training has."""
CLEAR = 1.25
"""What a box repairs, noise of a taxel or hum, stands out this many times as much as anything in
training."""
COPIES = 360
"""Largest number of sweeps that are altered or displaced, of each kind."""
LEFT_OUT = 12
"""Largest number of materials that are left out in turn."""

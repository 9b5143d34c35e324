"""The paper's figures of a compensated stroke: encoder 0.1 µm, 12-bit D/A, 2 kHz."""

PEAK_TO_PEAK_UM = {"linear": 1.77, "smc": 0.40}
"""Peak-to-peak error in µm by law."""
TOLERANCE = 0.15
"""Part of a figure within which another plant's agrees with it: friction, delay and amplifier are not printed."""

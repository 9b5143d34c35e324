"""Encoder and D/A converter: what the digital controller sees, and what it can say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from straightcomp_ros.parameters import parameter


@dataclass(frozen=True)
class EncoderParameters:
    """Incremental linear encoder."""

    resolution: float = parameter(1e-7, "One count of the encoder", unit="m", above=0.0, maximum=1e-3)

    def reading(self, position: float) -> float:
        """Position in m as the encoder reports it: the nearest count (ties upward)."""
        return math.floor(position / self.resolution + 0.5) * self.resolution


@dataclass(frozen=True)
class DriveParameters:
    """D/A converter and current amplifier: i_c = K_a u."""

    dac_bits: int = parameter(12, "Resolution of the D/A converter", unit="bit", minimum=4, maximum=24)
    dac_range: float = parameter(10.0, "Output range ± of the D/A converter", unit="V", above=0.0, maximum=1e3)
    gain: float = parameter(0.1, "Amplifier gain K_a", unit="A/V", above=0.0, maximum=1e3)
    bandwidth: float = parameter(500.0, "Bandwidth of the amplifier (first order)", unit="Hz", above=0.0, maximum=1e6)

    @cached_property
    def current_step(self) -> float:
        """Control current of one D/A step in A."""
        return 2.0 * self.dac_range * self.gain / (1 << self.dac_bits)

    @property
    def current_range(self) -> float:
        """Largest control current in A that the D/A converter can ask for."""
        return self.dac_range * self.gain

    def converted(self, current: float) -> float:
        """Control current in A after the D/A converter: nearest step, limited to its range."""
        step = self.current_step
        code = math.floor(current / step + 0.5)
        half = 1 << (self.dac_bits - 1)
        if code >= half:
            code = half - 1
        elif code < -half:
            code = -half
        return code * step

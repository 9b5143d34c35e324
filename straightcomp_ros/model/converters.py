"""Encoder and D/A converter: how the digital controller's input and output are rounded."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import parameter


@compilable
def nearest_count(resolution: float, position: float) -> float:
    """``position`` in m rounded to the nearest count of ``resolution`` in m; ties go upward."""
    return math.floor(position / resolution + 0.5) * resolution


@compilable
def nearest_step(step: float, half_codes: int, current: float) -> float:
    """``current`` in A rounded to the nearest code from −half_codes to half_codes − 1, of ``step`` in A each.

    A tie goes to the even code: boards round currents and values of frames by the same rule.
    """
    return max(-half_codes, min(half_codes - 1, round(current / step))) * step


@dataclass(frozen=True)
class EncoderParameters:
    """Incremental linear encoders of stage and platform."""

    x_resolution: float = parameter(1e-7, "One count of the encoder of x", "(0, 0.001] m")
    y_resolution: float = parameter(1e-7, "One count of the encoder of y", "(0, 0.001] m")

    @cached_property  # a partial: no second Python call at each sample
    def x_reading(self) -> Callable[[float], float]:
        """``x_reading(position)``: x in m as its encoder reports it, see :func:`nearest_count`."""
        return partial(nearest_count, self.x_resolution)

    @cached_property
    def y_reading(self) -> Callable[[float], float]:
        """``y_reading(position)``: the same for y."""
        return partial(nearest_count, self.y_resolution)

    @property
    def x_noise(self) -> float:
        """Difference in m that two readings of x may have at rest: each half a count off by rounding, and half a one by
        noise."""
        return 2.0 * self.x_resolution

    @property
    def y_rounding(self) -> float:
        """RMS error of y in m by rounding to counts."""
        return self.y_resolution / math.sqrt(12.0)


@dataclass(frozen=True)
class DriveParameters:
    """D/A converter and current amplifier: i_c = K_a u."""

    dac_bits: int = parameter(12, "Resolution of the D/A converter", "[4, 24] bit")
    dac_range: float = parameter(10.0, "Output range ± of the D/A converter", "(0, 1000] V")
    gain: float = parameter(0.1, "Gain K_a of the amplifier", "(0, 1000] A/V")
    bandwidth: float = parameter(500.0, "Bandwidth of the amplifier (first order)", "(0, 1e6] Hz")
    delay: float = parameter(1.0, "Time from a sample until its command takes effect", "[0, 10] samples")

    @cached_property
    def current_step(self) -> float:
        """Control current of one D/A step in A."""
        return 2.0 * self.dac_range * self.gain / (1 << self.dac_bits)

    @property
    def current_range(self) -> float:
        """Largest control current in A that the D/A converter can command."""
        return self.dac_range * self.gain

    @property
    def largest_current(self) -> float:
        """Control current in A of the highest code, one step below :attr:`current_range`."""
        return (self.half_codes - 1) * self.current_step

    @property
    def half_codes(self) -> int:
        """Codes of the D/A converter below zero."""
        return 1 << (self.dac_bits - 1)

    @cached_property
    def converted(self) -> Callable[[float], float]:
        """``converted(current)``: control current in A after the D/A converter, see :func:`nearest_step`."""
        return partial(nearest_step, self.current_step, self.half_codes)

"""What commissioning asks of a machine. The simulated one answers at once; a running graph can be another.

Each call leaves the amplifier off, whatever happens in it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.configuration.node_parameters import Values
from straightcomp_ros.frequency_response.multisine import MultisineParameters
from straightcomp_ros.frequency_response.simulated_measurement import ComparedResponse
from straightcomp_ros.straightness.guide_map import StraightnessMap

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Series:
    """Samples in the order of their stamps; all arrays (n,).

    Attributes:
        stamps: ns.
        x, y: readings, m.
        current: measured control current of the coils, A; NaN while the amplifier is off.
        command: commanded in answer to each sample, A.
        left_at: the sample at which the platform was beyond the travel that was allowed, and the amplifier went off;
            those after it tell how far it coasts. None if it stayed within.
    """

    stamps: NDArray[np.int64]
    x: Array
    y: Array
    current: Array
    command: Array
    left_at: int | None = None


class Machine(Protocol):
    """A machine under commissioning."""

    def listen(self, seconds: float) -> Series:
        """Samples with the amplifier off."""

    def play(self, currents: Array, travel: float) -> Series:
        """Samples with the amplifier on and these commands, A; off as soon as y is ``travel`` (m) from its start.

        The series then goes on for some samples, in which the platform comes to rest.
        """

    def stroke(self, values: Values, bag: Path, travel: float) -> tuple[StrokeRecord, StraightnessMap]:
        """One cycle of the stage under the controller of ``values``, recorded as ``bag``; also the controller's map.

        Raises:
            LeftTravel: y was farther than ``travel`` (m) from its reference; the amplifier went off at once.
        """

    def response(self, values: Values, excitation: MultisineParameters) -> ComparedResponse:
        """The frequency response under the controller of ``values``."""

"""What commissioning asks of a machine: the simulated one, which answers at once, or a running graph.

Each call leaves the amplifier off, whatever happens in it, and raises `CommissioningError` if the machine fails.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.excitation import ExcitationParameters, MultisineParameters
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.tuning.frequency_response.simulated_measurement import ComparedResponse

Array = NDArray[np.float64]

COASTING = 0.1
"""s that a series goes on for when the amplifier has been switched off."""


@dataclass(frozen=True, eq=False)
class Series:
    """Samples in the order of their stamps; all arrays (n,).

    Attributes:
        stamps: ns.
        x, y: readings, m.
        current: measured control current of the coils, A; NaN while the amplifier is off.
        command: commanded in answer to each sample, A.
        latency: from each sample until its command arrived at the machine's driver, s; NaN where none arrived.
        left_at: the sample at which the platform was beyond the travel that was allowed, and the amplifier went off;
            those after it tell how far it coasts. None if it stayed within.
    """

    stamps: NDArray[np.int64]
    x: Array
    y: Array
    current: Array
    command: Array
    latency: Array
    left_at: int | None = None


class Machine(Protocol):
    """A machine under commissioning."""

    def listen(self, seconds: float) -> Series:
        """Samples with the amplifier off."""

    def play(self, excitation: ExcitationParameters) -> Series:
        """Samples in open loop, from the first current of a shake or a ramp on; the amplifier goes off as soon as y has
        moved by the excitation's ``travel``.

        The series then goes on for some samples, in which the platform comes to rest.
        """

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        """Some cycles of the stage, one after the other, under the controller of ``values``, recorded as ``bag``.

        Raises:
            LeftTravel: y was farther than ``travel`` (m) from its reference; the amplifier went off at once.
        """

    def response(self, values: Values, excitation: MultisineParameters) -> ComparedResponse:
        """The frequency response under the controller of ``values``."""

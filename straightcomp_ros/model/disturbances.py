"""What pushes a simulated platform, and what its encoder adds, besides the servo and friction.

    F(t) = Σ_n A_n sin(2π n f t)                              mains, n = 1, 2, 3
         + A sin(2π x/p) + table(x)                           locked to the stage's position
         + c x + d tanh(ẋ/v)                                  cable: its slope, and its drag against the travel
         + M g sin(tilt) + M a(t)                             gravity, vibration of the guide

The amplifier adds an offset o(t) to the current that its measurement does not show, since it is the offset of that
measurement: an Ornstein-Uhlenbeck process of RMS o and time constant τ. The vibration a(t) is white noise behind a
resonance, of RMS a. The encoder adds e sin(2π y/q) before it rounds: the interpolation error of signals of period q.

Mains are exact in each substep; everything else is drawn at the samples, with linear forces in between. The random
numbers are integer hashes of seed and sample: the same on every machine, live and offline.
"""

import math
from dataclasses import astuple, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.friction import band_value
from straightcomp_ros.parameters.declaration import ParameterError, group, parameter
from straightcomp_ros.parameters.share import named_file
from straightcomp_ros.parameters.yaml_text import bounded_lines, number_rows

Array = NDArray[np.float64]

GRAVITY = 9.80665
"""m/s²."""
_TURNING = 1e-3
"""m/s, over which the cable's drag turns round with the travel."""
_COLUMNS = {"x_m": 1000.0, "force_n": 1000.0}
"""Of a table of force, and the largest magnitude of each."""


@dataclass(frozen=True)
class MainsParameters:
    """Force at the frequency of the mains and its multiples."""

    frequency: float = parameter(50.0, "Frequency f of the mains", "(0, 1000] Hz")
    force: float = parameter(0.0, "Amplitude of the force at the mains' frequency", "[0, 1000] N")
    second: float = parameter(0.0, "Amplitude of the force at twice the mains' frequency", "[0, 1000] N")
    third: float = parameter(0.0, "Amplitude of the force at three times the mains' frequency", "[0, 1000] N")


@dataclass(frozen=True)
class CoggingParameters:
    """Force that is locked to the stage's position x."""

    force: float = parameter(0.0, "Amplitude of the force", "[0, 1000] N")
    pitch: float = parameter(0.03, "Distance along x after which the force repeats", "(0, 10] m")


@dataclass(frozen=True)
class CableParameters:
    """Force of cables and hoses."""

    slope: float = parameter(0.0, "Force per position x of the stage", "[-1e4, 1e4] N/m")
    drag: float = parameter(
        0.0, "Force while the stage moves forward; its opposite while it moves back", "[-1e3, 1e3] N"
    )


@dataclass(frozen=True)
class DriftParameters:
    """Offset of the amplifier that drifts."""

    current: float = parameter(0.0, "RMS of the amplifier's offset, which no measurement shows", "[0, 10] A")
    time: float = parameter(1.0, "Time constant with which the offset wanders", "[0.001, 1e6] s")


@dataclass(frozen=True)
class VibrationParameters:
    """Vibration of the guide."""

    acceleration: float = parameter(0.0, "RMS acceleration of the guide in y", "[0, 1000] m/s²")
    frequency: float = parameter(30.0, "Frequency of the guide's resonance", "(0, 1000] Hz")
    damping: float = parameter(0.05, "Damping ratio of the guide's resonance", "[0.001, 0.99]")


@dataclass(frozen=True)
class InterpolationParameters:
    """Interpolation error of the encoder of y."""

    amplitude: float = parameter(0.0, "Amplitude of the error that repeats over a signal period", "[0, 1e-4] m")
    period: float = parameter(20e-6, "Signal period of the encoder", "(0, 0.01] m")


@dataclass(frozen=True)
class DisturbanceParameters:
    """What disturbs a simulated machine; nothing by default."""

    seed: int = parameter(0, "Seed of what is random", "[0, 1000000]")
    mains: MainsParameters = group(MainsParameters, "Simulated mains hum")
    cogging: CoggingParameters = group(CoggingParameters, "Simulated cogging")
    force_file: str = parameter("", f"CSV file of a force over x, with the columns {','.join(_COLUMNS)}; empty: none")
    cable: CableParameters = group(CableParameters, "Simulated cables")
    tilt: float = parameter(0.0, "Angle by which y is tilted against the horizontal: gravity pulls", "[-1.6, 1.6] rad")
    drift: DriftParameters = group(DriftParameters, "Simulated offset of the amplifier")
    vibration: VibrationParameters = group(VibrationParameters, "Simulated vibration of the guide")
    interpolation: InterpolationParameters = group(InterpolationParameters, "Simulated interpolation error of y")

    def machine(self) -> "Disturbances":
        """The same with its table read; ParameterError if the file is refused."""
        return Disturbances(self, read_force_table(named_file(self.force_file)) if self.force_file else ((), ()))


Table = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class Disturbances:
    """Parameters, and the table of force (N) over rising x (m)."""

    parameters: DisturbanceParameters = field(default_factory=DisturbanceParameters)
    table: Table = ((), ())

    @property
    def any(self) -> bool:
        """Whether anything disturbs."""
        d = self.parameters
        forces = (d.mains.force, d.mains.second, d.mains.third, d.cogging.force, d.cable.slope, d.cable.drag, d.tilt)
        others = (d.drift.current, d.vibration.acceleration, d.interpolation.amplitude)
        return any((*forces, *others, self.table[0]))

    def constants(self) -> tuple[float, ...]:
        """What the plant's constants have from :data:`DISTURBANCES` on: the table stands last."""
        d = self.parameters
        plain = (d.seed, *astuple(d.mains), *astuple(d.cogging), *astuple(d.cable), GRAVITY * math.sin(d.tilt))
        random = (*astuple(d.drift), *astuple(d.vibration), *astuple(d.interpolation))
        return (*plain, *random, len(self.table[0]), *self.table[0], *self.table[1])


def read_force_table(path: Path) -> Table:
    """Rising x in m and the force in N of a CSV file; ParameterError, which names file and row, if it is refused."""
    where = f"parameter 'force_file': {path}"
    x, force = number_rows(bounded_lines(path, where), where, _COLUMNS).T
    if x.size < 2:
        raise ParameterError(f"{where}: {x.size} rows; allowed: at least two")
    if (falls := np.diff(x) <= 0.0).any():
        raise ParameterError(f"{where}: x_m {x[1:][falls][0]:.9g} in row {falls.argmax() + 2}; allowed: x_m that rises")
    return tuple(x.tolist()), tuple(force.tolist())


DISTURBANCES = 57
"""Index of these constants in the plant's, after friction and modes."""
_SEED, _FREQUENCY, _FIRST, _SECOND, _THIRD, _COGGING, _PITCH, _SLOPE, _DRAG, _GRAVITY = range(DISTURBANCES, 67)
_OFFSET, _WANDER, _VIBRATION, _GUIDE, _GUIDE_DAMPING, _ERROR, _SIGNAL, _NODES, _TABLE = range(67, 76)
TIME = 7
X, FORCE, FORCE_RATE, OFFSET, _SWING, _QUADRATURE, _DRAWN = range(22, 29)
"""Indices in the plant's state: x m, force N and its rate N/s, offset of the amplifier A, vibration of the guide m/s²
and its quadrature, samples drawn."""


@compilable
def _normal(seed: int, number: int, stream: int) -> float:
    """A random number of mean 0 and variance 1: the sum of three uniform ones, normal within three deviations."""
    place = 12 * number + 3 * stream
    return band_value(seed, place) + band_value(seed, place + 1) + band_value(seed, place + 2)


@compilable
def locked_force(k: Array, x: float, speed: float) -> float:
    """Force in N that depends on the stage's position in m and its speed in m/s alone; ``k`` are the plant's."""
    force = float(k[_COGGING] * math.sin(2.0 * math.pi * x / k[_PITCH]))
    force += float(k[_SLOPE] * x + k[_DRAG] * math.tanh(speed / _TURNING))
    count = int(k[_NODES])
    if count > 0:
        place, push = k[_TABLE : _TABLE + count], k[_TABLE + count : _TABLE + 2 * count]
        after = max(1, min(count - 1, int(np.searchsorted(place, x))))
        share = max(0.0, min(1.0, (x - place[after - 1]) / (place[after] - place[after - 1])))
        force += float(push[after - 1] + share * (push[after] - push[after - 1]))
    return force


@compilable
def aim(k: Array, state: Array, mass: float, x: float, duration: float) -> None:
    """Draw what disturbs at the end of the next ``duration`` in s, with the stage at ``x`` then, and let the force go
    there; ``k`` and ``state`` are the plant's, ``mass`` in kg."""
    speed = (x - state[X]) / duration if duration > 0.0 else 0.0
    state[X] = x
    seed, number = int(k[_SEED]), int(state[_DRAWN])
    rate = 2.0 * math.pi * k[_GUIDE]
    if duration > 0.0:
        number += 1
        state[_DRAWN] = number
        kept = math.exp(-duration / k[_WANDER])
        state[OFFSET] *= kept
        decay = math.exp(-k[_GUIDE_DAMPING] * rate * duration)
    else:
        # The machine has run before: it starts anywhere.
        kept = decay = 0.0
        state[OFFSET] = 0.0
    state[OFFSET] += k[_OFFSET] * math.sqrt(1.0 - kept * kept) * _normal(seed, number, 0)
    turn = rate * math.sqrt(1.0 - k[_GUIDE_DAMPING] ** 2) * duration
    swing, quadrature, drawn = state[_SWING], state[_QUADRATURE], k[_VIBRATION] * math.sqrt(1.0 - decay * decay)
    state[_SWING] = decay * (math.cos(turn) * swing - math.sin(turn) * quadrature) + drawn * _normal(seed, number, 1)
    state[_QUADRATURE] = decay * (math.sin(turn) * swing + math.cos(turn) * quadrature) + drawn * _normal(
        seed, number, 2
    )
    force = locked_force(k, x, speed) + mass * (k[_GRAVITY] + state[_SWING])
    if duration > 0.0:
        state[FORCE_RATE] = (force - state[FORCE]) / duration
    else:
        state[FORCE], state[FORCE_RATE] = force, 0.0


@compilable
def disturbing_force(k: Array, state: Array) -> float:
    """The force in N at the state's own time."""
    if k[_FIRST] == k[_SECOND] == k[_THIRD] == 0.0:
        return float(state[FORCE])
    angle = 2.0 * math.pi * k[_FREQUENCY] * state[TIME]
    mains = k[_FIRST] * math.sin(angle) + k[_SECOND] * math.sin(2.0 * angle) + k[_THIRD] * math.sin(3.0 * angle)
    return float(state[FORCE] + mains)


@compilable
def interpolated(k: Array, y: float) -> float:
    """Position in m that the encoder interpolates for ``y`` in m, before it rounds."""
    return float(y + k[_ERROR] * math.sin(2.0 * math.pi * y / k[_SIGNAL]))

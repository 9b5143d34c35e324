"""The plant between two samples of its board: commands take effect at their times, and a late one is bridged.

When the next command is late, the board holds the platform until it comes. It applies the mean of the commands before,
which balances the magnets' pull at that place. It takes back the impulse that the last commands gave beyond that mean:
each answers an error of its own moment, and the commands after it would have undone it. It adds a stiffness about the
last reading, since the magnets' own is negative.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable, compiled
from straightcomp_ros.model.converters import nearest_count, nearest_step
from straightcomp_ros.model.plant import PlantParameters, PlantState, advance, as_array

_NEVER = 2**62
"""Later than any time in ns, and small enough for compiled code."""
_FIELDS = len(PlantState._fields)
BIAS, COMMAND, _MEAN, _IMPULSE, _ANCHOR, READING = range(_FIELDS, _FIELDS + 6)
"""Places in :attr:`CommandedPlant.state`, after the plant's own."""
_NOW, _HOLD_AT, _HOLDING = range(3)
_AFTER_NS, _WEIGHT, _KEPT, _BRAKING, _STIFFNESS, _STEP, _HALF_CODES, _RESOLUTION = range(40, 48)
"""Places in :attr:`CommandedPlant.constants`, after the plant's own."""


class Hold(NamedTuple):
    """How the board holds the platform when commands are late.

    Attributes:
        after_ns: time since a command took effect from which it does.
        weight: share of each command in the mean.
        kept: share of an impulse that friction leaves after a sample.
        braking: share of what is left that the board takes back in a sample.
        stiffness: control current per displacement, A/m.
    """

    after_ns: int
    weight: float
    kept: float
    braking: float
    stiffness: float


class CommandedPlant(NamedTuple):
    """Constants and state as :func:`advance_to_sample` takes them.

    Attributes:
        constants: (48,) those of the plant, see :func:`~straightcomp_ros.model.plant.as_array`; the fields of
            :class:`Hold`; step of the D/A converter in A, its codes below zero, resolution of the encoder in m.
        state: (24,) that of the plant, see :class:`~straightcomp_ros.model.plant.PlantState`; bias current and control
            current asked of the amplifier, mean control current, all in A; impulse beyond that mean in A · samples;
            position that is held and newest reading of y, in m. While the bias current asked for is zero, the amplifier
            is off and commands have no effect.
        times: (3,) int64: the present and the time at which the board begins to hold in ns, and whether it holds.
    """

    constants: NDArray[np.float64]
    state: NDArray[np.float64]
    times: NDArray[np.int64]

    def currents_off(self) -> None:
        """Ask the amplifier for no current, and forget the commands that took effect."""
        self.state[BIAS : _IMPULSE + 1] = 0.0
        self.times[_HOLD_AT:] = _NEVER, False

    def set_time(self, time_ns: int) -> None:
        """Go on from this time with the same state."""
        self.times[_NOW] = time_ns


def commanded_plant(plant: PlantParameters, hold: Hold, initial: PlantState) -> CommandedPlant:
    """The machine at time 0 with its amplifier off."""
    drive, encoder = plant.drive, plant.encoder
    return CommandedPlant(
        np.array([*as_array(plant.constants()), *hold, drive.current_step, drive.half_codes, encoder.y_resolution]),
        np.array([*initial, 0.0, 0.0, 0.0, 0.0, 0.0, encoder.y_reading(initial.y)]),
        np.array([0, _NEVER, False]),
    )


@compilable
def _count_impulse(constants: NDArray[np.float64], state: NDArray[np.float64]) -> None:
    """The impulse after one more sample with the present current, of which friction leaves a share."""
    state[_IMPULSE] = constants[_KEPT] * (state[_IMPULSE] + (state[COMMAND] - state[_MEAN]))


@compilable
def _converted(constants: NDArray[np.float64], current: float) -> float:
    return nearest_step(constants[_STEP], int(constants[_HALF_CODES]), current)


@compilable
def _holding_current(constants: NDArray[np.float64], state: NDArray[np.float64], displacement: float) -> float:
    """Control current in A while the platform is ``displacement`` (m) away from where it is held."""
    braking = constants[_BRAKING] * state[_IMPULSE]
    return _converted(constants, state[_MEAN] - braking - constants[_STIFFNESS] * displacement)


@compiled
def advance_to_sample(
    constants: NDArray[np.float64],
    state: NDArray[np.float64],
    times: NDArray[np.int64],
    effective: NDArray[np.int64],
    asked: NDArray[np.float64],
    count: int,
    until: int,
    noise: float,
) -> int:
    """Integrate up to ``until`` (ns), which is not in the past, and read the encoder of y there.

    Args:
        constants, state, times: see :class:`CommandedPlant`; the last two are changed in place.
        effective: when each command that waits takes effect, in ns, rising.
        asked: its control current in A, before the D/A converter.
        count: how many of these there are.
        until: time of the sample in ns.
        noise: what the encoder adds to the position before it rounds, m.

    Returns:
        How many of the commands took effect.
    """
    taken = 0
    while True:
        # Each call of advance() spans one command, up to what comes next.
        if taken < count and effective[taken] <= until and effective[taken] <= times[_HOLD_AT]:
            at = effective[taken]
            current = state[COMMAND]
            if state[BIAS] > 0.0:
                current = _converted(constants, asked[taken])
                state[_MEAN] += constants[_WEIGHT] * (current - state[_MEAN])
                times[_HOLD_AT], times[_HOLDING] = at + int(constants[_AFTER_NS]), False
            taken += 1
        elif times[_HOLD_AT] <= until:
            # The last command fought the error of its own moment; held for longer it drives the platform away.
            at = times[_HOLD_AT]
            times[_HOLD_AT], times[_HOLDING], state[_ANCHOR] = _NEVER, True, state[READING]
            _count_impulse(constants, state)
            current = _holding_current(constants, state, 0.0)
        else:
            break
        end = min(until, times[_HOLD_AT])
        if taken < count:
            end = min(end, effective[taken])
        advance(constants, state, state[BIAS], state[COMMAND], at - times[_NOW], current, end - at)
        state[COMMAND], times[_NOW] = current, end
    if times[_NOW] < until:
        advance(constants, state, state[BIAS], state[COMMAND], until - times[_NOW], 0.0, 0)
        times[_NOW] = until
    state[READING] = nearest_count(constants[_RESOLUTION], state[0] + noise)
    _count_impulse(constants, state)
    if times[_HOLDING]:
        state[COMMAND] = _holding_current(constants, state, state[READING] - state[_ANCHOR])
    return taken

"""The estimated parameters: values with 95 % intervals, what the record cannot identify, and a ROS 2 parameter file.

The excitation is a made-up map (a survey file for `stage.guide.file`) whose reference excites what a stroke along the
real guide does not. Long waves reach far to both sides (stiffness) and slide steadily (Coulomb friction), short ones
are quick (mass, viscous friction); every turn of every wave reverses the motion (bristles), and while the stage speeds
up and slows down all of it happens slowly (Stribeck).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from straightcomp_ros.analysis.current_path import LEAST_TRAVEL, CurrentPath, Recording, current_path, read_recording
from straightcomp_ros.model.motion import reach
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.parameter_file import as_yaml
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.tuning.identification.fit import Fit, fit
from straightcomp_ros.tuning.identification.unknowns import (
    BLOCK,
    FORCE_SCALE,
    NAMES,
    RATIO,
    Centre,
    Unknowns,
    centre,
    unknowns,
)

POOR = 1.3
"""Factor from the value to the bounds of its interval, beyond which it counts as poorly determined."""
CORRELATED = 0.95
_CONFIDENCE = 0.95
_LEAST = 0.002
"""Least relative standard deviation: current path and model are not better than that."""
_ROUNDED = 0.75
"""Standard deviation of the forces relative to the mass, per count of the encoder and RMS travel.

The search takes rounding for white noise. It is not, and with a coarse encoder the acceleration is less well known than
the spread of the prediction errors shows. Found on the machines 0 to 11 of docs/evidence/commissioning.md.
"""
_WIDEST = 1e3
_BENDINGS, _COUNTS = 3.0, 20.0
"""Least travel, in the bending of the bristles before the platform slides, and in counts of the encoder."""
DERIVED = {"actuator.current_stiffness": "N/A", "actuator.position_stiffness": "N/m"}
"""K̄_i and K̄_y with their units: shown, but not parameters of their own."""
_POWERS = {
    "friction.static": {"friction.coulomb": 1.0, RATIO: 1.0},
    # (3): K̄_i = μ0 N² A I0 / y0², K̄_y = K̄_i I0 / y0
    "actuator.current_stiffness": {"actuator.turns": 2.0, "actuator.air_gap": -2.0},
    "actuator.position_stiffness": {"actuator.turns": 2.0, "actuator.air_gap": -3.0},
}
"""What is shown and is not among the unknowns, as a product of their powers."""
_DECLARED = {one.name: one.unit for one in declarations(StageParameters)}
_SHOWN = [name.replace(RATIO, "friction.static") for name in NAMES]
UNITS = {**{n: _DECLARED[n] for n in _SHOWN[:3]}, **DERIVED, **{n: _DECLARED[n] for n in _SHOWN[3:]}}
"""Units of the shown parameters, in their order."""

WAVES = ((0.300, 30e-6), (0.060, 15e-6), (0.030, 8e-6), (0.015, 4e-6))
"""Wavelength and amplitude of the excitation in m: at 0.3 m/s 1, 5, 10 and 20 Hz, together up to 57 µm and 1.3 mm/s."""
_SPEED = 0.3
_SPACING, _FEWEST = 1e-3, 50
"""Of the points, in m, at that speed and faster; and the fewest."""
_PHASE = 1.0
_REACH = 0.9
"""Share of the platform's travel that the excitation uses at most: the law that follows it is a safe one, or one for an
unknown machine, and the platform may overshoot its short waves."""
_GUIDE = MapParameters()
_HEAD = """\
# Plant parameters estimated from a bag, for `straightcomp simulate --stage` and for the description of the stage.
# Only the plant is here: all other parameters take the defaults of their declarations.
# Each value with its 95 % interval; SI units. What the bag determines poorly is left out and marked.
"""


@dataclass(frozen=True)
class Estimated:
    """One parameter: SI value with its 95 % interval, of zero width if it was ``known``.

    ``with_others`` names parameters that this record can hardly distinguish from it.
    """

    name: str
    value: float
    low: float
    high: float
    known: bool
    with_others: tuple[str, ...] = ()

    @property
    def poor(self) -> bool:
        """Whether the record determines it poorly."""
        return not self.known and max(self.high / self.value, self.value / self.low) > POOR


@dataclass(frozen=True)
class Estimate:
    """All parameters, in the order of UNITS, and how well the model explains the record."""

    parameters: dict[str, Estimated]  # by dotted name below ``stage.``
    recording: Recording  # the used stretch of the bag; y from the magnets' centre on, if that is certainly not zero
    path: CurrentPath  # the coil current between the samples
    fit: Fit  # figures of the search
    centre: Centre | None = None  # where the magnets balance, in the encoder's y; None where the record has none

    def to_display(self) -> dict[str, Any]:
        """Figures of the current path, the centre, and what the record leaves open, with units in the names."""
        return {
            "amplifier_bandwidth_deviation_Hz": self.path.rate_deviation / (2.0 * math.pi),
            "delay_us": self.path.delay * 1e6,
            "delay_spread_us": [delay * 1e6 for delay in self.path.delay_spread],
            "centre_um": self.centre.to_display() if self.centre else None,
            "not_identifiable": self.not_identifiable,
        }

    @property
    def not_identifiable(self) -> list[str]:
        """Sentences on what the record leaves open; one at least, since no record gives forces a scale of their own."""
        given = [name for name in FORCE_SCALE if self.parameters[name].known]
        sentences = [
            f"Forces have no scale of their own: {' and '.join(given)} was given. If it is wrong, mass, magnetic force "
            "and friction are wrong by one common factor; their ratios, which a law needs, are not."
        ]
        if math.isnan(self.path.delay):
            sentences.append(
                "Command and measured current fit no first-order amplifier, as where many commands come late: this "
                "record identifies no bandwidth and no delay."
            )
        elif not self.path.rate_found:
            sentences.append(
                "The latency jitters too much to identify the amplifier's bandwidth: that of the description holds."
            )
        places = {name: place for place, name in enumerate(self.parameters)}
        for one in self.parameters.values():
            for other in one.with_others:
                if one.name not in self.parameters[other].with_others or places[one.name] < places[other]:
                    words = "can hardly be told apart: each may take what the other lacks"
                    sentences.append(f"{one.name} and {other} {words}.")
            if one.poor:
                unit = f" {UNITS[one.name]}" if UNITS[one.name] else ""
                sentences.append(f"{one.name} is only known to lie between {one.low:.3g} and {one.high:.3g}{unit}.")
        return sentences


def estimate_from_bag(
    bag: Path,
    start: StageParameters,
    known: Sequence[str],
    progress: Callable[[float], None] = lambda fraction: None,
) -> Estimate:
    """Estimate the plant's parameters from encoder and command of a bag: a rosbag2 folder or an MCAP file.

    The search starts at ``start``, whose pole area, bias current and encoder resolution are taken as given; the
    parameters ``known`` are held at its values.

    Raises:
        BagError: the bag cannot be read.
        IdentificationError: the bag is not fit for it, or ``known`` is refused.
    """
    searched = unknowns(start, known)
    recording = read_recording(bag, least_travel(start))
    middle = centre(recording, start.friction.stribeck_velocity)
    if middle is not None and middle.certain:
        # The model has its magnets around zero.
        recording = replace(recording, y=recording.y - middle.value)
    path = current_path(recording, start.drive)
    found = fit(recording, path, searched, start.encoder.y_resolution, progress)
    rounded = _ROUNDED * start.encoder.y_resolution / float(recording.y.std())
    parameters = _parameters(found, searched, rounded, blocks=max(2, int(recording.duration / BLOCK)))
    return Estimate(parameters, recording, path, found, middle)


def least_travel(stage: StageParameters) -> float:
    """Travel in m with which the platform of ``stage`` slides: less than usual where its friction gives way sooner."""
    bending = stage.friction.static / stage.friction.bristle_stiffness
    return min(LEAST_TRAVEL, max(_BENDINGS * bending, _COUNTS * stage.encoder.y_resolution))


def _parameters(found: Fit, searched: Unknowns, rounded: float, blocks: int) -> dict[str, Estimated]:
    free = searched.free
    total = np.zeros((len(NAMES), len(NAMES)))
    # The remaining bias is assumed as large as its last changes, each of which moves all parameters together.
    total[np.ix_(free, free)] = found.covariance + found.pulls.T @ found.pulls
    total[free, free] += _LEAST**2
    scaled = rounded * _scale_of_forces(free)
    total += np.outer(scaled, scaled)
    quantile = float(student.ppf(0.5 + 0.5 * _CONFIDENCE, max(1, blocks - len(free))))
    # (3) at the magnets' constants: μ0 N² A / 4, y0, I0
    coefficient, gap, bias = searched.constants(found.solution.vector, 1.0)[3:6].tolist()
    current_stiffness = 4.0 * coefficient * bias / gap**2
    stiffness = dict(zip(DERIVED, (current_stiffness, current_stiffness * bias / gap), strict=True))
    estimated = {}
    for name in UNITS:
        powers = _POWERS.get(name, {name: 1.0})
        weights = np.array([powers.get(unknown, 0.0) for unknown in NAMES])
        value = stiffness.get(name) or float(np.prod(np.exp(found.solution.vector) ** weights))
        deviation = math.sqrt(max(0.0, float(weights @ total @ weights)))
        factor = math.exp(min(quantile * deviation, math.log(_WIDEST)))
        others = () if name in DERIVED else _alike(name, found.covariance, free)
        estimated[name] = Estimated(name, value, value / factor, value * factor, deviation == 0.0, others)
    static, coulomb = estimated["friction.static"], estimated["friction.coulomb"]
    estimated["friction.static"] = replace(static, low=max(static.low, min(coulomb.low, static.value)))
    return estimated


def _scale_of_forces(free: list[int]) -> NDArray[np.float64]:
    """How the logarithms (9,) of the unknowns change with that of all forces relative to the mass."""
    searched = [NAMES[place] for place in free]
    powers = {"platform.mass": -1.0}
    if "platform.mass" not in searched:
        # (2): the magnets' force goes with the square of the turns.
        powers = {"actuator.turns": 0.5} if "actuator.turns" in searched else {}
        forces = ("coulomb", "bristle_stiffness", "bristle_damping", "viscous") if powers else ()
        powers |= {f"friction.{name}": 1.0 for name in forces}
    return np.array([powers.get(name, 0.0) if name in searched else 0.0 for name in NAMES])


def _alike(name: str, covariance: NDArray[np.float64], free: list[int]) -> tuple[str, ...]:
    """Names of the free parameters that are correlated with ``name`` by more than CORRELATED."""
    shown = [_SHOWN[place] for place in free]
    if name not in shown:
        return ()
    deviations = np.sqrt(np.diag(covariance))
    correlation = covariance[shown.index(name)] / (deviations * deviations[shown.index(name)])
    return tuple(
        other for other, value in zip(shown, correlation, strict=True) if other != name and abs(value) > CORRELATED
    )


def parameter_file(estimate: Estimate) -> str:
    """Text of a stage file with the plant alone."""
    lines = [_HEAD, "/**:\n  ros__parameters:"]
    for name, found in estimate.parameters.items():
        if name in DERIVED:
            continue
        unit = f" {UNITS[name]}" if UNITS[name] else ""
        interval = f"{found.low:.4g} to {found.high:.4g}{unit}" + (", poorly determined" if found.poor else "")
        lines.append(f"    # {'given, not estimated' if found.known else interval}")
        # Even a poor F_S is written with F_C: its default may be below F_C, which would be refused.
        needed = name == "friction.static" and not estimate.parameters["friction.coulomb"].poor
        left_out = "# " if found.poor and not needed else ""
        lines.append(f"    {left_out}stage.{name}: {as_yaml(float(f'{found.value:.6g}'))}")
    return "\n".join(lines) + "\n"


class Excitation(NamedTuple):
    """A map, and the facts of a description, by dotted name, in place of those of the user's guide and motion."""

    survey: Survey
    facts: dict[str, Any]


def excitation(stage: StageParameters, longest: float = math.inf) -> Excitation:
    """What excites all parameters of ``stage`` in one stroke without stops over its reach, or ``longest`` in m of that,
    within the platform's travel. What is demanded of the user's survey is not demanded of this one."""
    motion, guide = stage.motion, stage.guide
    first, last = reach(motion)
    length = min(longest, last - first)
    # Of lengths along x, so that the waves have their frequencies; a short stroke may end before its full speed.
    scale = min(motion.speed, math.sqrt(motion.acceleration * length)) / _SPEED
    # The map goes on as the waves end, steeply where they are short.
    runout = min(1.0, scale) * guide.runout
    x = np.linspace(0.0, length, max(_FEWEST, round(length / (min(1.0, scale) * _SPACING))) + 1)
    waves = sum(
        # Of a wave longer than the stroke the platform would reach one side only.
        amplitude * np.sin(2.0 * math.pi * x / min(scale * wavelength, length) + number * _PHASE)
        for number, (wavelength, amplitude) in enumerate(WAVES)
    )
    survey = Survey((Run("1", "forward", first + x, np.asarray(waves)),), "excitation")
    whole = StraightnessMap(survey, MapParameters(travel=math.inf, runout=runout))
    share = min(1.0, _REACH * guide.travel / whole.largest)
    survey = Survey((Run("1", "forward", first + x, share * np.asarray(waves)),), "excitation")
    stroke = {"motion.start": first, "motion.stroke": length, "motion.steps": 1, "motion.file": ""}
    demands = {"guide.min_points": _GUIDE.min_points, "guide.max_gap": _GUIDE.max_gap}
    return Excitation(survey, {"guide.runout": runout, **demands, **stroke})

"""Responses of the excited loop, of the simulated stage in simulated time or from a bag, with coherence and confidence,
their margins, and those of a model.

The signal d is known and periodic, so that the responses from it have no bias by noise in the loop, which those from
command to reading would have:

    P = (Y/D) / (U/D),   S = U/D,   L = 1/S − 1,

each a mean over the draws of phases. How the draws differ shows the noise, and what friction and other nonlinearities
add (R. Pintelon and J. Schoukens, System Identification, 2nd ed., 2012, sections 2.7 and 4.3).
"""

import dataclasses
import functools
import math
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from straightcomp_ros.analysis.figure_words import heading
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams, values_at
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, DRIVER_STATE, ENCODER
from straightcomp_ros.control.excitation import (
    ExcitationEnded,
    FrequencyResponseError,
    Multisine,
    MultisineParameters,
    multisine_injection,
)
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.laws import ControlParameters, described_state, make_law
from straightcomp_ros.control.margins import LoopResponse, friction_damping, loop_response
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.modes import ModeParameters, off
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, cycles
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response.found_modes import Array, Complex, FoundPlant, found_plant

WITHIN_DB, WITHIN_DEG = 1.0, 5.0
"""Deviations up to which a model explains a measurement."""
_FEW_LATE = 0.02
"""Share of late commands that hardly delays a loop: by as much of a sample."""
_CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class MeasuredResponse:
    """Responses at the lines of an excitation; arrays (lines,).

    A radius is that of the circle in the complex plane that holds the true value with a confidence of 95 %, in the
    response's unit.
    """

    frequencies: Array  # Hz
    response: LoopResponse  # plant, open loop and sensitivity
    coherence: Array  # of the plant's response: the lesser one of signal with reading and signal with command
    plant_radius: Array
    open_loop_radius: Array
    sensitivity_radius: Array
    speed: float  # RMS velocity of the platform at the lines, m/s
    draws: int  # of phases, which the circles are from
    swing: float = 0.0  # Hz, not excited, at which the platform moves farther than at any line; 0 if at none

    @property
    def coherent(self) -> NDArray[np.bool_]:
        """(lines,) Where the coherence is above 0.9."""
        return self.coherence > 0.9

    @property
    def jointly(self) -> float:
        """Factor by which the circles must grow so that those of all coherent lines hold at once with 95 %.

        Each line then has the confidence 0.95^(1/n) of Z. Šidák, Journal of the American Statistical Association, 1967.
        Of n lines with 95 % each, one in twenty is outside by chance.
        """
        each = _CONFIDENCE ** (1.0 / max(1, int(self.coherent.sum())))
        return _radius_factor(each, self.draws) / _radius_factor(_CONFIDENCE, self.draws)


def measured_response(excitation: Multisine, signal: Array, command: Array, reading: Array) -> MeasuredResponse:
    """Responses from series (n,) that begin with the excitation.

    Args:
        signal: what the injection truly added to the command, A; differs from the excitation where it was limited.
        command: with it, A.
        reading: y, m.
    """
    spectra = [_spectrum(excitation, series) for series in (signal, command, reading)]
    d, u, y = (one[:, excitation.bins] for one in spectra)
    per_u, per_y = u / d, y / d
    sensitivity, output = per_u.mean(axis=0), per_y.mean(axis=0)
    plant = output / sensitivity
    draws = len(d)
    factor = _radius_factor(_CONFIDENCE, draws)

    def radius(residuals: Complex) -> Array:
        return np.asarray(factor * np.sqrt((np.abs(residuals) ** 2).sum(axis=0)))

    sensitivity_radius = radius(per_u - sensitivity)
    return MeasuredResponse(
        frequencies=excitation.frequencies,
        response=LoopResponse(plant, 1.0 / sensitivity - 1.0, sensitivity),
        coherence=np.minimum(_coherence(d, y), _coherence(d, u)),
        plant_radius=radius(per_y - plant * per_u) / np.abs(sensitivity),
        # L + 1 = 1/S, so dL = −dS/S².
        open_loop_radius=sensitivity_radius / np.abs(sensitivity) ** 2,
        sensitivity_radius=sensitivity_radius,
        speed=float(np.sqrt(0.5 * np.mean(np.sum(np.abs(2.0 * np.pi * excitation.frequencies * y) ** 2, axis=1)))),
        draws=draws,
        swing=_swing(excitation, spectra[2]),
    )


def _swing(excitation: Multisine, spectrum: Complex) -> float:
    squares = np.mean(np.abs(spectrum) ** 2, axis=0)
    own = squares.copy()
    # What is slower than the lines is where the platform stands.
    own[[*range(int(excitation.bins[0])), *excitation.bins]] = 0.0
    strongest = int(own.argmax())
    spacing = float(excitation.frequencies[0] / excitation.bins[0])
    return strongest * spacing if own[strongest] > squares[excitation.bins].max() else 0.0


def _radius_factor(confidence: float, draws: int) -> float:
    """Radius of the circle of a complex mean over few draws, relative to the root of its residuals' sum of squares."""
    return math.sqrt(float(fisher.ppf(confidence, 2, 2 * (draws - 1))) / (draws * (draws - 1)))


def _spectrum(excitation: Multisine, series: Array) -> Complex:
    """Complex amplitudes (draws, bins) of the used periods, at all multiples of the period's inverse."""
    return np.asarray(np.fft.rfft(excitation.used(series), axis=1) / (0.5 * excitation.samples))


def _coherence(one: Complex, other: Complex) -> Array:
    """(lines,) squared coherence over the draws; 0 where either is silent."""
    common = np.abs((other * one.conj()).sum(axis=0)) ** 2
    powers = (np.abs(one) ** 2).sum(axis=0) * (np.abs(other) ** 2).sum(axis=0)
    return np.asarray(np.divide(common, powers, out=np.zeros_like(common), where=powers > 0.0))


class ResponseMargins(NamedTuple):
    """Margins by their names in JSON; None where the response does not reach that far, all without a response."""

    gain_low: float | None = None  # factors of the loop gain between which it stays stable
    gain_high: float | None = None
    phase_deg: float | None = None  # smallest one over the gain crossovers
    crossover_Hz: float | None = None  # the highest gain crossover
    delay_us: float | None = None  # further delay of the commands up to which it stays stable
    sensitivity_peak: float | None = None
    sensitivity_peak_Hz: float | None = None  # where that is


def margin_rows(*margins: Mapping[str, float | None]) -> list[tuple[str, ...]]:
    """Rows of a table: each margin in words, and its value in each of ``margins``, `ResponseMargins` by name."""

    def shown(value: float | None) -> str:
        return "beyond the lines" if value is None else f"{value:.4g}"

    return [(heading(name), *(shown(one.get(name)) for one in margins)) for name in margins[0]]


def response_margins(frequencies: Array, open_loop: Complex) -> ResponseMargins:
    """Margins of a stable loop with ``open_loop`` at ``frequencies`` (lines,) in Hz, rising.

    Between two lines, logarithms of magnitude and phase run straight over the logarithm of the frequency. What lies
    beyond the first and the last line is not known: a margin that would lie there is None. Lines that are not finite
    are left out. Of a measured loop hand over its coherent lines only.
    """
    finite = np.isfinite(open_loop)
    frequencies, open_loop = frequencies[finite], open_loop[finite]
    if not frequencies.size:
        return ResponseMargins()
    log_f, log_gain = np.log(frequencies), np.log(np.abs(open_loop))
    # Phase of −L: zero on the negative real axis, where the critical point is.
    phase = np.unwrap(np.angle(-open_loop))
    turns = 2.0 * np.pi * np.arange(np.floor(phase.min() / (2.0 * np.pi)), np.ceil(phase.max() / (2.0 * np.pi)) + 1.0)
    gains = [-value for turn in turns for value in _at_zeros(phase - turn, log_gain)]
    at_one = _at_zeros(log_gain, phase)
    crossovers = np.exp(_at_zeros(log_gain, log_f)).tolist()
    distances = [float((angle + np.pi) % (2.0 * np.pi) - np.pi) for angle in at_one]
    # A delay turns L clockwise: on to the critical point by the angle ahead of it.
    delays = [(angle % (2.0 * np.pi)) / (2.0 * np.pi * f) for angle, f in zip(at_one, crossovers, strict=True)]
    sensitivity = 1.0 / np.abs(1.0 + open_loop)
    highest = int(sensitivity.argmax())
    return ResponseMargins(
        gain_low=max((float(np.exp(gain)) for gain in gains if gain < 0.0), default=None),
        gain_high=min((float(np.exp(gain)) for gain in gains if gain > 0.0), default=None),
        phase_deg=min((float(np.degrees(abs(distance))) for distance in distances), default=None),
        crossover_Hz=max(crossovers, default=None),
        delay_us=min(delays) * 1e6 if delays else None,
        sensitivity_peak=float(sensitivity[highest]),
        sensitivity_peak_Hz=float(frequencies[highest]),
    )


def _at_zeros(values: Array, others: Array) -> list[float]:
    """``others`` at the zeros of ``values``, both straight between their points."""
    places = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    share = values[places] / (values[places] - values[places + 1])
    return [float(value) for value in others[places] + share * (others[places + 1] - others[places])]


@dataclass(frozen=True, eq=False)
class ComparedResponse:
    """A measured response under ``law``, compared with that of the description."""

    law: str
    measured: MeasuredResponse
    model: LoopResponse
    """Of the description, at the measured lines: its closed form with friction linearised at the measured speed, unless
    something else is put in its place."""
    damping: float  # that friction, N·s/m
    clipped: int  # samples in which the current limit cut the excitation
    duration: float  # of the excitation, s
    mechanics: FoundPlant = FoundPlant()  # gain and resonances of the measured plant
    late_share: float = 0.0  # of the samples whose command came after it was due, or only after the next sample
    open: float | Array = 0.0  # what the modes' uncertainty leaves open of the model's plant at each line, relative

    @property
    def lateness(self) -> str:
        """How the host disturbed the measurement, in a sentence; empty if it did not."""
        return _lateness(self.late_share)

    @property
    def margins(self) -> tuple[ResponseMargins, ResponseMargins]:
        """Margins of the measured loop, and of the model, both at the coherent lines."""
        measured, lines = self.measured, self.measured.coherent
        frequencies = measured.frequencies[lines]
        return (
            response_margins(frequencies, measured.response.open_loop[lines]),
            response_margins(frequencies, self.model.open_loop[lines]),
        )

    @property
    def deviations(self) -> tuple[Array, Array]:
        """(lines,) each: the measured plant relative to the model's, magnitude in dB and phase in degrees."""
        ratio = self.measured.response.plant / self.model.plant
        # A dead line is infinitely far off.
        with np.errstate(divide="ignore"):
            return 20.0 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))

    @property
    def largest_deviations(self) -> tuple[float, float]:
        """The largest of the coherent lines, dB and degrees; 0 without any."""
        gain, phase = (np.abs(values[self.measured.coherent]).max(initial=0.0) for values in self.deviations)
        return float(gain), float(phase)

    @property
    def explained(self) -> bool:
        """Whether there are coherent lines, all are finite, and none contradicts the description.

        A line contradicts it if it is certainly off by more than `WITHIN_DB` or `WITHIN_DEG`: if no value in its circle
        is nearer. The circles are those that hold for all coherent lines at once, larger by what the uncertainty of the
        described modes leaves open.
        """
        measured = self.measured
        size = np.abs(measured.response.plant)
        gain, phase = self.deviations
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = np.minimum(1.0, measured.jointly * measured.plant_radius / size + self.open)
            least, most = gain + 20.0 * np.log10(1.0 - radius), gain + 20.0 * np.log10(1.0 + radius)
        turned = np.abs(phase) - np.degrees(np.arcsin(radius))
        # Written so that NaN is off.
        off = ~((least <= WITHIN_DB) & (most >= -WITHIN_DB) & (turned <= WITHIN_DEG))
        return bool(measured.coherent.any() and not (measured.coherent & off).any())


def compared_response(
    excitation: Multisine,
    asked: Array,
    commands: Array,
    reading: Array,
    control: ControlParameters,
    stage: StageParameters,
    clipped: int,
) -> ComparedResponse:
    """The response from series (n,) that begin with the excitation, compared with that of a description.

    Args:
        asked: the law's current without the excitation, before the limit, A.
        commands: with it, A.
        reading: y, m.
        clipped: samples in which the limit cut the excitation.
    """
    limit = stage.highest_current
    signal = commands - np.clip(asked, -limit, limit)
    measured = measured_response(excitation, signal, commands, reading)
    duration = excitation.currents.size / stage.rate
    # A platform of which no count shows a motion goes less than one in all the time.
    damping = friction_damping(stage.friction, max(measured.speed, stage.encoder.y_resolution / duration))
    law = make_law(described_state(control, stage)[1], stage)
    model = loop_response(law, stage, measured.frequencies, damping)
    lines = measured.coherent & np.isfinite(measured.response.plant)
    rigid = loop_response(law, stage.with_modes(), measured.frequencies[lines], damping).plant
    plant, radius = measured.response.plant[lines], measured.plant_radius[lines]
    mechanics = found_plant(measured.frequencies[lines], plant, radius, rigid, damping, stage)
    left_open = _left_open(law, stage, measured.frequencies, damping, model.plant)
    return ComparedResponse(control.law, measured, model, damping, clipped, duration, mechanics, open=left_open)


def _left_open(law: Law, stage: StageParameters, frequencies: Array, damping: float, described: Complex) -> Array:
    """(lines,) The share of the ``described`` plant by which it may differ within the uncertainty of its modes."""
    present, total = stage.platform.modes.present, np.zeros(frequencies.size)

    def plant(*modes: ModeParameters) -> Complex:
        return loop_response(law, stage.with_modes(*modes), frequencies, damping).plant

    for place, mode in enumerate(present):
        for fact in np.eye(3):  # frequency, damping, participation
            ends = [plant(*present[:place], off(mode, *end), *present[place + 1 :]) for end in (fact, -fact)]
            total += np.max([np.abs(end / described - 1.0) for end in ends], axis=0)
    return total


_SETTLE = 1.0
"""s before the excitation, in which the law settles."""
_SPARE = 0.5
"""s of rest after the excitation."""
_ALIKE = 0.9
"""Least correlation of what was injected with the excitation, of all of it and in the used period of each draw."""
_IN_TIME = 1.02
"""Of the time at which a command is due, that at which it is in time all the same."""


def measure_simulated(
    values: Values,
    parameters: MultisineParameters,
    *,
    moving: bool = False,
    wiring: Callable[[SimulatedHardware], Hardware] | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> ComparedResponse:
    """Measure the loop of the simulated stage under the parameters of the nodes.

    With ``moving`` the stage makes strokes meanwhile; otherwise it stands in the middle of the stroke. ``wiring`` puts
    something between the machine and its driver.

    Raises:
        FrequencyResponseError: the excitation does not fit the rate.
        ExcitationEnded: the platform left the allowed travel.
        ParameterError, SurveyError: the parameters are refused.
        NotLinear: the law has no linearisation at rest.
    """
    nodes = node_set(values)
    stage, control = nodes.controller.stage, nodes.controller.control
    excitation, injection = multisine_injection(parameters, make_law(control, stage), stage)
    duration = excitation.currents.size / stage.rate
    simulation = Simulation(values, motion=(_motion(nodes.cell.stage.motion, duration, moving), 0), wiring=wiring)
    first, rows = round(_SETTLE * stage.rate), array("d")
    index = 0

    def series() -> Array:
        return np.asarray(np.frombuffer(rows).reshape(-1, 3).T)

    def observe(sample: Sample, truth: Truth, reference: Sequence[float], command: Command, age: float) -> None:
        nonlocal index
        index += 1
        if index == first:
            simulation.inject(injection)
        elif index > first:
            asked = command.equivalent_current + command.switching_current
            rows.extend((asked, command.current, sample.y))
        if injection.stopped:
            raise ExcitationEnded(
                f"the excitation was ended early: {injection.stopped}; take less current, or allow more travel",
                series()[2],
            )

    simulation.run(progress, observe)
    asked, commands, reading = series()
    return compared_response(excitation, asked, commands, reading, control, stage, injection.clipped)


def _motion(motion: MotionParameters, duration: float, moving: bool) -> Trajectory:
    """The stage's motion until the end of an excitation of ``duration`` in s."""
    end_ns = round((_SETTLE + duration + _SPARE) * 1e9)
    if moving:
        return Trajectory(cycles(motion, -(-end_ns // Trajectory(cycles(motion, 1)).end_ns)))
    place = motion.start + 0.5 * motion.stroke
    return Trajectory([Waypoint(0, place, 0.0), Waypoint(end_ns, place, 0.0)])


def response_from_bag(
    bag: Path, parameters: MultisineParameters, control: ControlParameters, stage: StageParameters
) -> ComparedResponse:
    """The response of a loop that the controller's service ``~/excite`` excited.

    Samples are counted as the controller answered them: a lost one shifts the excitation too. The driver's state shows
    which commands came late. ``control`` are law and gains under which the bag was made; the response is compared with
    the description ``stage``.

    Raises:
        FrequencyResponseError: the bag cannot be read.
        ExcitationEnded: it has not the whole excitation.
    """
    wanted = (ENCODER, COMMAND, CONTROLLER_STATE)
    try:
        streams = read_streams(bag, {stream.topic: stream.layout for stream in (*wanted, DRIVER_STATE)})
    except BagError as error:
        raise FrequencyResponseError(str(error)) from error
    missing = [stream.topic for stream in wanted if stream.topic not in streams]
    if missing:
        raise FrequencyResponseError(f"bag {bag}: has no messages on {', '.join(missing)}")
    common = functools.reduce(np.intersect1d, (streams[stream.topic].stamp for stream in wanted))
    latency = values_at(streams.get(DRIVER_STATE.topic), "command_latency", common)
    # A sample without a latency is one before which no command arrived: it came after it, together with the next one.
    late = ~(latency <= _IN_TIME * stage.drive.delay * stage.period) & (DRIVER_STATE.topic in streams)
    lateness = _lateness(float(np.mean(late))) if late.size else ""
    because = f"; {lateness}" if lateness else ""
    state = streams[CONTROLLER_STATE.topic]
    commands = values_at(streams[COMMAND.topic], "control_current", common)
    asked = values_at(state, "equivalent_current", common) + values_at(state, "switching_current", common)
    excitation, injection = multisine_injection(parameters, make_law(control, stage), stage)
    limit = stage.highest_current
    added = np.nan_to_num(commands - np.clip(asked, -limit, limit))
    first, alike = _place(added, excitation.currents)
    part = slice(first, first + excitation.currents.size)
    if alike < _ALIKE or len(commands[part]) < excitation.currents.size:
        raise ExcitationEnded(
            f"bag {bag}: has not the whole excitation (correlation {alike:.2f}; allowed: >= {_ALIKE:g}): it ended "
            f"early, or was made with other parameters{because}"
        )
    # With its fades, of which a short period has much.
    whole = np.array([injection.step(0.0, 0.0) for _ in range(excitation.currents.size)])
    lacking = _missing_draws(excitation, added[part], whole)
    if lacking:
        raise ExcitationEnded(
            f"bag {bag}: the excitation lacks {lacking} of its {excitation.draws} draws of phases: it ended early"
            f"{because}"
        )
    reading = values_at(streams[ENCODER.topic], "y", common)
    clipped = int(np.count_nonzero(np.abs(commands[part]) >= limit))
    found = compared_response(excitation, asked[part], commands[part], reading[part], control, stage, clipped)
    return dataclasses.replace(found, late_share=float(np.mean(late[part])))


def _lateness(share: float) -> str:
    if share <= _FEW_LATE:
        return ""
    return (
        f"{share:.0%} of the commands came late, which delays the loop on the mean and is no fault of the machine; "
        "straightcomp doctor says what delays this computer"
    )


def _missing_draws(excitation: Multisine, added: Array, wanted: Array) -> int:
    """Draws whose used period is not in ``added`` (n,): of most of an excitation the correlation is high too."""
    there, expected = excitation.used(added), excitation.used(wanted)
    power = np.sqrt(np.sum(there**2, axis=1) * np.sum(expected**2, axis=1))
    return int(np.count_nonzero(np.sum(there * expected, axis=1) <= _ALIKE * power))


def _place(series: Array, wanted: Array) -> tuple[int, float]:
    """Where ``wanted`` (m,) begins in ``series`` (n,), and how well it correlates with what is there."""
    size = series.size + wanted.size
    product = np.fft.irfft(np.fft.rfft(series, size) * np.fft.rfft(wanted, size).conj(), size)
    first = int(np.argmax(product[: max(1, series.size)]))
    there = series[first : first + wanted.size]
    power = float(np.sqrt(np.sum(there**2) * np.sum(wanted**2)))
    return first, float(product[first]) / power if power else 0.0

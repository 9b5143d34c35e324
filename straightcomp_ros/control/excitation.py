"""The excitation of the loop: a test signal that is added to the commands of a law, sample by sample.

Live, offline and replayed runs use it through `Servo.inject`, with the same table of currents from the same parameters.
The law does not know of it, so that it stands at the plant's input as a disturbance would. A bag has both: the command,
and as its equivalent plus its switching current what the law had asked for.

For frequency responses the signal is a multisine: periods of a sum of sines on a grid of frequencies, repeated with
other random phases. Periodic signals have no leakage: the discrete Fourier transform over whole periods gives each line
exactly. Each draw of phases begins before its period, so that the transient dies in what is not used. Draws with other
phases show what of the response is not linear: a nonlinearity answers each draw with a component of its own that looks
random, which a repetition of the same period would not show (R. Pintelon and J. Schoukens, System Identification,
2nd ed., 2012, chapter 4).

The amplitudes are shaped by what the description expects of the loop. At low frequencies a law takes back most of what
is added to its command: there the signal is larger, by a bounded factor, since the law's own command is limited too.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.law import Law
from straightcomp_ros.control.margins import LoopResponse, loop_response
from straightcomp_ros.parameters.declaration import from_mapping, parameter
from straightcomp_ros.stage.description import StageParameters

Array = NDArray[np.float64]

_TRANSIENT_S = 0.5
"""However short the period: the loop's transient does not follow it. With the default period a lead of 0.3 s, 0.5 s or
1 s makes no difference to the response or its spread."""
_HIGHEST_SHARE = 0.4
"""Highest line, relative to the sampling rate: above, the samples show too little of the motion between them."""
_HIGHEST, _USUAL_SHARE = 500.0, 0.25
"""Hz, and relative to the sampling rate: the highest line unless another is asked for. A law's crossover moves with the
rate."""
_MOST = 3.0
"""Largest factor of the signal at low frequencies."""
_CROSSOVER = 0.5
"""Share of its lead over which a draw takes over from the one before."""
_FADE = 0.25
"""s over which a multisine rises and falls."""
_TRAVEL, _TRAVEL_SHARE = 3e-4, 0.35
"""m, and of the way to the mechanical stop: how far the platform may go, whichever is less."""
_CURRENT, _PEAK = 0.25, 3.6
"""RMS of a multisine: at most this share of the bias current, and the highest current over this peak factor. Both are
the 0.25 A that is usual on the shipped stage; with other turns the same shares move a platform alike."""


class FrequencyResponseError(ValueError):
    """No frequency response can be measured; the message names what is wrong and what would help."""


class ExcitationEnded(FrequencyResponseError):
    """The platform left the allowed travel, and the excitation faded out; ``reading`` (n,) is y in m until then, as far
    as it is known."""

    def __init__(self, text: str, reading: Array | None = None) -> None:
        super().__init__(text)
        self.reading = np.empty(0) if reading is None else reading


@dataclass(frozen=True)
class MultisineParameters:
    """The excitation of a frequency response."""

    lowest: float = parameter(2.0, "Lowest frequency of the excitation", "(0, 10000] Hz")
    highest: float = parameter(
        0.0,
        "Highest frequency of the excitation; 0: 500 Hz, or a quarter of the sampling rate where that is more; at most "
        "0.4 times the sampling rate is used",
        "[0, 10000] Hz",
    )
    lines: int = parameter(40, "Frequencies of the excitation, evenly spaced on a logarithmic scale", "[2, 1000]")
    period: float = parameter(
        1.0, "Period of the excitation; its inverse is the spacing of the frequencies", "(0, 60] s"
    )
    draws: int = parameter(40, "Draws of random phases", "[3, 100]")
    current: float = parameter(0.25, "RMS of the injected current", "(0, 100] A")
    travel: float = parameter(3e-4, "Largest |y − r|, beyond which the excitation ends early", "(0, 0.1] m")
    # A sum of sines rarely passes four times its RMS.
    motion: float = parameter(
        1.0 / 6.0, "RMS of the excited motion that the excitation aims at, at most, relative to the travel", "(0, 1]"
    )
    seed: int = parameter(1, "Seed of the phases", "[0, 2147483647]")

    @property
    def lead(self) -> float:
        """Time before the period of each draw in which the transient dies, s."""
        return max(0.5 * self.period, min(self.period, _TRANSIENT_S))

    @property
    def seconds(self) -> float:
        """Length of all draws, s."""
        return (self.lead + self.period) * self.draws


@dataclass(frozen=True)
class ExcitationParameters(MultisineParameters):
    """An excitation of any kind."""

    signal: str = parameter(
        "multisine",
        "Kind of the excitation. multisine: a sum of sines, for frequency responses. shake: random steps of the "
        "current, each taken back by the next. ramp_up, ramp_down: from zero to the current, or to its negative",
        choices=("multisine", "shake", "ramp_up", "ramp_down"),
    )
    duration: float = parameter(1.0, "Length of a shake or a ramp", "(0, 60] s")


def bearable_travel(stage: StageParameters) -> float:
    """How far in m the platform may be from its reference while it is excited, or under a law that is tried."""
    return min(_TRAVEL, _TRAVEL_SHARE * stage.platform.stop)


def suited_multisine(stage: StageParameters, **chosen: Any) -> MultisineParameters:
    """The excitation of a frequency response of ``stage``, with what is ``chosen``, by name.

    Current and travel are otherwise as much as coils and stop bear: the friction of a platform that hardly slides adds
    to the margins.

    Raises:
        ParameterError: a value is refused.
    """
    current = min(_CURRENT * stage.actuator.bias_current, stage.highest_current / _PEAK)
    return from_mapping(MultisineParameters, {"current": current, "travel": bearable_travel(stage), **chosen})


class Injection:
    """Adds a table of currents to the commands, with a fade at its beginning and its end.

    Args:
        currents: (n,) control current in A to add, one for each sample.
        fade: samples over which the signal rises at the beginning, and falls at the end; from 1 to half of n.
        limit: largest control current in A of command and signal together.
        travel: largest change of y − r in m since the signal's first sample; beyond it the signal fades out early.

    Attributes:
        finished: whether nothing is added any more.
        stopped: why the signal ended early, empty if it did not.
        clipped: samples in which the limit cut the signal.
    """

    def __init__(self, currents: Array, *, fade: int, limit: float, travel: float) -> None:
        self._currents: list[float] = currents.tolist()
        self._fade, self._limit, self._travel = fade, limit, travel
        self._next, self._end, self._origin = 0, currents.size, math.nan
        self.stopped, self.clipped = "", 0

    @property
    def finished(self) -> bool:
        return self._next >= self._end

    def stop(self, reason: str) -> None:
        """End early, by the same fade."""
        if not self.stopped and not self.finished:
            self.stopped = reason
            self._end = min(self._end, self._next + self._fade)

    def step(self, command: float, error: float) -> float:
        """The command (A) with the signal, for a sample whose ``error`` is r − y in m."""
        if self.finished:
            return command
        if self._next == 0:
            self._origin = error
        moved = abs(error - self._origin)
        if not moved <= self._travel:
            self.stop(f"y − r changed by {moved * 1e6:.3g} µm; allowed: {self._travel * 1e6:.3g} µm")
        weight = min(1.0, (self._next + 1) / self._fade, (self._end - self._next - 1) / self._fade)
        asked = command + weight * self._currents[self._next]
        self._next += 1
        if abs(asked) > self._limit:
            self.clipped += 1
            return math.copysign(self._limit, asked)
        # NaN too, which the driver refuses.
        return asked


@dataclass(frozen=True, eq=False)
class Multisine:
    """An excitation at a sampling rate.

    Attributes:
        frequencies: (lines,) Hz, whole multiples of the period's inverse.
        bins: (lines,) these multiples.
        samples: of a period.
        lead: samples of a draw before its period, which are not used.
        draws: of phases, one after the other.
        currents: (draws · (lead + samples),) A.
    """

    frequencies: Array
    bins: NDArray[np.int64]
    samples: int
    lead: int
    draws: int
    currents: Array

    def used(self, series: Array) -> Array:
        """The period of each draw, (draws, samples), of a series (n,) that begins with the excitation."""
        each = self.lead + self.samples
        return series[: self.draws * each].reshape(self.draws, each)[:, self.lead :]


def multisine(parameters: MultisineParameters, rate: float, expected: Callable[[Array], LoopResponse]) -> Multisine:
    """The excitation at a sampling ``rate`` in Hz; ``expected`` gives the loop's responses at frequencies (lines,) in
    Hz, as far as known.

    Raises:
        FrequencyResponseError: the lowest frequency does not fit the period, or the period or the lowest frequency not
            the highest one.
    """
    samples = round(parameters.period * rate)
    highest = min(parameters.highest or max(_HIGHEST, _USUAL_SHARE * rate), _HIGHEST_SHARE * rate)
    if not rate < highest * samples:
        raise FrequencyResponseError(
            f"period of {parameters.period:g} s; allowed: > {1.0 / highest:g} s, that of the highest frequency"
        )
    spacing = rate / samples
    if not spacing <= parameters.lowest < highest:
        raise FrequencyResponseError(
            f"lowest frequency {parameters.lowest:g} Hz with a period of {parameters.period:g} s; "
            f"allowed: >= {spacing:g} Hz and below the highest of {highest:g} Hz"
        )
    wanted = np.geomspace(parameters.lowest, highest, parameters.lines) / spacing
    bins = np.unique(np.round(wanted).astype(np.int64))
    random = np.random.default_rng(parameters.seed)
    frequencies = np.asarray(bins * spacing, dtype=np.float64)
    loop, share = expected(frequencies), np.sqrt(2.0 / bins.size)
    shape = np.minimum(1.0 / np.abs(loop.sensitivity), _MOST)
    shape *= parameters.current * share / np.sqrt(np.mean(shape**2))
    amplitudes = np.minimum(
        shape, parameters.motion * parameters.travel * share / np.abs(loop.plant * loop.sensitivity)
    )
    lead = round(parameters.lead * rate)
    currents, before = [], np.zeros(lead)
    # The draws cross over smoothly: where the law takes back most of the signal, a step of it would come through.
    new = 0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, np.arange(lead) / (_CROSSOVER * lead)))
    for _ in range(parameters.draws):
        spectrum = np.zeros(samples // 2 + 1, complex)
        spectrum[bins] = 0.5 * samples * amplitudes * np.exp(2j * np.pi * random.random(bins.size))
        once = np.fft.irfft(spectrum, samples)
        currents += [before + new * (once[samples - lead :] - before), once]
        # What would follow: the draw from its beginning.
        before = once[:lead]
    return Multisine(frequencies, bins, samples, lead, parameters.draws, np.concatenate(currents))


def multisine_injection(
    parameters: MultisineParameters, law: Law, stage: StageParameters
) -> tuple[Multisine, Injection]:
    """The multisine shaped for ``law`` on ``stage`` as described, and its injection; raises as `multisine`, and
    NotLinear for a law without a linearisation at rest."""
    made = multisine(parameters, stage.rate, lambda lines: loop_response(law, stage, lines, stage.friction.viscous))
    fade = max(1, round(_FADE * stage.rate))
    if made.currents.size < 2 * fade:
        raise FrequencyResponseError(
            f"{parameters.draws} draws with a period of {parameters.period:g} s last {parameters.seconds:g} s; "
            f"allowed: >= {2.0 * _FADE:g} s, in which the excitation rises and falls: take more draws"
        )
    return made, Injection(made.currents, fade=fade, limit=stage.highest_current, travel=parameters.travel)


def simple_currents(parameters: ExcitationParameters, stage: StageParameters) -> Array:
    """(n,) A, of a shake or a ramp."""
    count = max(2, round(parameters.duration * stage.rate))
    if parameters.signal == "shake":
        # Nothing slow is left that could move the platform.
        steps = parameters.current * np.random.default_rng(parameters.seed).uniform(-1.0, 1.0, count // 2)
        return np.stack([steps, -steps], axis=1).ravel()
    end = parameters.current if parameters.signal == "ramp_up" else -parameters.current
    return np.linspace(0.0, end, count)


def made_injection(parameters: ExcitationParameters, law: Law, stage: StageParameters) -> Injection:
    """The injection; raises as :func:`multisine_injection`."""
    if parameters.signal == "multisine":
        return multisine_injection(parameters, law, stage)[1]
    currents = simple_currents(parameters, stage)
    return Injection(currents, fade=1, limit=stage.highest_current, travel=parameters.travel)

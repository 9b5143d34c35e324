"""The laws by name, and the parameters that the controller takes."""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control import sliding_mode, smc_observer
from straightcomp_ros.control.filters import FilterParameters, Filters, filters_of, oscillators_of, turned_gain
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.observer import nominal_loop, observer_gains
from straightcomp_ros.control.sliding_mode import SlidingDesign, reaching_bound
from straightcomp_ros.parameters.declaration import RefusedParameter, group, parameter
from straightcomp_ros.stage.description import StageParameters

LAWS = ("linear", "smc", "smc_observer")
OPEN_LOOP = "open_loop"
"""Name of the law that commands nothing, for the first steps of commissioning."""

_MISFIT_BANDWIDTH = 60.0
"""Hz; lower than the encoder's noise, higher than the reversals of friction."""
_TRIED_HUM = 1.0
"""A/m: so small a gain of an oscillator that its pole moves in proportion to it."""
_MISFIT_MEMORY = 0.3
"""s; some reversals of the map at the shipped speed."""

_SMALLEST_SIZE = 1e-3
"""Of friction: none would be a dead end for the fit."""
_COUNTING, _SWITCHING = 0.5, 2.0
"""Times the force that is lost in the quanta: from there on friction counts, and makes a platform hunt."""
_FREE_RATES = {"bandwidth": 0.132, "surface": 2.53, "reaching": 0.079}
_FREE = {"third_pole": 0.083, "gain_allowance": 0.9}
"""Gains without friction, the first times the dead time, found on the shipped stage without its friction. Nothing but
the encoder's noise disturbs such a platform: a slow observer, and much damping, leave the least error. What the
measured current says of the converter's rounding is worth as much as the allowance is right."""
_BENDING = 2.0
"""Counts of the encoder."""
_SHAKEN = 0.85
"""Of the amplitude that F_C would give the mass at the dither's frequency: half of that of the usual dither. On 105
drawn stages with encoders of 1 to 300 nm dither left 0.02 to 1.2 times the error of none where bristles bend by less
(median 0.28), and up to 30 times elsewhere."""
_STILL = 0.1
"""Counts by which a reference at rest may move: a hold costs no more than that, and rounding costs 0.29, RMS."""
_STAYING = 3.0
"""Amplitudes of the dither's motion within which a platform rests: there may be 1.7 times the dither, and the loop
answers it. With 2 a platform rested only after its first stroke."""
_DITHER = 0.54
"""Frequency of the dither times the dead time: well beyond the loop's bandwidth, a quarter of the shipped rate."""
_SPRING = 0.1
"""Of the force that moves the mass by as much at the dither's frequency: softer bristles are a spring to the dither."""
_BEGINNING = 10.0
"""Turns over which the dither begins and ends: a platform that slides is stopped within less than one."""
_MOST_DITHER = 1.7
"""Dither relative to that of the described friction: blocks that bend by more than the dither moves them seem to be
ever more friction, which no dither keeps sliding."""


@dataclass(frozen=True)
class ObserverDesign:
    """Observer, friction model and reaching law of 'smc_observer'."""

    bandwidth: float = parameter(205.0, "Bandwidth of two poles of the extended state observer", "(0, 10000] Hz")
    third_pole: float = parameter(1.28, "Third pole of the observer relative to its bandwidth", "[0.01, 10]")
    delay: float = parameter(0.88, "Loop delay that the observer assumes", "[0, 1] samples")
    surface: float = parameter(575.0, "Rate λ at which the error decays on the sliding surface", "(0, 100000] 1/s")
    reaching: float = parameter(396.0, "Rate κ at which σ decays", "(0, 100000] 1/s")
    gain_allowance: float = parameter(
        1.7,
        "Factor by which a current is assumed to accelerate more than nominal; above 1 leaves gain margin",
        "[0.1, 10]",
    )
    velocity_share: float = parameter(
        0.3,
        "Share of the observed velocity in the velocity of the friction model; the rest is the reference's",
        "[0, 1]",
    )
    first_size: float = parameter(
        0.15, "Friction at the start, relative to the friction model; too much makes limit cycles", "[0.1, 10]"
    )
    largest_size: float = parameter(4.0, "Largest friction relative to the friction model", "[0.1, 10]")
    memory: float = parameter(2.0, "Time constant with which the fit of friction's size forgets", "[0.1, 1000] s")
    misfit: float = parameter(
        0.1, "RMS that the friction model leaves unexplained, relative to F_C, from which the law stiffens", "(0, 100]"
    )
    stiffening: float = parameter(1.4, "Factor of bandwidth, λ and κ from twice that misfit on", "[1, 10]")
    rest_band: float = parameter(
        2.0,
        "Largest |y − r| at rest at which the command is held, or what dither moves the platform by; 0 never holds",
        "[0, 1000] counts",
    )
    rest_speed: float = parameter(1e-7, "Largest |ṙ| of a reference at rest", "[0, 1] m/s")
    rest_wait: float = parameter(0.1, "Time at rest until the command is held", "[0.01, 10] s")
    dither: float = parameter(
        1.7,
        "Amplitude of the dither relative to the current that carries, at its frequency, the friction that is found; "
        "only where friction's bristles bend by less than two counts, or than half of what dither moves the platform "
        "by, before it slides, and are stiff enough. 0: none",
        "[0, 10]",
    )


@dataclass(frozen=True)
class ControlParameters:
    """Law and its design."""

    law: str = parameter(
        "smc_observer",
        "Control law; open_loop commands nothing but the excitation, for commissioning",
        choices=(*LAWS, OPEN_LOOP),
    )
    margins: str = parameter(
        "require",
        "What the controller does with gains that lack the least margins on the stage as described. require: refuses "
        "them. warn: uses them, with a warning",
        choices=("require", "warn"),
    )
    smc: SlidingDesign = group(SlidingDesign, "Laws smc and linear")
    smc_observer: ObserverDesign = group(ObserverDesign, "Law smc_observer")
    filters: FilterParameters = group(FilterParameters)

    def check(self, stage: StageParameters) -> None:
        """Raise RefusedParameter if the law's design does not fit ``stage``; the group's name is 'control'."""
        bound = reaching_bound(self.smc, stage)
        if self.law == "smc" and self.smc.enforce_reaching and self.smc.rho <= bound:
            raise RefusedParameter(
                "control.smc.rho",
                f"{self.smc.rho!r} m/s² does not fulfil the reaching condition (11); "
                f"allowed: > {bound:.4g} m/s², or any with '{{group}}control.smc.enforce_reaching' false",
            )


def _open_loop(
    gains: tuple[()], state: tuple[()], y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> tuple[tuple[()], Command]:
    """No law: the current is zero, and only an excitation moves the platform."""
    return state, Command(0.0, r - y, math.nan, 0.0, 0.0, math.nan, math.nan)


def prepare_all() -> None:
    """Compile the steps of all laws, or read their machine code, so that `Law.prepare` takes no time later."""
    for name in LAWS:
        make_law(ControlParameters(law=name), StageParameters()).prepare()


def make_law(parameters: ControlParameters, stage: StageParameters) -> Law:
    """The law that the parameters name, for a stage.

    Raises:
        ValueError: the mains are to be taken out by a law without a linearisation, or where none does it.
    """
    count = oscillators_of(parameters.filters, stage.rate) if parameters.law != OPEN_LOOP else 0
    gains = _hum_gains(parameters, stage, count) if count else ()
    return _law(parameters, stage, filters_of(parameters.filters, stage.period, gains))


def _hum_gains(parameters: ControlParameters, stage: StageParameters, count: int) -> tuple[complex, ...]:
    """The gains of the oscillators for the mains, each found where a small one puts its pole in the described loop."""
    from straightcomp_ros.control.margins import closed_loop, linearised, sampled_plant

    plant, found = sampled_plant(stage), []
    for number in range(count):
        gains = [0j] * number + [complex(_TRIED_HUM)]
        law = _law(parameters, stage, filters_of(parameters.filters, stage.period, tuple(gains)))
        poles = np.linalg.eigvals(closed_loop(plant, linearised(law)))
        own = np.exp(2j * math.pi * (number + 1) * parameters.filters.mains.frequency * stage.period)
        pole = complex(poles[np.abs(poles - own).argmin()])
        found.append(turned_gain(parameters.filters, number, stage.period, _TRIED_HUM, pole))
    return tuple(found)


def _law(parameters: ControlParameters, stage: StageParameters, filters: Filters) -> Law:
    if parameters.law == OPEN_LOOP:
        return Law((), lambda y: (), _open_loop)
    if parameters.law in ("linear", "smc"):
        design, switching = parameters.smc, parameters.law == "smc"
        feedforward = switching and design.feedforward
        numbers = sliding_mode.gains(design, stage, filters, switching=switching, feedforward=feedforward)
        return Law(numbers, sliding_mode.start, sliding_mode.step, compiled=True)
    return _smc_observer(parameters.smc_observer, stage, filters)


def _smc_observer(design: ObserverDesign, stage: StageParameters, filters: Filters) -> Law:
    period = stage.period
    loop = nominal_loop(stage, delay_samples=design.delay, gain_allowance=design.gain_allowance)
    friction = stage.friction
    quantum = stage.quantum
    coulomb = max(friction.coulomb, _SMALLEST_SIZE * quantum)
    turn, amplitude, knee = dither_of(design, stage)
    # None where nothing is to be held; the mains push at rest too, and a command that is held would not answer them.
    band = -1.0
    if design.rest_band > 0.0 and not any(filters.hum_1):
        # A platform that only dither moves is at rest.
        band = max(design.rest_band * stage.encoder.y_resolution, _STAYING * knee / _dither_rate(stage))
    most = _MOST_DITHER * smc_observer.UNDER_DITHER if amplitude > 0.0 else design.largest_size
    # Without friction it damps far beyond the loop's bandwidth, which makes nearly any mode unstable.
    modes = stage.platform.modes.present
    free, slow = (design, design) if modes else (_free(design, stage), _slow(design, stage))
    gains = smc_observer.Gains(
        free=_stiffness(free, 1.0, stage),
        slow=_stiffness(slow, 1.0, stage),
        quiet=_stiffness(design, 1.0, stage),
        stiff=_stiffness(design, design.stiffening, stage),
        share=design.velocity_share,
        misfit=max(design.misfit * friction.coulomb, quantum) / loop.mass,
        lugre=friction.constants()._replace(viscous=friction.viscous + stage.platform.damping),
        kept=math.exp(-period / design.memory),
        smooth=1.0 - math.exp(-2.0 * math.pi * _MISFIT_BANDWIDTH * period),
        mean=1.0 - math.exp(-period / _MISFIT_MEMORY),
        # The magnets' stiffness changes the acceleration by 1 m/s² over it, the unit of the fit's first variance.
        travel=stage.platform.mass / stage.actuator.position_stiffness,
        # Without dry friction there is no size to fit.
        smallest=_SMALLEST_SIZE if friction.coulomb > 0.0 else 1.0,
        largest=min(design.largest_size, most) if friction.coulomb > 0.0 else 1.0,
        counting=_COUNTING * quantum / coulomb,
        holding=_holding(stage) / coulomb,
        speed=design.rest_speed,
        still=_STILL * stage.encoder.y_resolution,
        band=band,
        wait=design.rest_wait,
        # The mean is over a quarter of the wait: it must forget the approach.
        weight=1.0 - math.exp(-4.0 * period / design.rest_wait),
        dither=amplitude,
        turn=smc_observer.Dither(math.cos(turn), math.sin(turn), turn / (math.tau * _BEGINNING)),
        knee=knee,
        code=stage.drive.current_step,
        half_codes=stage.drive.half_codes,
        loop=loop,
        filters=filters,
    )
    first_size = max(gains.smallest, min(design.first_size, gains.largest))
    first = partial(smc_observer.start, first_size)
    return Law(gains, first, smc_observer.step, compiled=True, unrest=".rest.restless")


class Dithering(NamedTuple):
    """Angle by which the dither goes on in a period, its amplitude in A, and that of the velocity in m/s which it gives
    the mass without friction."""

    angle: float
    amplitude: float
    velocity: float


def needs_dither(stage: StageParameters) -> bool:
    """Whether friction counts, and switches within two counts of the encoder, so that readings do not predict it, or
    within much less than dither moves the platform, and dither makes it slide."""
    friction, inertia = stage.friction, stage.platform.mass * _dither_rate(stage) ** 2
    unseen = max(_BENDING * stage.encoder.y_resolution, _SHAKEN * friction.coulomb / inertia)
    switches = friction.static <= unseen * friction.bristle_stiffness
    slides = friction.bristle_stiffness >= _SPRING * inertia
    return switches and slides and friction.coulomb >= _SWITCHING * stage.quantum


def dither_of(design: ObserverDesign, stage: StageParameters) -> Dithering:
    """The dither on a stage, of no amplitude where it needs none.

    It keeps the platform sliding to and fro, far faster than the loop, so that friction acts on the slow motion as a
    damping (`margins.py`).
    """
    if not needs_dither(stage):
        return Dithering(0.0, 0.0, 0.0)
    force, omega = design.dither * stage.friction.coulomb, _dither_rate(stage)
    passed = 1.0 / math.hypot(1.0, omega / (2.0 * math.pi * stage.drive.bandwidth))
    amplitude = force / (passed * stage.actuator.current_stiffness)
    return Dithering(omega * stage.period, amplitude, force / (stage.platform.mass * omega))


def _dither_rate(stage: StageParameters) -> float:
    return 2.0 * math.pi * min(0.25 * stage.rate, _DITHER / stage.dead_time)


def can_hold(stage: StageParameters) -> bool:
    """Whether friction as described holds the platform at rest."""
    return stage.friction.coulomb >= _holding(stage)


def _holding(stage: StageParameters) -> float:
    """Friction in N that holds the platform a count off the balance, with half a step of the converter too much."""
    return stage.quantum - 0.5 * stage.drive.current_step * stage.actuator.current_stiffness


def _stiffness(design: ObserverDesign, factor: float, stage: StageParameters) -> smc_observer.Stiffness:
    """The law with bandwidth, λ and κ times ``factor``."""
    bandwidth, period = factor * design.bandwidth, stage.period
    rate = 2.0 * math.pi * bandwidth * period
    return smc_observer.Stiffness(
        factor * design.surface,
        factor * design.reaching,
        *observer_gains(bandwidth, design.third_pole, period),
        double=1.0 - math.exp(-rate),
        third=1.0 - math.exp(-rate * design.third_pole),
        mass=stage.platform.mass / design.gain_allowance,
    )


def _free(design: ObserverDesign, stage: StageParameters) -> ObserverDesign:
    gains = {name: number / stage.dead_time for name, number in _FREE_RATES.items()}
    return replace(design, **gains, **_FREE)


def _slow(design: ObserverDesign, stage: StageParameters) -> ObserverDesign:
    free = _free(design, stage)
    return replace(design, bandwidth=free.bandwidth, third_pole=free.third_pole)


def states_of(control: ControlParameters, stage: StageParameters) -> dict[str, ControlParameters]:
    """The law in each state that it may take on ``stage``, by name: ``quiet``, as its gains are.

    'smc_observer' is ``stiff`` when its friction model explains too little, and ``slow`` and then ``free`` as it finds
    less and less friction, unless there certainly is some, or the platform has modes.
    """
    found = {"quiet": control}
    if control.law != "smc_observer":
        return found
    design = control.smc_observer
    if stage.friction.coulomb > 0.0:
        stiffer = {name: design.stiffening * getattr(design, name) for name in ("bandwidth", "surface", "reaching")}
        found["stiff"] = replace(control, smc_observer=replace(design, **stiffer, stiffening=1.0))
    certain = stage.friction.coulomb / stage.uncertainty.friction >= _COUNTING * stage.quantum
    if not stage.platform.modes.present and not certain:
        for name, one in (("slow", _slow(design, stage)), ("free", _free(design, stage))):
            found[name] = replace(control, smc_observer=replace(one, stiffening=1.0))
    return found


def described_state(control: ControlParameters, stage: StageParameters) -> tuple[str, ControlParameters]:
    """Of :func:`states_of` the one that the law takes on a stage that is as described: its name, and the law there."""
    states = states_of(control, stage)
    counts = "free" not in states or stage.friction.coulomb >= _COUNTING * stage.quantum
    name = "quiet" if counts else "free"
    return name, states[name]

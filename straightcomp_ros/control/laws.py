"""The laws by name, and the parameters that the controller takes."""

import math
from dataclasses import dataclass, replace
from functools import partial

from straightcomp_ros.control import sliding_mode, smc_observer
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
_MISFIT_MEMORY = 0.3
"""s; some reversals of the map at the shipped speed."""


@dataclass(frozen=True)
class ObserverDesign:
    """Observer, friction model and reaching law of 'smc_observer'."""

    bandwidth: float = parameter(205.0, "Bandwidth of two poles of the extended state observer", "(0, 10000] Hz")
    third_pole: float = parameter(1.28, "Third pole of the observer relative to its bandwidth", "[0.1, 10]")
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
        2.0, "Largest |y − r| at rest at which the command is held; 0 never holds", "[0, 1000] counts"
    )
    rest_speed: float = parameter(1e-7, "Largest |ṙ| of a reference at rest", "[0, 1] m/s")
    rest_wait: float = parameter(0.1, "Time at rest until the command is held", "[0.01, 10] s")


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
    """Compile the steps of all laws, or read their machine code, so that :func:`make_law` takes no time later."""
    for name in LAWS:
        make_law(ControlParameters(law=name), StageParameters())


def make_law(parameters: ControlParameters, stage: StageParameters) -> Law:
    """The law that the parameters name, for a stage."""
    if parameters.law == OPEN_LOOP:
        return Law((), lambda y: (), _open_loop)
    if parameters.law in ("linear", "smc"):
        design, switching = parameters.smc, parameters.law == "smc"
        feedforward = switching and design.feedforward
        numbers = sliding_mode.gains(design, stage, switching=switching, feedforward=feedforward)
        return Law(numbers, sliding_mode.start, sliding_mode.step, compiled=True)
    return _smc_observer(parameters.smc_observer, stage)


def _smc_observer(design: ObserverDesign, stage: StageParameters) -> Law:
    period = stage.period
    loop = nominal_loop(stage, delay_samples=design.delay, gain_allowance=design.gain_allowance)
    gains = smc_observer.Gains(
        quiet=_stiffness(design, 1.0, period),
        stiff=_stiffness(design, design.stiffening, period),
        share=design.velocity_share,
        misfit=design.misfit * stage.friction.coulomb / loop.mass,
        lugre=stage.friction.constants(),
        kept=math.exp(-period / design.memory),
        smooth=1.0 - math.exp(-2.0 * math.pi * _MISFIT_BANDWIDTH * period),
        mean=1.0 - math.exp(-period / _MISFIT_MEMORY),
        # The magnets' stiffness changes the acceleration by 1 m/s² over it, the unit of the fit's first variance.
        travel=stage.platform.mass / stage.actuator.position_stiffness,
        largest=design.largest_size,
        speed=design.rest_speed,
        band=design.rest_band * stage.encoder.y_resolution,
        wait=design.rest_wait,
        # The mean is over a quarter of the wait: it must forget the approach.
        weight=1.0 - math.exp(-4.0 * period / design.rest_wait),
        loop=loop,
    )
    first_size = min(design.first_size, design.largest_size)
    return Law(gains, partial(smc_observer.start, first_size), smc_observer.step, compiled=True)


def _stiffness(design: ObserverDesign, factor: float, period: float) -> smc_observer.Stiffness:
    """The law with bandwidth, λ and κ times ``factor``."""
    bandwidth = factor * design.bandwidth
    rate = 2.0 * math.pi * bandwidth * period
    return smc_observer.Stiffness(
        factor * design.surface,
        factor * design.reaching,
        *observer_gains(bandwidth, design.third_pole, period),
        double=1.0 - math.exp(-rate),
        third=1.0 - math.exp(-rate * design.third_pole),
    )


def stiffened(control: ControlParameters) -> ControlParameters:
    """The law as it is when its friction model explains too little: 'smc_observer' stiffest, others as they are."""
    if control.law != "smc_observer":
        return control
    design = control.smc_observer
    stiffer = {name: design.stiffening * getattr(design, name) for name in ("bandwidth", "surface", "reaching")}
    return replace(control, smc_observer=replace(design, **stiffer, stiffening=1.0))

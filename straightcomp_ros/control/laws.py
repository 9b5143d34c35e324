"""The laws by name, and the parameters that the controller takes."""

from __future__ import annotations

from dataclasses import dataclass

from straightcomp_ros.control import error_tracking as tracking
from straightcomp_ros.control import sliding_mode, smc_observer, super_twisting
from straightcomp_ros.control.design import NominalPlant, SlidingDesign, reaching_bound
from straightcomp_ros.control.law import Law
from straightcomp_ros.settings.declaration import RefusedParameter, group, parameter

LAWS = ("linear", "smc", "super_twisting", "smc_observer")


@dataclass(frozen=True)
class ObserverDesign:
    """Observer and reaching law of 'smc_observer'."""

    bandwidth: float = parameter(545.0, "Bandwidth of the extended state observer", unit="Hz", above=0.0, maximum=1e4)
    delay: float = parameter(1.0, "Loop delay that the observer assumes", unit="samples", minimum=0.0, maximum=1.0)
    surface: float = parameter(
        545.0, "Rate λ at which the error decays on the sliding surface", unit="1/s", above=0.0, maximum=1e5
    )
    reaching: float = parameter(600.0, "Rate κ at which σ decays near the surface", unit="1/s", above=0.0, maximum=1e5)
    rho: float = parameter(5.0, "Largest reaching acceleration ρ", unit="m/s²", above=0.0, maximum=1e4)
    gain_allowance: float = parameter(
        2.3,
        "Factor by which a current is assumed to accelerate more than nominal; above 1 leaves gain margin",
        minimum=0.1,
        maximum=10.0,
    )


@dataclass(frozen=True)
class TwistingDesign:
    """Observer and gains of 'super_twisting'."""

    bandwidth: float = parameter(200.0, "Bandwidth of the extended state observer", unit="Hz", above=0.0, maximum=1e4)
    delay: float = parameter(0.5, "Loop delay that the observer assumes", unit="samples", minimum=0.0, maximum=1.0)
    surface: float = parameter(
        500.0, "Rate λ at which the error decays on the sliding surface", unit="1/s", above=0.0, maximum=1e5
    )
    disturbance_rate: float = parameter(10.0, "Bound L of the disturbance's rate", unit="m/s³", above=0.0, maximum=1e6)


@dataclass(frozen=True)
class ControlParameters:
    """Law, design, and what the law believes of the plant."""

    law: str = parameter("smc_observer", "Control law", choices=LAWS)
    current_limit: float = parameter(0.9, "Largest control current |i_c| of a law", unit="A", above=0.0, maximum=100.0)
    smc: SlidingDesign = group(SlidingDesign, "Laws smc and linear")
    super_twisting: TwistingDesign = group(TwistingDesign, "Law super_twisting")
    smc_observer: ObserverDesign = group(ObserverDesign, "Law smc_observer")
    nominal: NominalPlant = group(NominalPlant, "Nominal plant of the laws")

    def __post_init__(self) -> None:
        bound = reaching_bound(self.smc, self.nominal)
        if self.law == "smc" and self.smc.enforce_reaching and self.smc.rho <= bound:
            raise RefusedParameter(
                "smc.rho",
                f"{self.smc.rho!r} m/s² does not fulfil the reaching condition (11); "
                f"allowed: > {bound:.4g} m/s², or any with '{{group}}smc.enforce_reaching' false",
            )


def prepare_all() -> None:
    """Make all laws ready to be made without a delay: what is compiled is compiled now, or read."""
    for name in LAWS:
        make_law(ControlParameters(law=name), 1.0)


def make_law(parameters: ControlParameters, period: float) -> Law:
    """The law that the parameters name, for a sampling period in s."""
    design, observer, nominal = parameters.smc, parameters.smc_observer, parameters.nominal
    if parameters.law in ("linear", "smc"):
        gains = sliding_mode.gains(
            design,
            nominal,
            switching=parameters.law == "smc",
            feedforward=parameters.law == "smc" and design.feedforward,
            period=period,
            current_limit=parameters.current_limit,
        )
        return Law(gains, sliding_mode.start, sliding_mode.step, compiled=True)

    def loop(delay: float, bandwidth: float, gain_allowance: float) -> tracking.Loop:
        return tracking.loop(
            period=period,
            delay_samples=delay,
            amplifier_bandwidth=nominal.amplifier_bandwidth,
            observer_bandwidth=bandwidth,
            # To a law, magnets that pull more strongly are a lighter platform; where they balance stays the same.
            mass=nominal.mass / gain_allowance,
            current_limit=parameters.current_limit,
            actuator=nominal.actuator,
        )

    if parameters.law == "super_twisting":
        twisting = parameters.super_twisting
        believed = loop(twisting.delay, twisting.bandwidth, 1.0)
        return Law(
            super_twisting.gains(twisting.surface, twisting.disturbance_rate, believed),
            super_twisting.start,
            super_twisting.step,
            compiled=True,
        )
    believed = loop(observer.delay, observer.bandwidth, observer.gain_allowance)
    reaching = smc_observer.Gains(observer.surface, observer.reaching, observer.rho, believed)
    return Law(reaching, smc_observer.start, smc_observer.step, compiled=True)

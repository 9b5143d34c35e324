"""The laws by name, and the parameters that the controller takes."""

from dataclasses import dataclass

from straightcomp_ros.control import sliding_mode, smc_observer, super_twisting
from straightcomp_ros.control.design import NominalPlant, SlidingDesign, reaching_bound
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.observer import Loop, nominal_loop
from straightcomp_ros.settings.declaration import RefusedParameter, group, parameter

LAWS = ("linear", "smc", "super_twisting", "smc_observer")


@dataclass(frozen=True)
class ObserverDesign:
    """Observer and reaching law of 'smc_observer'."""

    bandwidth: float = parameter(545.0, "Bandwidth of the extended state observer", "(0, 10000] Hz")
    delay: float = parameter(1.0, "Loop delay that the observer assumes", "[0, 1] samples")
    surface: float = parameter(545.0, "Rate λ at which the error decays on the sliding surface", "(0, 100000] 1/s")
    reaching: float = parameter(600.0, "Rate κ at which σ decays near the surface", "(0, 100000] 1/s")
    rho: float = parameter(5.0, "Largest reaching acceleration ρ", "(0, 10000] m/s²")
    gain_allowance: float = parameter(
        2.3,
        "Factor by which a current is assumed to accelerate more than nominal; above 1 leaves gain margin",
        "[0.1, 10]",
    )


@dataclass(frozen=True)
class TwistingDesign:
    """Observer and gains of 'super_twisting'."""

    bandwidth: float = parameter(200.0, "Bandwidth of the extended state observer", "(0, 10000] Hz")
    delay: float = parameter(0.5, "Loop delay that the observer assumes", "[0, 1] samples")
    surface: float = parameter(500.0, "Rate λ at which the error decays on the sliding surface", "(0, 100000] 1/s")
    disturbance_rate: float = parameter(10.0, "Bound L of the disturbance's rate", "(0, 1e6] m/s³")


@dataclass(frozen=True)
class ControlParameters:
    """Law, its design, and the nominal plant."""

    law: str = parameter("smc_observer", "Control law", choices=LAWS)
    current_limit: float = parameter(0.9, "Largest control current |i_c| of a law", "(0, 100] A")
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
    """Compile the steps of all laws, or read their machine code, so that :func:`make_law` takes no time later."""
    for name in LAWS:
        make_law(ControlParameters(law=name), 1.0)


def make_law(parameters: ControlParameters, period: float) -> Law:
    """The law that the parameters name, for a sampling period in s."""
    if parameters.law in ("linear", "smc"):
        switching = parameters.law == "smc"
        design = parameters.smc
        numbers = sliding_mode.gains(
            design,
            parameters.nominal,
            switching=switching,
            feedforward=switching and design.feedforward,
            period=period,
            current_limit=parameters.current_limit,
        )
        return Law(numbers, sliding_mode.start, sliding_mode.step, compiled=True)

    def loop(**chosen: float) -> Loop:
        return nominal_loop(parameters.nominal, period=period, current_limit=parameters.current_limit, **chosen)

    if parameters.law == "super_twisting":
        twisting = parameters.super_twisting
        delayed = loop(delay_samples=twisting.delay, bandwidth=twisting.bandwidth)
        gains = super_twisting.gains(twisting.surface, twisting.disturbance_rate, delayed)
        return Law(gains, super_twisting.start, super_twisting.step, compiled=True)
    observer = parameters.smc_observer
    delayed = loop(delay_samples=observer.delay, bandwidth=observer.bandwidth, gain_allowance=observer.gain_allowance)
    reaching = smc_observer.Gains(observer.surface, observer.reaching, observer.rho, delayed)
    return Law(reaching, smc_observer.start, smc_observer.step, compiled=True)

"""The laws by name, and the parameters that the controller takes."""

from __future__ import annotations

from dataclasses import dataclass

from straightcomp_ros.control import sliding_mode
from straightcomp_ros.control.design import NominalPlant, SlidingDesign, reaching_bound
from straightcomp_ros.control.law import Law
from straightcomp_ros.parameters import ParameterError, group, parameter

LAWS = ("linear", "smc")


@dataclass(frozen=True)
class ControlParameters:
    """Law, design, and what the law believes of the plant."""

    law: str = parameter("smc", "Control law", choices=LAWS)
    current_limit: float = parameter(0.9, "Largest |i_c| that a law asks for", unit="A", above=0.0, maximum=100.0)
    velocity_bandwidth: float = parameter(
        1000.0, "Bandwidth of the velocity estimate of 'linear' and 'smc'", unit="Hz", above=0.0, maximum=1e5
    )
    design: SlidingDesign = group(SlidingDesign)
    nominal: NominalPlant = group(NominalPlant)

    def __post_init__(self) -> None:
        bound = reaching_bound(self.design, self.nominal)
        if self.law == "smc" and self.design.enforce_reaching and self.design.rho <= bound:
            raise ParameterError(
                f"parameter 'design.rho': {self.design.rho!r} m/s² does not fulfil the reaching condition (11); "
                f"allowed: > {bound:.4g} m/s² (or set design.enforce_reaching to false)"
            )


def make_law(parameters: ControlParameters, period: float) -> Law:
    """The law that the parameters name, for a sampling period in s."""
    gains = sliding_mode.gains(
        parameters.design,
        parameters.nominal,
        switching=parameters.law == "smc",
        period=period,
        velocity_bandwidth=parameters.velocity_bandwidth,
        current_limit=parameters.current_limit,
    )
    return Law(gains, sliding_mode.start, sliding_mode.step)

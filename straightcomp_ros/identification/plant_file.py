"""Estimated parameters as a ROS 2 parameter file with the names of the simulated plant."""

from __future__ import annotations

from straightcomp_ros.identification.estimate import DERIVED, UNITS, Estimate, Estimated

PREFIX = "simulated.plant."
_HEAD = """\
# Plant parameters estimated from a bag, for `straightcomp simulate --params-file` and for the node `driver`.
# Only the plant is here: all other parameters, and all other nodes, take the defaults of their declarations.
# Each value with its 95 % interval; SI units. What the bag determines poorly is left out and marked.
"""


def parameter_file(estimate: Estimate) -> str:
    """Text of the file."""
    lines = [_HEAD, "/**/driver:\n  ros__parameters:"]
    for name, found in estimate.parameters.items():
        if name not in DERIVED:
            lines += _entry(found, left_out=found.poor and not _needed(found, estimate))
    return "\n".join(lines) + "\n"


def _needed(found: Estimated, estimate: Estimate) -> bool:
    """F_S stands beside F_C even when poor: left out, its default may be below F_C, which is refused."""
    return found.name == "friction.static" and not estimate.parameters["friction.coulomb"].poor


def _entry(found: Estimated, *, left_out: bool) -> list[str]:
    unit = f" {UNITS[found.name]}" if UNITS[found.name] else ""
    if found.known:
        words = "given, not estimated"
    else:
        words = f"{found.low:.4g} to {found.high:.4g}{unit}" + (", poorly determined" if found.poor else "")
    value = f"{PREFIX}{found.name}: {_number(found.value)}"
    return [f"    # {words}", f"    # {value}" if left_out else f"    {value}"]


def _number(value: float) -> str:
    # YAML 1.1 takes 2e-05 for a text: a float needs its point.
    text = f"{value:.6g}"
    mantissa, exponent, power = text.partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.0") + exponent + power

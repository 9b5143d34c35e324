"""Parameters of the controller that had other names before: bags keep the names of their time."""

from collections.abc import Mapping
from typing import Any

_FORMER = {
    "control.velocity_bandwidth": "control.smc.velocity_bandwidth",
    "control.smc_feedforward": "control.smc.feedforward",
    "control.observer.amplifier_bandwidth": "control.nominal.amplifier_bandwidth",
    "control.observer.": "control.smc_observer.",
    "control.design.": "control.smc.",
}
"""Names, and beginnings of names with a dot at their end; the first that fits counts."""

_GONE = "control.super_twisting."
"""A law that no version has any more."""
_OBSERVER = "control.smc_observer."
FORMER_OBSERVER = "smc_observer without friction"
"""The law that was called smc_observer before the present one; only it had a rho."""


def present_name(name: str) -> str:
    """What a parameter of the controller is called now."""
    for former, present in _FORMER.items():
        if name == former or (former.endswith(".") and name.startswith(former)):
            return present + name[len(former) :]
    return name


def present_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """The controller's values by their present names; the order stays.

    A law that is no longer there gets a name of its own, which no check accepts.
    """
    present = {present_name(name): value for name, value in values.items() if not name.startswith(_GONE)}
    if f"{_OBSERVER}rho" not in present:
        return present
    if present.get("control.law") == "smc_observer":
        present["control.law"] = FORMER_OBSERVER
    return {name: value for name, value in present.items() if not name.startswith(_OBSERVER)}

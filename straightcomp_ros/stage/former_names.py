"""Parameters that had other names before: bags keep the names of their time, parameter files are refused with the new.

Before there was one description of the stage, each node had its own part of it.
"""

import math
from collections.abc import Mapping
from typing import Any

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.model.motion import MotionParameters

_FORMER: Mapping[str, Mapping[str, str]] = {
    "driver": {
        "current_limit": "stage.actuator.current_limit",
        "lockstep_delay": "stage.drive.delay",
        "simulated.actuation_delay": "stage.drive.delay",
        "simulated.rate": "stage.rate",
        "simulated.plant.mass": "stage.platform.mass",
        "simulated.plant.stop": "stage.platform.stop",
        "simulated.plant.actuator.": "stage.actuator.",
        "simulated.plant.drive.": "stage.drive.",
        "simulated.plant.encoder.resolution": "stage.encoder.y_resolution",
        "simulated.plant.friction.model": "simulated.truth.contact.model",
        "simulated.plant.friction.maxwell_slip.": "simulated.truth.contact.maxwell_slip.",
        "simulated.plant.friction.bands.": "simulated.truth.contact.bands.",
        "simulated.plant.friction.rest.": "simulated.truth.contact.rest.",
        "simulated.plant.friction.step.": "simulated.truth.contact.step.",
        "simulated.plant.friction.": "stage.friction.",
        "guide.file": "simulated.truth.guide",
        "guide.": "stage.guide.",
        "can.rate": "stage.rate",
        "can.x_speed": "stage.motion.highest_speed",
        "watch.max_speed": "stage.motion.highest_speed",
    },
    "feedforward": {"map.": "stage.guide.", "feedforward.max_speed": "stage.motion.highest_speed"},
    "controller": {
        "rate": "stage.rate",
        "control.current_limit": "stage.actuator.current_limit",
        "control.velocity_bandwidth": "control.smc.velocity_bandwidth",
        "control.smc_feedforward": "control.smc.feedforward",
        "control.nominal.mass": "stage.platform.mass",
        "control.nominal.friction": "stage.friction.static",
        "control.nominal.travel": "stage.guide.travel",
        "control.nominal.amplifier_bandwidth": "stage.drive.bandwidth",
        "control.nominal.actuator.": "stage.actuator.",
        "control.observer.amplifier_bandwidth": "stage.drive.bandwidth",
        "control.observer.": "control.smc_observer.",
        "control.smc_observer.lugre.": "stage.friction.",
        "control.design.": "control.smc.",
    },
    "cell": {"motion.": "stage.motion."},
    "opcua": {"motion.": "stage.motion."},
}
"""For each node names, and beginnings of names with a dot at their end; the first that fits counts."""

_SAMPLES = ("reference_lead", "simulated.sample_memory")
"""Durations that were numbers of samples."""
_GONE = ("control.super_twisting.", "interval")
"""A law that no version has any more, and the pause between two cycles of the feedforward."""
_OBSERVER = "control.smc_observer."
FORMER_OBSERVER = "smc_observer without friction"
"""The law that was called smc_observer before the present one; only it had a rho."""


def present_name(node: str, name: str) -> str:
    """What a parameter of ``node`` is called now."""
    for former, present in _FORMER.get(node, {}).items():
        if name == former or (former.endswith(".") and name.startswith(former)):
            return present + name[len(former) :]
    return name


def present_names(node: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of ``node`` in a bag by their present names.

    A law that is no longer there gets a name of its own, which no check accepts.
    """
    kept = {name: value for name, value in values.items() if not name.startswith(_GONE) and name not in _unused(values)}
    present: dict[str, Any] = {}
    for name, value in kept.items():
        # Of two former names for one fact the first counts; a present name counts before both.
        now = present_name(node, name)
        if now == name or (now not in kept and now not in present):
            present[now] = value
    if "simulated.plant.encoder.resolution" in kept:
        present.setdefault("stage.encoder.x_resolution", kept["simulated.plant.encoder.resolution"])
    if "simulated.plant.mass" in kept:
        # It was in A/m; now it is relative to the magnets' negative stiffness I0/y0.
        present.pop("simulated.hold_stiffness", None)
    _fit_speeds(present)
    for name in _SAMPLES:
        if isinstance(present.get(name), int):
            present[name] /= present.get("stage.rate", DEFAULT_RATE)
    if f"{_OBSERVER}rho" not in present:
        return present
    if present.get("control.law") == "smc_observer":
        present["control.law"] = FORMER_OBSERVER
    return {name: value for name, value in present.items() if not name.startswith(_OBSERVER)}


def _unused(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Former names that said nothing of a run with ``values``."""
    rate = "simulated.rate" if values.get("hardware") == "can" else "can.rate"
    delay = "simulated.actuation_delay" if values.get("lockstep") else "lockstep_delay"
    # The friction of the reaching condition might contradict the other facts of friction.
    return (rate, delay, "can.x_speed", "control.nominal.friction")


def _fit_speeds(present: dict[str, Any]) -> None:
    """Where only one of the two speeds is known, choose the other so that both fit together."""
    cruise, highest, usual = "stage.motion.speed", "stage.motion.highest_speed", MotionParameters()
    if highest not in present and present.get(cruise, 0.0) > 0.5 * usual.highest_speed:
        present[highest] = 2.0 * present[cruise]
    if cruise not in present and present.get(highest, math.inf) < 2.0 * usual.speed:
        present[cruise] = 0.5 * present[highest]

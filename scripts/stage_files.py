"""Read a description of a stage, as in test/stages, and give each node the parameters that follow from it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from straightcomp_ros.offline.sweep.scenario import Scenario, make_scenario
from straightcomp_ros.offline.sweep.uncertainty import UncertaintyParameters

STAGES = Path(__file__).resolve().parent.parent / "test" / "stages"
Described = Mapping[str, Any]


def stage_names() -> list[str]:
    """The stages of test/stages, by name."""
    return sorted(path.stem for path in STAGES.glob("*.yaml"))


def read_stage(path: Path) -> Described:
    """The group ``stage`` of a file; its guide's file becomes absolute if it lies beside the file."""
    described: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))["/**"]["ros__parameters"]["stage"]
    beside = path.parent / described["guide"]["file"]
    if beside.is_file():
        described["guide"] = {**described["guide"], "file": str(beside)}
    return described


def node_values(stage: Described) -> dict[str, dict[str, Any]]:
    """Parameters by node and dotted name."""
    platform, actuator, friction = stage["platform"], dict(stage["actuator"]), stage["friction"]
    drive, encoder, file = dict(stage["drive"]), stage["encoder"], stage["guide"]["file"]
    current_limit, delay = actuator.pop("current_limit"), drive.pop("delay")
    driver = {
        "simulated.rate": stage["rate"],
        "simulated.actuation_delay": delay,
        "lockstep_delay": delay,
        "simulated.plant.encoder.resolution": encoder["y_resolution"],
        "guide.file": file,
        **_under("simulated.plant", platform),
        **_under("simulated.plant.actuator", actuator),
        **_under("simulated.plant.friction", friction),
        **_under("simulated.plant.drive", drive),
    }
    controller = {
        "rate": stage["rate"],
        "control.current_limit": current_limit,
        "control.nominal.mass": platform["mass"],
        "control.nominal.friction": friction["static"],
        "control.nominal.amplifier_bandwidth": drive["bandwidth"],
        "control.smc_observer.rest_band": 2.0 * encoder["y_resolution"],
        **_under("control.nominal.actuator", actuator),
        **_under("control.smc_observer.lugre", friction),
    }
    feedforward = {"map.file": file, "feedforward.max_speed": max(1.0, 3.0 * stage["motion"]["speed"])}
    cell = _under("motion", stage["motion"])
    return {"driver": driver, "feedforward": feedforward, "controller": controller, "cell": cell}


def uncertainty_of(stage: Described) -> UncertaintyParameters:
    """Ranges of a sweep; noise and jitter relative to the count and the period are those of the shipped stage."""
    delay = stage["drive"]["delay"]
    return UncertaintyParameters(
        **stage["uncertainty"],
        sensor_noise=0.5 * stage["encoder"]["y_resolution"],
        shortest_delay=0.2 * delay,
        longest_delay=1.5 * delay,
        jitter=0.04 / stage["rate"],
    )


def stage_scenario(name: str) -> Scenario:
    """The scenario of a stage of test/stages, for the law smc_observer."""
    stage = read_stage(STAGES / f"{name}.yaml")
    return make_scenario(node_values(stage), ["smc_observer"], uncertainty_of(stage))


def _under(group: str, values: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{group}.{name}": value for name, value in values.items()}

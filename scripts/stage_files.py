"""The stages of test/stages, as scenarios."""

from pathlib import Path
from typing import Any

from straightcomp_ros.offline.scenario import Scenario, make_scenario
from straightcomp_ros.parameters.parameter_file import shipped_parameters

STAGES = Path(__file__).resolve().parent.parent / "test" / "stages"


def stage_names() -> list[str]:
    """The stages of test/stages, by name."""
    return sorted(path.stem for path in STAGES.glob("*.yaml"))


def stage_values(name: str) -> dict[str, dict[str, Any]]:
    """The values of that stage file alone, by node and dotted name: it is the parameter file too."""
    path = str(STAGES / f"{name}.yaml")
    return shipped_parameters(path, path)


def stage_scenario(name: str, law: str = "smc_observer", delay: float | None = None) -> Scenario:
    """The scenario of a stage of test/stages, with commands ``delay`` samples late in place of the described."""
    values = stage_values(name)
    if delay is not None:
        values["stage"]["drive.delay"] = delay
    return make_scenario(values, [law])

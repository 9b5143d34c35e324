"""The stages of test/stages, as scenarios."""

from pathlib import Path

from straightcomp_ros.offline.scenario import Scenario, make_scenario
from straightcomp_ros.parameters.parameter_file import read_stage_file

STAGES = Path(__file__).resolve().parent.parent / "test" / "stages"


def stage_names() -> list[str]:
    """The stages of test/stages, by name."""
    return sorted(path.stem for path in STAGES.glob("*.yaml"))


def stage_scenario(name: str, law: str = "smc_observer") -> Scenario:
    """The scenario of a stage of test/stages."""
    return make_scenario(read_stage_file(STAGES / f"{name}.yaml"), [law])

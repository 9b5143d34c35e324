import pytest

from straightcomp_ros.offline.scenario import Scenario, make_scenario


@pytest.fixture
def values() -> dict[str, dict]:
    """A short cycle: 30 mm forward and back in 1.8 s."""
    return {
        "driver": {},
        "controller": {},
        "stage": {"motion.stroke": 0.03, "motion.settle": 0.1, "motion.pause": 0.1},
    }


@pytest.fixture
def scenario(values: dict[str, dict]) -> Scenario:
    """Two laws on the short cycle, with the default uncertainty."""
    return make_scenario(values, ["linear", "smc"])

"""Parameters of a law that are not searched, since they follow from the stage.

- First size of friction: the smallest that the uncertainty allows. Too much friction in the law makes limit cycles, too
  little leaves an error at the first reversals, until the fit has seen one: the more friction, the larger the error.
- Memory of the fit: many reversals of the reference. Before the first reversal friction and a constant force look
  the same; a shorter memory lets the fit drift there.
"""

import numpy as np

from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.straightness.guide_map import StraightnessMap

_BELOW = 0.9
_REVERSALS = 75.0
"""10 s on the shipped stage; with 2 s the errors at the first reversals were up to six times as large."""
_MEMORY = (2.0, 100.0)
_POINTS = 5000


def following(scenario: Scenario, law: str) -> dict[str, float]:
    """The parameters of ``law`` that follow from the stage, by dotted name from ``control.`` on."""
    if law != "smc_observer":
        return {}
    least, most = _MEMORY
    stage = scenario.description
    return {
        "control.smc_observer.first_size": min(1.0, max(0.1, _BELOW / stage.uncertainty.friction)),
        "control.smc_observer.memory": min(most, max(least, _REVERSALS * _between_reversals(scenario))),
    }


def _between_reversals(scenario: Scenario) -> float:
    """Mean time in s between reversals of r while the stage moves, counting the turn of the stage."""
    times = np.linspace(0.0, scenario.trajectory.end_ns, _POINTS)
    x = scenario.positions(times.astype(np.int64))
    moving = np.flatnonzero(np.diff(x) != 0.0)
    straightness = StraightnessMap(scenario.survey, scenario.description.guide)
    direction = np.sign(np.diff(straightness.evaluate(x)[0])[moving])
    reversals = int(np.count_nonzero(np.diff(direction[direction != 0.0])))
    return float(moving.size * (times[1] - times[0]) * 1e-9 / max(1, reversals))

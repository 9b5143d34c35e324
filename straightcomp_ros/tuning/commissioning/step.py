"""What a step of commissioning takes and gives."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.tuning.commissioning.machine import Machine

_TRAVEL = 3e-4
_TRAVEL_SHARE = 0.35
"""Of the way to the mechanical stop."""


@dataclass(frozen=True)
class Outcome:
    """The result of a step.

    Attributes:
        passed: whether commissioning may go on.
        sentence: what was found, and where it did not pass, what would help.
        figures: by name with unit; plain numbers, texts, lists and mappings.
        stage: facts of the description as found, by dotted name.
        gains: of the law from here on, by dotted name in the node controller.
    """

    passed: bool
    sentence: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    stage: Mapping[str, Any] = field(default_factory=dict)
    gains: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Work:
    """What a step works on.

    Attributes:
        values: parameters by node and dotted name, with what the steps before found.
        description: the stage as first described, with its uncertainty.
        folder: for bags and other files.
        evaluations: candidates of the search for gains.
        machines: uncertain machines of its verification.
        outcomes: of the steps that are done, by name.
        learning_strokes: cycles in which the law's reference is corrected before the acceptance; 0 for none.
        check_survey: an independent measurement of the guide, by which the map is checked; None without one.
        progress: called with the fraction of the step that is done.
    """

    machine: Machine
    values: Mapping[str, Mapping[str, Any]]
    description: StageParameters
    folder: Path
    evaluations: int
    machines: int
    outcomes: Mapping[str, Outcome]
    learning_strokes: int = 0
    check_survey: Survey | None = None
    progress: Callable[[float], None] = lambda fraction: None

    @property
    def stage(self) -> StageParameters:
        """The stage as known so far."""
        stage: StageParameters = node_parameters("controller", self.values).stage
        return stage

    @property
    def travel(self) -> float:
        """How far the platform may be from its reference under any law, m."""
        return min(_TRAVEL, _TRAVEL_SHARE * self.stage.platform.stop)

    def described(self) -> dict[str, Mapping[str, Any]]:
        """The parameters of a simulated machine that is as the stage is known so far, without a truth of its own."""
        own = {
            name: value
            for name, value in self.values.get("driver", {}).items()
            if not name.startswith(("simulated.truth.", "stage."))
        }
        return {**self.values, "driver": own}

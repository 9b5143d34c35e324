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
    """The result of a step."""

    passed: bool  # whether commissioning may go on
    sentence: str  # what was found, and where it did not pass, what would help
    figures: Mapping[str, Any] = field(default_factory=dict)  # by name with unit; plain numbers, texts, lists, mappings
    stage: Mapping[str, Any] = field(default_factory=dict)  # facts of the description as found, by dotted name
    gains: Mapping[str, Any] = field(default_factory=dict)  # of the law from here on, by dotted name in the controller


@dataclass(frozen=True)
class Work:
    """What a step works on."""

    machine: Machine
    values: Mapping[str, Mapping[str, Any]]  # by node and dotted name, with what the steps before found
    description: StageParameters  # the stage as first described, with its uncertainty
    folder: Path  # for bags and other files
    evaluations: int  # candidates of the search for gains
    machines: int  # uncertain machines of its verification
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)  # of the steps that are done, by name
    learning_strokes: int = 0  # cycles in which the law's reference is corrected before the acceptance
    check_survey: Survey | None = None  # an independent measurement of the guide, by which the map is checked
    require: float | None = None  # largest straightness after compensation in µm, with its uncertainty
    progress: Callable[[float], None] = lambda fraction: None  # called with the fraction of the step that is done

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

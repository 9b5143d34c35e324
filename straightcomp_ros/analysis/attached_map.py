"""The map that a recorded run used, from the survey that its bag has attached."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.recorded_parameters import unpacked_map
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import SurveyError


def attached_map(
    attachments: Mapping[str, bytes], parameters: Mapping[str, Mapping[str, Any]]
) -> StraightnessMap | None:
    """The map; None where no survey is attached, or one that makes no map by the recorded parameters.

    Args:
        attachments: of the bag, by name.
        parameters: of the recorded nodes, by node and dotted name.
    """
    section = parameters.get("feedforward", {})
    own = {
        name.removeprefix("stage.guide."): value for name, value in section.items() if name.startswith("stage.guide.")
    }
    with tempfile.TemporaryDirectory() as folder:
        survey = unpacked_map(attachments, Path(folder))
        if survey is None:
            return None
        try:
            return load_map(from_mapping(MapParameters, {**own, "file": str(survey)}))
        except (ParameterError, SurveyError):
            return None

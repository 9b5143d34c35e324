"""What no stage can be."""

import pytest

from straightcomp_ros.model.plant import PlatformParameters
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters


def test_a_stop_outside_the_air_gap_is_refused():
    with pytest.raises(ParameterError, match=r"stop.*0\.002 m.*< 0\.0015"):
        StageParameters(platform=PlatformParameters(stop=2e-3))


def test_the_identity_tells_machines_apart_and_not_their_strokes():
    shipped = StageParameters()
    assert shipped.identity == StageParameters().identity
    assert shipped.identity.startswith("synthetic ")
    assert from_mapping(StageParameters, {"platform.mass": 3.01}).identity != shipped.identity
    assert from_mapping(StageParameters, {"name": "gantry"}).identity.startswith("gantry ")
    assert from_mapping(StageParameters, {"motion.stroke": 0.2}).identity == shipped.identity

"""What no stage can be."""

import pytest

from straightcomp_ros.model.plant import PlatformParameters
from straightcomp_ros.settings.declaration import ParameterError
from straightcomp_ros.stage.description import StageParameters


def test_a_stop_outside_the_air_gap_is_refused():
    with pytest.raises(ParameterError, match=r"stop.*0\.002 m.*< 0\.0015"):
        StageParameters(platform=PlatformParameters(stop=2e-3))

"""Surveys and guides that several tests share."""

from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.survey import Run, Survey

GUIDE = load_map(MapParameters(file="config/guide_synthetic.csv"))
"""That of the simulated machine."""


def one_run(x, deviation):
    """A survey of one run, forward."""
    return Survey((Run("1", "forward", x, deviation),))

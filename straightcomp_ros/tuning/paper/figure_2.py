"""Fig. 2: survey of the guide's straightness."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLACK, BLUE, VERMILION
from straightcomp_ros.straightness.guide_map import StraightnessMap, find_survey
from straightcomp_ros.straightness.residual import least_squares_residual, peak_to_peak
from straightcomp_ros.straightness.survey import Survey, read_survey
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.drawing import label, legend_above, sheet
from straightcomp_ros.tuning.paper.ideal_machine import Machine

TITLE = "Fig. 2: straightness of the guide, as surveyed"
PAPER_PP_UM = 22.4
_POINTS = 2001


@dataclass(frozen=True, eq=False)
class SurveyedGuide:
    """The survey, and the map through it: x, deviation and its residual, each (n,) in m."""

    survey: Survey
    x: NDArray[np.float64]
    deviation: NDArray[np.float64]
    residual: NDArray[np.float64]
    claims: tuple[Claim, ...]


def compute(machine: Machine) -> SurveyedGuide:
    """Read the survey of the feedforward, and judge the guide by ISO 230-1.

    Raises:
        SurveyError: the survey is refused.
    """
    chosen = machine.stage.guide
    survey = read_survey(find_survey(chosen.file), min_points=chosen.min_points, max_gap=chosen.max_gap)
    straightness = StraightnessMap(survey, chosen)
    x = np.linspace(*straightness.span, _POINTS)
    deviation = straightness.deviations(x)
    residual = least_squares_residual(x, deviation)
    claim = Claim(
        "Fig. 2: straightness of the guide, p-p",
        PAPER_PP_UM,
        peak_to_peak(residual) * 1e6,
        "µm",
        tolerance=0.05,
        note="no independent result: the survey is synthetic, scaled to the paper's figure",
    )
    return SurveyedGuide(survey, x, deviation, residual, (claim,))


def draw(data: SurveyedGuide) -> Figure:
    """All points of the survey with the map through their mean; below, the scatter of the runs about it."""
    figure, (above, below) = sheet(TITLE, rows=2, size=(8.0, 6.5))
    x_mm = data.x * 1e3
    text = f"mean (map), {peak_to_peak(data.residual) * 1e6:.1f} µm p-p beside its least squares line"
    above.plot(x_mm, data.deviation * 1e6, color=BLACK, linewidth=1.0, zorder=3, label=text)
    for direction, colour, marker in (("forward", BLUE, "^"), ("backward", VERMILION, "v")):
        for number, run in enumerate(data.survey.runs):
            if run.direction != direction:
                continue
            name = f"{direction} runs" if run is data.survey.in_direction(run.direction)[0] else None
            at_mm = run.x * 1e3 + 0.8 * number  # side by side, where they would hide each other
            above.plot(run.x * 1e3, run.deviation * 1e6, marker, color=colour, markersize=2.5, label=name)
            scatter = (run.deviation - np.interp(run.x, data.x, data.deviation)) * 1e9
            below.plot(at_mm, scatter, marker, color=colour, markersize=2.5, label=name)
    label(above, "Deviation of the guide", "slider position x / mm", "deviation δ / µm")
    label(below, "Runs beside the map", "slider position x / mm", "run − map / nm")
    for axes in (above, below):
        legend_above(axes, columns=3)
        axes.margins(x=0.01)
    return figure

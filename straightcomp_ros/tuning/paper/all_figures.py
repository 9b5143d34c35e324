"""Computes and draws all figures, and gathers their claims."""

from collections.abc import Callable, Mapping
from pathlib import Path

from straightcomp_ros.analysis.pictures import save_whole
from straightcomp_ros.tuning.paper.figure import Claim, PaperFigure
from straightcomp_ros.tuning.paper.friction import friction_curve, stick_slip
from straightcomp_ros.tuning.paper.gain_error import far_release, gain_error
from straightcomp_ros.tuning.paper.machine import Machine
from straightcomp_ros.tuning.paper.recovery import recovery
from straightcomp_ros.tuning.paper.stroke import linear_stroke, sliding_mode_stroke, surveyed_guide
from straightcomp_ros.tuning.paper.surface import near_release, pole_claims

FIGURES: Mapping[str, Callable[[Machine], PaperFigure]] = {
    "figure_2.png": surveyed_guide,
    "figure_3.png": gain_error,
    "figure_4.png": far_release,
    "beyond_figure_4.png": recovery,
    "figure_5.png": near_release,
    "figure_6.png": stick_slip,
    "figure_7.png": friction_curve,
    "figure_8.png": linear_stroke,
    "figure_9.png": sliding_mode_stroke,
}
"""By the name of its picture, what computes a figure."""


def reproduce(machine: Machine, folder: Path, progress: Callable[[float], None]) -> list[Claim]:
    """Compute every figure, write its picture to ``folder``, and gather the claims in the order of the figures.

    ``progress`` is called with the fraction that is done.

    Raises:
        SurveyError: the machine's survey is refused.
        OSError: the folder cannot be written.
    """
    claims = list(pole_claims(machine))
    for number, (name, compute) in enumerate(FIGURES.items()):
        progress(number / len(FIGURES))
        figure = compute(machine)
        save_whole(figure.picture, folder / name)
        claims += figure.claims
    progress(1.0)
    return claims

"""Computes and draws all figures, and gathers their claims."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from straightcomp_ros.analysis.pictures import save_whole
from straightcomp_ros.tuning.paper import (
    beyond_figure_4,
    figure_2,
    figure_3,
    figure_4,
    figure_5,
    figure_6,
    figure_7,
    figure_8,
    figure_9,
    poles,
)
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.ideal_machine import Machine

FIGURES = (figure_2, figure_3, figure_4, beyond_figure_4, figure_5, figure_6, figure_7, figure_8, figure_9)
"""Modules of the figures; each has compute(machine), with the claims in its answer, and draw(answer)."""
PICTURES = tuple(f"{module.__name__.rpartition('.')[2]}.png" for module in FIGURES)
"""Names of their files."""


@dataclass(frozen=True)
class Reproduction:
    """All claims in the order of the figures, and the pictures."""

    claims: tuple[Claim, ...]
    figures: tuple[Path, ...]


def reproduce(
    machine: Machine, folder: Path, progress: Callable[[float], None] = lambda fraction: None
) -> Reproduction:
    """Compute every figure, write it to ``folder`` under its module's name, and gather the claims.

    Args:
        machine: what the figures are computed with.
        folder: made if it is not there; pictures of the same names are replaced.
        progress: called with the fraction that is done.

    Raises:
        ParameterError, SurveyError: the machine's parameters are refused.
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    claims, paths = list(poles.claims(machine)), []
    for number, (module, name) in enumerate(zip(FIGURES, PICTURES, strict=True)):
        progress(number / len(FIGURES))
        data = module.compute(machine)
        path = folder / name
        save_whole(module.draw(data), path)
        claims += data.claims
        paths.append(path)
    progress(1.0)
    return Reproduction(tuple(claims), tuple(paths))

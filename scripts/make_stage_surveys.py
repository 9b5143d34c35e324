"""Make the surveys of the stages in test/stages.

From the top of the repository:

    python -m scripts.make_stage_surveys

Each guide is a bow with waves, and in one case a joint of two rails, scaled to the extent that its stage names. Every
run gives the same bytes.
"""

import random
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scripts.stage_files import STAGES
from straightcomp_ros.straightness.residual import least_squares_residual, peak_to_peak
from straightcomp_ros.straightness.survey import Run, Survey, write_survey


class Joint(NamedTuple):
    """Place in m of a joint of two rails, the step between them in m, and the length in m over which it is worn."""

    x: float
    step: float
    length: float


class Guide(NamedTuple):
    """One guide: length, extent peak to peak, distance of the survey's points, repeatability, in m; waves; joints."""

    length: float
    extent: float
    spacing: float
    repeatability: float
    waves: Sequence[tuple[float, float, float]]
    joints: Sequence[Joint] = ()


GUIDES = {
    # Waves: length in m, amplitude relative to the bow, phase in waves.
    "ground_300_mm": Guide(
        0.3, 2e-6, 0.005, 2e-9, ((0.7, 1.0, 0.3), (0.19, 0.25, 0.1), (0.07, 0.08, 0.6), (0.035, 0.02, 0.0))
    ),
    "gantry_3_m": Guide(
        3.0,
        80e-6,
        0.02,
        50e-9,
        ((5.5, 1.0, 0.8), (1.3, 0.3, 0.2), (0.6, 0.12, 0.7), (0.24, 0.05, 0.4), (0.12, 0.008, 0.0)),
    ),
    "slow_500_mm": Guide(
        0.5, 8e-6, 0.005, 10e-9, ((1.1, 1.0, 0.1), (0.3, 0.3, 0.5), (0.12, 0.12, 0.9), (0.04, 0.02, 0.3))
    ),
    "joint_1_m": Guide(
        1.0,
        15e-6,
        0.002,
        5e-9,
        ((2.1, 1.0, 0.4), (0.5, 0.25, 0.0), (0.2, 0.06, 0.3), (0.06, 0.01, 0.0)),
        (Joint(0.62, 4e-6, 0.006),),
    ),
}


def shape(guide: Guide) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x (n,) and deviation (n,) of a guide in m, least squares line removed, rounded to 1 nm."""
    x = np.linspace(0.0, guide.length, round(guide.length / guide.spacing) + 1)
    waves = sum(amplitude * np.sin(2.0 * np.pi * (x / length + phase)) for length, amplitude, phase in guide.waves)
    # The line goes first: scaled after, the extent is that of ISO 230-1.
    residual = least_squares_residual(x, waves)
    residual *= guide.extent / peak_to_peak(residual)
    for joint in guide.joints:
        residual += 0.5 * joint.step * np.tanh((x - joint.x) / (0.5 * joint.length))
    return x, np.round(residual, 9)


def survey(guide: Guide, seed: int, cycles: int = 1, every: int = 1) -> Survey:
    """``cycles`` runs forward and backward in turn, over each ``every``-th point of the guide."""
    x, deviation = (values[::every] for values in shape(guide))
    # Python's generator and the quantile function: NumPy's normals may change with a release.
    generator, normal = random.Random(seed), NormalDist(0.0, guide.repeatability)
    return Survey(
        tuple(
            Run(str(cycle), direction, x, deviation + [normal.inv_cdf(generator.random()) for _ in x])
            for cycle in range(1, cycles + 1)
            for direction in ("forward", "backward")
        )
    )


def make(directory: Path = STAGES) -> None:
    """Write a survey for each guide into ``directory``."""
    for seed, (name, guide) in enumerate(GUIDES.items(), 1):
        heads = [
            "Synthetic, not measured: made by scripts/make_stage_surveys.py.",
            f"{guide.extent * 1e6:g} um peak to peak over {guide.length:g} m, each point with a standard deviation of "
            f"{guide.repeatability * 1e9:g} nm.",
        ]
        # The files were once made of values in 0.1 nm: without that some would round to another nm.
        runs = (replace(run, deviation=np.round(run.deviation, 10)) for run in survey(guide, seed).runs)
        write_survey(directory / f"{name}.csv", Survey(tuple(runs)), heads)


if __name__ == "__main__":
    make()

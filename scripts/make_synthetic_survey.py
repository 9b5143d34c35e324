"""Make the synthetic guide and its survey: config/guide_synthetic.csv and config/survey_synthetic.csv.

From the top of the repository:

    python -m scripts.make_synthetic_survey

The guide has the features of the paper's Fig. 2: 1760 mm, 22.4 µm peak to peak beside its least
squares line, a long-wave bow with medium waves and a small ripple at the pitch of the rail's bolts.
The survey is the guide every 10 mm, three times forward and three times backward, with the
repeatability of a good laser interferometer; there is no hysteresis. Every run gives the same bytes.
"""

import random
from pathlib import Path
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.contract import STROKE
from straightcomp_ros.straightness.residual import least_squares_residual, peak_to_peak
from straightcomp_ros.straightness.survey import Run, Survey, write_survey

PEAK_TO_PEAK = 22.4e-6
REPEATABILITY = 0.025e-6
SEED = 1760
GUIDE_POINTS = 353  # every 5 mm
SURVEY_EVERY = 2  # guide points: every 10 mm
# Slopes of 0.04 to 0.09 µm/mm are typical with these, 0.12 the largest. Both ends lie near the line, so that the
# extent is the same within 0.002 µm whether the line is fitted to the points or to the length.
WAVES = (
    # wavelength m, amplitude relative to the bow, phase in waves
    (3.34, 1.0, 0.86),
    (0.81, 0.373, 0.15),
    (0.43, 0.156, 0.89),
    (0.21, 0.063, 0.79),
    (0.06, 0.014, 0.0),  # bolts of the rail
)


def guide() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x (353,) and deviation (353,) in m, least squares line removed, rounded to 1 nm."""
    x = np.linspace(0.0, STROKE, GUIDE_POINTS)
    shape = sum(amplitude * np.sin(2.0 * np.pi * (x / wavelength + phase)) for wavelength, amplitude, phase in WAVES)
    residual = least_squares_residual(x, shape)
    # The line goes first: scaled after, the extent is that of ISO 230-1.
    return x, np.round(residual * (PEAK_TO_PEAK / peak_to_peak(residual)), 9)


def survey() -> Survey:
    """Six runs over the guide, forward and backward in turn."""
    x, deviation = guide()
    # Python's generator and the quantile function, not NumPy's normals, whose stream may change with a release.
    generator, normal = random.Random(SEED), NormalDist(0.0, REPEATABILITY)
    runs = []
    for cycle in ("1", "2", "3"):
        for direction in ("forward", "backward"):
            noise = [normal.inv_cdf(generator.random()) for _ in x[::SURVEY_EVERY]]
            runs.append(Run(cycle, direction, x[::SURVEY_EVERY], deviation[::SURVEY_EVERY] + noise))
    return Survey(tuple(runs))


def make(directory: Path) -> None:
    """Write both files into ``directory``."""
    by = "Synthetic, not measured: made by scripts/make_synthetic_survey.py."
    write_survey(
        directory / "survey_synthetic.csv",
        survey(),
        [
            by,
            "Survey of the guide in guide_synthetic.csv: three cycles forward and backward, every 10 mm,",
            f"each point with a standard deviation of {REPEATABILITY * 1e6:g} um, no hysteresis.",
        ],
    )
    write_survey(
        directory / "guide_synthetic.csv",
        Survey((Run("1", "forward", *guide()),)),
        [
            by,
            "The guide itself, free of noise, every 5 mm: the truth of the simulation.",
            f"{PEAK_TO_PEAK * 1e6:g} um peak to peak, least squares line removed.",
        ],
    )


if __name__ == "__main__":
    make(Path(__file__).resolve().parent.parent / "config")

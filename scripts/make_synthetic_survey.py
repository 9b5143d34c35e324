"""Make the synthetic guide and its survey: config/guide_synthetic.csv and config/survey_synthetic.csv.

From the top of the repository:

    python -m scripts.make_synthetic_survey

The guide has the features of the paper's Fig. 2: 1760 mm, 22.4 µm peak to peak about its least
squares line, a long-wave bow with medium waves and a small ripple at the pitch of the rail's bolts.
The survey is the guide every 10 mm, three times forward and three times backward, with the
repeatability of a good laser interferometer; there is no hysteresis. Every run gives the same bytes.
"""

from pathlib import Path

from scripts.make_stage_surveys import Guide, shape, survey
from straightcomp_ros.contract import STROKE
from straightcomp_ros.straightness.survey import Run, Survey, write_survey

SEED = 1760
GUIDE = Guide(
    STROKE,
    22.4e-6,
    0.005,
    0.025e-6,
    # Slopes of 0.04 to 0.09 µm/mm are typical with these, 0.12 the largest. Both ends lie near the line, so that the
    # extent is the same within 0.002 µm whether the line is fitted to the points or to the length. The last: bolts.
    ((3.34, 1.0, 0.86), (0.81, 0.373, 0.15), (0.43, 0.156, 0.89), (0.21, 0.063, 0.79), (0.06, 0.014, 0.0)),
)


def make(directory: Path) -> None:
    """Write both files into ``directory``."""
    by = "Synthetic, not measured: made by scripts/make_synthetic_survey.py."
    write_survey(
        directory / "survey_synthetic.csv",
        survey(GUIDE, SEED, cycles=3, every=2),
        [
            by,
            "Survey of the guide in guide_synthetic.csv: three cycles forward and backward, every 10 mm,",
            f"each point with a standard deviation of {GUIDE.repeatability * 1e6:g} um, no hysteresis.",
        ],
    )
    write_survey(
        directory / "guide_synthetic.csv",
        Survey((Run("1", "forward", *shape(GUIDE)),)),
        [
            by,
            "The guide itself, free of noise, every 5 mm: the truth of the simulation.",
            f"{GUIDE.extent * 1e6:g} um peak to peak, least squares line removed.",
        ],
    )


if __name__ == "__main__":
    make(Path(__file__).resolve().parent.parent / "config")

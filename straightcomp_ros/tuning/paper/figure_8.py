"""Fig. 8: error of the compensated stroke under linear control."""

import dataclasses

from matplotlib.figure import Figure

from straightcomp_ros.offline.published import PEAK_TO_PEAK_UM, TOLERANCE
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.paper_stroke import (
    CompensatedStroke,
    draw_stroke,
    lag_share,
    run_stroke,
    stroke_claim,
)

TITLE = "Fig. 8: compensated stroke, linear control"
PAPER_PP_UM = PEAK_TO_PEAK_UM["linear"]


def compute(machine: Machine) -> CompensatedStroke:
    """Run the stroke under (9) without its switching term."""
    stroke = run_stroke(machine, "linear")
    claims = (
        stroke_claim(
            "Fig. 8: error under linear control, p-p",
            PAPER_PP_UM,
            (figures.pp * 1e6 for figures in stroke.starts),
            "µm",
            tolerance=TOLERANCE * PAPER_PP_UM,
            note="true error; the paper prints no plant: friction, delay and amplifier are ours",
        ),
        Claim(
            "Fig. 8: of that the lag 2ζ/ωn behind r(t), p-p",
            None,
            lag_share(stroke, machine.control.smc) * 1e6,
            "µm",
            note="2ζ/ωn times ṙ over the stroke, whatever the plant; it would go with ṙ and r̈ fed forward",
        ),
    )
    return dataclasses.replace(stroke, claims=claims)


def draw(data: CompensatedStroke) -> Figure:
    """The error over x and over time."""
    return draw_stroke(data, TITLE)

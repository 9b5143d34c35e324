"""Evaluate a recorded run: its verdict, its figures, the error of each stroke, and where the largest error is.

python examples/evaluate_bag.py bags/smc
"""

import sys
from pathlib import Path

import numpy as np

from straightcomp_ros.analysis.assessment import Assessment
from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.bags import BagError


def main(bag: str) -> int:
    try:
        assessment = Assessment(Path(bag), evaluate_bag(Path(bag)))
    except (BagError, MetricsError) as error:
        print(error, file=sys.stderr)
        return 2
    print(f"verdict: {assessment.verdict}")

    # By the names of `straightcomp evaluate --json`: limits can be set for them.
    figures = assessment.figures()
    for name in ("encoder_pp_um", "encoder_rms_um", "uncompensated_pp_um", "residual_pp_um", "lost_samples"):
        print(f"{name}: {figures[name]:.6g}")
    for stroke in assessment.strokes:
        print(f"{stroke.direction} stroke at {stroke.start:.2f} s: {stroke.encoder_pp * 1e6:.3f} µm p-p")

    # The record has the streams as NumPy arrays, in s, m and A, one number for each sample.
    moving = assessment.record.moving
    error = moving.r - moving.y
    worst = int(np.argmax(np.abs(error)))
    print(f"largest error: {error[worst] * 1e6:+.3f} µm at x = {moving.x[worst] * 1e3:.1f} mm")
    return 0 if assessment.verdict.in_order else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) if len(sys.argv) == 2 else __doc__)

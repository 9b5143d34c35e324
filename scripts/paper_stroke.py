"""One cycle of the paper's machine on the shipped survey, for scripts/fit_paper_plant.py."""

import math
from typing import Any

import numpy as np

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.control.law import Law
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.model.plant import PlantParameters, plant_state
from straightcomp_ros.offline.scenario import run_cycle
from straightcomp_ros.offline.starts import Spread, offsets, spread
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import Feedforward
from straightcomp_ros.straightness.guide_map import load_map

STAGE = StageParameters()
"""The shipped stage."""


class Stroke:
    """A stroke forward and back, on the shipped survey or on a guide of the same height shaped as a cosine.

    Args:
        half_waves: half waves of the cosine along the stroke; None takes the survey.

    Attributes:
        rate: largest |ṙ| in m/s.
    """

    def __init__(self, half_waves: int | None = None) -> None:
        trajectory, period_ns = Trajectory(forward_and_back(STAGE.motion)), STAGE.period_ns
        self._stamps = np.arange(-(-trajectory.end_ns // period_ns)) * period_ns
        true_x = np.array([trajectory.position(stamp) for stamp in self._stamps.tolist()])
        count = STAGE.encoder.x_resolution
        x = np.floor(true_x / count + 0.5) * count
        guide = load_map()
        if half_waves is None:
            feedforward = Feedforward(guide)
            reference = np.array(
                [feedforward.step(*sample) for sample in zip(self._stamps.tolist(), x.tolist(), strict=True)]
            )
            self._true_r = guide.evaluate(true_x)[0]
        else:
            stroke = STAGE.motion.stroke
            wave = half_waves * math.pi / stroke
            height = 0.5 * float(np.ptp(guide.evaluate(np.linspace(0.0, stroke, 20_000))[0]))
            r = height * np.cos(wave * x)
            reference = np.stack([r, np.gradient(r, STAGE.period), np.zeros_like(r)], axis=1)
            self._true_r = height * np.cos(wave * true_x)
        rest = np.zeros_like(x)
        record = StrokeRecord(time=self._stamps * 1e-9, x=x, y=rest, r=rest, current=rest, law="")
        self._window = record.motion.window
        self._reference = reference
        self.rate = float(np.abs(reference[self._window, 1]).max())

    def error(self, plant: PlantParameters, law: Law, *, delay: float = 0.5, start: float = 0.0) -> float:
        """True peak to peak error in µm.

        Args:
            plant: the machine.
            law: the control law.
            delay: of the command, in samples.
            start: where the platform stands at the start, m.
        """
        late = np.full(self._stamps.size, round(delay * STAGE.period_ns))
        true_y = run_cycle(law, plant, self._stamps, late, self._reference, initial=plant_state(y=start)).true_y
        return float(np.ptp((self._true_r - true_y)[self._window])) * 1e6

    def errors(self, *arguments: Any, **options: Any) -> Spread:
        """:meth:`error` in µm over the starts."""
        return spread(self.error(*arguments, start=start, **options) for start in offsets())

"""Strokes for a design: what does not depend on the gains is computed once, then each run takes a tenth of a second."""

import dataclasses
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.error_detail import sustained_oscillation, tolerated_amplitude
from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.control.law import Law
from straightcomp_ros.model.motion import Trajectory, forward_and_back, reach
from straightcomp_ros.model.plant import Hold, PlantParameters, PlantState
from straightcomp_ros.offline.kernel import Conditions, run_cycle
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.offline.starts import offset
from straightcomp_ros.straightness.feedforward import along
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import Survey

_PITCH = 1.3
"""Distance of neighbouring starts in counts of the encoder: not a whole number, so each lies elsewhere in a count."""
_RESTING = 0.2
"""s after a stroke from which the command at rest is judged."""


class RunFigures(NamedTuple):
    """One run; all are infinite if it broke off."""

    pp: float  # true compensation error over the motion, m
    rms: float
    work: float  # RMS step of the commanded current from sample to sample over the motion, A
    rest_work: float  # the same between the strokes
    oscillation: float  # amplitude of the strongest held line in the error, relative to what a verdict tolerates
    excursion: float  # largest |y|, m


@dataclass(frozen=True, eq=False)
class PreparedStroke:
    """One motion of the stage, ready to run under any law."""

    stamps: NDArray[np.int64]  # of the samples, ns
    x: NDArray[np.float64]  # (n,) true position of the stage, m
    given: NDArray[np.float64]  # (n, 3) references as the law is given them, m, m/s, m/s²
    target: NDArray[np.float64]  # (n,) r at the true x, m
    motion: slice  # samples of the motion
    rest: slice  # samples between the strokes, empty without
    plant: PlantParameters
    hold: Hold
    initial_y: float  # m

    def run(self, law: Law, delay: float, start: int = 0, plant: PlantParameters | None = None) -> RunFigures:
        """Run the motion once under ``law``, on the stroke's own machine or on ``plant``.

        Each command is ``delay`` s late; ``start`` counts as in :func:`~straightcomp_ros.offline.starts.offset`.
        """
        late, count = np.full(self.stamps.size, round(delay * 1e9)), self.plant.encoder.y_resolution
        conditions = Conditions(self.stamps, late, self.given, np.zeros(self.stamps.size), self.x)
        # The stroke's own count, so that an ideal encoder gets the same starts.
        initial = PlantState(y=self.initial_y + offset(start, _PITCH * count))
        cycle = run_cycle(law, plant or self.plant, conditions, initial, self.hold)
        if cycle.current.size < self.stamps.size:
            return RunFigures(*(math.inf,) * 6)
        target = self.target[self.motion]
        error = target - cycle.true_y[self.motion]
        period = float(self.stamps[-1] - self.stamps[0]) * 1e-9 / (self.stamps.size - 1)
        amplitude = sustained_oscillation(error, target, period).amplitude
        return RunFigures(
            pp=peak_to_peak(error),
            rms=_rms(error),
            work=_rms(np.diff(cycle.current[self.motion])),
            rest_work=_rms(np.diff(cycle.current[self.rest])),
            oscillation=amplitude / tolerated_amplitude(error, count, peak_to_peak(target)),
            excursion=float(np.abs(cycle.true_y).max()),
        )


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values * values))) if values.size else 0.0


def prepared_stroke(
    scenario: Scenario,
    trajectory: Trajectory | None = None,
    stamps: NDArray[np.int64] | None = None,
    ideal: bool = False,
    survey: Survey | None = None,
) -> PreparedStroke:
    """A stroke of a stage, along ``trajectory`` in place of the scenario's.

    Args:
        stamps: (n,) of the samples in ns from 0, if they are not on the grid.
        ideal: the law is given r, ṙ and r̈ of the true motion at each sample, without the encoder of x, the filter and
            the lead.
        survey: of the map that the law is given, in place of the scenario's, by which it is judged.
    """
    moved = dataclasses.replace(scenario, trajectory=trajectory or scenario.trajectory)
    stroke = moved.stroke(stamps)
    r, slope, curvature = along(stroke.map, stroke.true_x)
    time, x, given = np.asarray(stroke.stamps * 1e-9, dtype=np.float64), stroke.x, stroke.given
    if ideal:
        x = stroke.true_x
        speed = np.gradient(x, time)
        given = np.column_stack([r, slope * speed, curvature * speed * speed + slope * np.gradient(speed, time)])
    if survey is not None:
        given = moved.stroke(stamps, survey).given
    motion = motion_of(time, x)
    rest = slice(0, 0)
    if len(motion.strokes) > 1:
        begin = motion.strokes[0].stop + math.ceil(_RESTING * 1e9 / scenario.period_ns)
        rest = slice(begin, max(begin, motion.strokes[1].start))
    driver = scenario.driver
    return PreparedStroke(
        stroke.stamps,
        stroke.true_x,
        given,
        r,
        motion.window,
        rest,
        driver.plant,
        driver.hold,
        driver.simulated.initial_y,
    )


def shortened(scenario: Scenario, duration: float) -> Trajectory:
    """A motion of at most about ``duration`` s over the steepest part of the map, with the stage's speed if it fits."""
    full = scenario.description.motion
    settle, pause = min(full.settle, 0.3), min(max(full.pause, 0.0), 0.5)
    moving = 0.5 * (duration - 2.0 * settle - pause)
    ramp = full.speed / full.acceleration
    length = full.speed * (moving - ramp) if moving > 2.0 * ramp else full.acceleration * (0.5 * moving) ** 2
    low, high = reach(full)
    if length >= high - low or scenario.trajectory.end_ns * 1e-9 <= duration:
        return scenario.trajectory
    straightness = StraightnessMap(scenario.survey, scenario.description.guide)
    x = np.linspace(low, high, 2000)
    slope, curvature = straightness.evaluate(x)[1:]
    # Reversals of r make friction turn over, slopes make it large: where there is most of both.
    wanted = np.abs(slope) / np.abs(slope).max() + np.abs(curvature) / np.abs(curvature).max()
    count = max(1, round(length / (high - low) * x.size))
    start = float(x[int(np.convolve(wanted, np.ones(count), mode="valid").argmax())])
    part = dataclasses.replace(full, start=start, stroke=length, steps=1, file="", settle=settle, pause=pause)
    return Trajectory(forward_and_back(part))

"""What a stage was promised: the error that its own description leaves under its own law and gains on the same motion.

A design, and a certificate, state the error of a simulation of the described machine. That simulation is made here
again from the parameters that every run carries, so that a bag, a simulation and a replay are judged by one figure and
no second record of it can differ. The machine is as described, its guide is the map, nothing disturbs it and no command
is late. An error p-p is one extreme of a stroke: with the encoder's noise, or late commands, a few strokes leave
several times what the others do. Where it matters, strokes are drawn until they leave as much as the run did, with the
described noise and range of friction, and commands as late as often as a run may have them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.analysis.judged_motion import Left, destabilised
from straightcomp_ros.analysis.record import SPEED_SPAN, MetricsError, StrokeRecord, motion_of
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.model.motion import Trajectory, Waypoint, forward_and_back, move
from straightcomp_ros.offline.scenario import MOST_SAMPLES, Scenario
from straightcomp_ros.offline.starts import COUNTS_APART, STARTS, offset
from straightcomp_ros.parameters.declaration import ParameterError, under
from straightcomp_ros.parameters.node_parameters import (
    STAGE,
    ControllerNodeParameters,
    DriverNodeParameters,
    FeedforwardNodeParameters,
    node_parameters,
)
from straightcomp_ros.stage.description import Factors, deviating
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.straightness.survey_header import Direction, SurveyError

_SAME = 0.02
"""Relative difference from the described motion within which a recorded one is that motion."""
_LONGEST_REST = 1.0
"""Time in s of rests that no figure depends on: before and after all strokes, and after a single one."""
_LONGEST_PAUSE = 20.0
"""Time in s of rests between strokes, of which more takes time and memory and only makes the promised RMS smaller."""
_STROKES = 32
"""Drawn at most: few runs ask for them. Four left at most 0.23 µm, or 0.55 with the map rounded otherwise, where a
sound run of a stage of 1 kg left 0.69."""
_BEYOND = math.log(1000 / (_STROKES + 1))
"""One in 33 of such strokes exceeds them all. One in 1,000 exceeds them by so many standard deviations, if the largest
ones are distributed exponentially (J. Pickands, Ann. Statist. 3 (1975) 119-131, without a shape)."""
_LATE = 0.01
"""Share of a drawn stroke's commands that are up to a period late. As many are no stall (`analysis.interruption`), and
the p99 of their delay is as described (`late_commands`)."""
_MODES = "stage.platform.modes."
_SMOOTH = "1"
"""As much smoothing of the survey as its noise warrants, whatever the parameters say: no guide has the noise."""


class Promise(NamedTuple):
    """Error of the described machine with the noise of the survey taken off; what simulates the largest p-p and RMS of
    strokes as they come: of so many that these reach those given, or else what one in 1,000 exceeds; and what simulates
    it with the map as it is. None: platform is lost."""

    smooth: Left
    largest: Callable[[Left], Left | None]
    as_mapped: Callable[[], Left | None]


def promise_of(
    record: StrokeRecord, parameters: Mapping[str, Mapping[str, Any]], straightness: StraightnessMap | None
) -> Promise | None:
    """The promise for the motion of ``record``, by the ``parameters`` of each node with dotted names and the map; None
    where they do not say what it is: parts are missing, of another version, or of a law that is not compiled."""
    if "controller" not in parameters or straightness is None:
        return None
    controller, feedforward = parameters["controller"], parameters.get("feedforward", {})
    if destabilised(controller):
        # No design promises what modes do to gains that leave no margins for them.
        controller = {name: value for name, value in controller.items() if not name.startswith(_MODES)}
    stage = {STAGE: under("stage.", controller)}
    try:
        nodes = (
            node_parameters("driver", stage),
            node_parameters("feedforward", {**stage, "feedforward": feedforward}),
            node_parameters("controller", {"controller": controller}),
        )
        runs = tuple((run.direction, run.x.tobytes(), run.deviation.tobytes()) for run in straightness.survey.runs)
        strokes = partial(_strokes, *nodes, _motion(record, nodes[2].stage.motion), runs)
        left = strokes(_SMOOTH)
        smooth = left(None)
        if smooth is None:
            return None
        return Promise(smooth, partial(_largest, left), lambda: strokes(nodes[1].stage.guide.smooth)(None))
    except (ParameterError, SurveyError, MetricsError, ValueError):
        return None


def _motion(record: StrokeRecord, described: Any) -> Any:
    """The described motion, with the place, the length and the speed of the record's strokes where they differ, and no
    longer rests and no more steps than were made."""
    x = record.x[record.motion.window]
    period = float(np.median(np.diff(record.time)))
    half = max(1, round(0.5 * SPEED_SPAN / period))
    moving = record.motion.samples()
    before, after = np.maximum(moving - half, 0), np.minimum(moving + half, record.time.size - 1)
    speeds = np.abs(record.x[after] - record.x[before]) / (record.time[after] - record.time[before])
    start, stroke, speed = float(x.min()), float(np.ptp(x)), float(np.quantile(speeds, 0.999))
    # The list of positions is not in a bag. Its movements are there, and equal ones are much the same.
    ways = [float(np.ptp(record.x[one.samples])) for one in record.motion.strokes]
    made = min(len(ways), max(1, round(stroke / float(np.median(ways)))))
    steps = made if described.file else min(made, described.steps)
    if described.pause < SPEED_SPAN and not described.file:
        # The record has steps as one stroke, which takes longer than one without them.
        took = period * max(one.stop - one.start for one in record.motion.strokes)
        limits = speed, described.acceleration, described.jerk
        lasts = [n * _movement(stroke / n, *limits)[-1].time_ns * 1e-9 for n in (1, described.steps)]
        steps = described.steps if took > 0.5 * sum(lasts) else steps
    rests = [following.start - one.stop for one, following in itertools.pairwise(record.motion.strokes)]
    rest = period * float(np.median(rests)) if rests else _LONGEST_REST
    # Two digits: strokes of one kind are then one motion.
    pause = min(described.pause if described.pause <= rest else float(f"{rest:.2g}"), _LONGEST_PAUSE)
    settle = min(described.settle, _LONGEST_REST)
    described = dataclasses.replace(described, file="", steps=steps, settle=settle, pause=pause)
    reached = _fastest(stroke, described.speed, described.acceleration, described.jerk)
    if described.stroke < 0.0:  # backward first
        start, stroke = start + stroke, -stroke
    same_place = abs(start - described.start) < _SAME * abs(stroke) and abs(stroke / described.stroke - 1.0) < _SAME
    if same_place and abs(speed / reached - 1.0) < _SAME:
        return described
    # What reaches this speed on the longest way: a trajectory may ask for more than is described.
    acceleration = max(described.acceleration, speed**2 / max(ways))
    smooth = _fastest(max(ways), speed, acceleration, described.jerk) >= (1.0 - _SAME) * speed
    speed = float(f"{speed:.2g}")
    return dataclasses.replace(
        described,
        start=start,
        stroke=stroke,
        speed=speed,
        highest_speed=max(described.highest_speed, 2.0 * speed),
        acceleration=acceleration,
        jerk=described.jerk if smooth else 0.0,
    )


def _fastest(way: float, speed: float, acceleration: float, jerk: float) -> float:
    """The speed in m/s that a movement of this length in m reaches."""
    return max(abs(one.velocity) for one in _movement(way, speed, acceleration, jerk))


def _movement(way: float, speed: float, acceleration: float, jerk: float) -> list[Waypoint]:
    """The corners of a movement of this length in m, from rest to rest."""
    return move(Waypoint(0, 0.0, 0.0), way, speed, acceleration, jerk)


@lru_cache(maxsize=16)
def _strokes(
    driver: DriverNodeParameters,
    feedforward: FeedforwardNodeParameters,
    controller: ControllerNodeParameters,
    motion: Any,
    runs: tuple[tuple[Direction, bytes, bytes], ...],
    smooth: str,
) -> Callable[[int | None], Left | None]:
    """What simulates the error of a stroke: as described, for None, or the one of this number as they come; each once.
    ``runs`` of the survey: direction, x and deviation."""
    stage = controller.stage
    law = make_law(controller.control, stage)
    guide = dataclasses.replace(feedforward.stage.guide, smooth=smooth)
    scenario = Scenario(
        driver=driver,
        description=stage,
        controls={controller.control.law: controller.control},
        feedforward=feedforward.feedforward,
        followed=dataclasses.replace(feedforward.stage, guide=guide),
        lead_ns=controller.lead_ns,
        trajectory=Trajectory(forward_and_back(motion)),
        survey=Survey(tuple(Run("", way, np.frombuffer(x), np.frombuffer(deviation)) for way, x, deviation in runs)),
    )
    if scenario.samples > MOST_SAMPLES:
        raise MetricsError("record: its motion is too long to be simulated")
    stroke = scenario.stroke()
    window = motion_of(np.asarray(stroke.stamps * 1e-9, dtype=np.float64), stroke.x).window
    count = stage.encoder.y_resolution
    # As a record's: of two tables at the measured x.
    followed = stroke.references[:, 0] if stroke.map.directed else stroke.map.evaluate(stroke.true_x)[0]
    size, own, range_ = followed.size, round(stage.drive.delay * stage.period_ns), stage.uncertainty

    @cache
    def left(number: int | None) -> Left | None:
        conditions: dict[str, Any] = {}
        if number is not None:
            random = np.random.default_rng(number)
            late = np.where(random.random(size) < _LATE, random.integers(0, stage.period_ns, size), 0)
            friction = range_.friction ** random.uniform(-1.0, 1.0)
            conditions = {
                "noise": range_.sensor_noise * count * random.standard_normal(size),
                "delays": own + late,
                "plant": deviating(driver.plant, Factors(friction=friction)),
                "offset": offset(number % STARTS, COUNTS_APART * count),
            }
        cycle = scenario.cycle(law, stroke, **conditions)
        if cycle.current.size < size:
            return None
        error = (followed - cycle.true_y)[window]
        return Left(peak_to_peak(error), float(error.std()))

    return left


def _largest(left: Callable[[int | None], Left | None], enough: Left) -> Left | None:
    drawn = list[Left]()
    for number in range(_STROKES):
        if (one := left(number)) is None:
            return None
        drawn.append(one)
        largest = Left(*map(max, zip(*drawn, strict=True)))
        if largest.pp >= enough.pp and largest.rms >= enough.rms:
            return largest
    return Left(*(most + _BEYOND * float(spread) for most, spread in zip(largest, np.std(drawn, axis=0), strict=True)))

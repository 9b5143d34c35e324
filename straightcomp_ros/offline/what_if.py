"""Simulates the loop over a recorded motion of the stage, with the recorded law or another."""

import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag
from straightcomp_ros.analysis.interruption import PAUSE, Stamps, played
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.record import SHORTEST_STROKE, MetricsError, StrokeRecord
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.bags.recorded_nodes import parameters_of, replayed_map
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import Run, simulated_run
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, Values, by_node, changed
from straightcomp_ros.parameters.share import named_file
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import find_survey
from straightcomp_ros.straightness.survey_header import SurveyError

_WAYPOINT_EVERY = 0.01
"""Time in s between waypoints: at a corner of the speed profile, 0.2 m/s², x errs by up to 3 µm, r by 1 nm."""
_APPROACH_NS = 1_000_000_000
"""Time for the simulated stage to go from 0 to the recorded start, before the first sample."""

_FORCE_FILE = "simulated.truth.disturbances.force_file"


def what_if(
    bag: Path,
    changes: Mapping[str, Mapping[str, Any]],
    remap: Mapping[str, str] | None = None,
    given: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[Run]:
    """Simulate a recorded run: it as it was recorded, simulated with its own parameters, and, if any are given, with
    the changes. The difference of the first two is the error of the simulation.

    The plant is that of the bag's parameters, without a table of force that is not on this computer; the loop's delay
    is the recorded median. If no truth was recorded, the guide is that of the map.

    ``changes`` are values by node and dotted name, over those of the bag; ``remap`` and ``given`` as of
    :func:`~straightcomp_ros.offline.audit.audit`.

    Raises:
        BagError, MetricsError: the bag is refused, its stage does not move, or the time of its motion is not known.
        ParameterError: a parameter is refused.
        SurveyError: the map is not attached and not found, or is refused.
    """
    evaluation = evaluate_bag(bag, remap)
    attachments = read_attachments(bag)
    record = evaluation.record
    parameters = parameters_of(bag, attachments, given, remap)
    partial = evaluation.partial()
    late = evaluation.stalls, evaluation.latency, evaluation.readings
    verdict = partial or verdict_of(judged_motion(record, record.reference, parameters, evaluation.map, *late))
    stamps = evaluation.record_stamps
    moved = np.abs(np.diff(record.x))[np.diff(stamps) >= PAUSE * 1e9]
    if evaluation.clock_jump or (moved >= SHORTEST_STROKE).any():
        raise MetricsError(f"bag {bag}: its clock jumped, or samples lack for {PAUSE:g} s in motion: not simulated")
    runs = [Run(record.law, evaluate(record, record.reference, evaluation.map), verdict)]
    with tempfile.TemporaryDirectory() as folder:
        survey = replayed_map(bag, attachments, parameters, Path(folder))
        values = _recorded_values(parameters, evaluation, survey)
        motion = _recorded_motion(record, stamps)
        runs.append(_simulated(values, motion))
        if any(changes.values()):
            runs.append(_simulated(by_node(changed(values, changes)), motion))
    return runs


def _recorded_values(parameters: Values, evaluation: BagEvaluation, survey: Path | None) -> dict[str, dict[str, Any]]:
    values = {node: dict(parameters.get(node, {})) for node in NODE_PARAMETERS}
    # The board of the machine is simulated, too: its DBC file need not be here.
    driver = {name: value for name, value in values["driver"].items() if not name.startswith("can.")}
    values["driver"] = driver
    driver["hardware"] = "simulated"
    if (force := str(driver.get(_FORCE_FILE, ""))) and not named_file(force).is_file():
        text = f"{force} is not on this computer: simulated without this force, unless --set names the file"
        warnings.warn(f"parameter '{_FORCE_FILE}': {text}", stacklevel=2)
        driver[_FORCE_FILE] = ""
    if survey is not None:
        values["feedforward"]["stage.guide.file"] = str(survey)
    guide = str(driver.get("simulated.truth.guide", ""))
    try:
        if evaluation.record.guide is None:
            raise SurveyError("no truth")
        find_survey(guide)
    except SurveyError:
        # The guide that the map describes.
        guide = ""
    driver["simulated.truth.guide"] = guide
    driver["stage.guide.file"] = values["feedforward"].get("stage.guide.file", StageParameters().guide.file)
    period = float(np.median(np.diff(evaluation.stamps))) * 1e-9
    if len(evaluation.latency):
        driver["stage.drive.delay"] = float(np.clip(np.median(evaluation.latency) / period, 0.0, 10.0))
    driver["simulated.initial_y"] = float(evaluation.record.y[0])
    # A delay of some samples must not end the run.
    driver["simulated.command_timeout"] = 1.0
    return values


def _recorded_motion(record: StrokeRecord, stamps: Stamps) -> tuple[Trajectory, int]:
    """The recorded motion of the stage at ``stamps`` (n,) in ns, with the time of :func:`played`, and the time in ns at
    which its trajectory starts."""
    x, time = record.x if record.true_x is None else record.true_x, played(stamps) * 1e-9
    last = len(x) - 1
    step = min(max(round(_WAYPOINT_EVERY / float(np.median(np.diff(time)))), 1), last)
    places = np.unique(np.append(np.arange(0, len(x), step), last))
    before, after = np.maximum(places - step // 2, 0), np.minimum(places + step // 2, last)
    speed = (x[after] - x[before]) / np.maximum(time[after] - time[before], 1e-9)
    speed[0] = speed[-1] = 0.0
    corners = zip(time[places].tolist(), x[places].tolist(), speed.tolist(), strict=True)
    waypoints = [Waypoint(_APPROACH_NS + round(at * 1e9), *there) for at, *there in corners]
    return Trajectory([Waypoint(0, 0.0, 0.0), *waypoints]), -_APPROACH_NS


def _simulated(values: Values, motion: tuple[Trajectory, int]) -> Run:
    simulation = Simulation(values, motion=motion)
    return simulated_run(simulation.run(), simulation.map, values)

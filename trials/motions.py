"""Random motions of the stage: strokes that are held, slowed down, reversed, ended, and jogs between them; and a step
and scan of many positions. Each runs in the simulation that computes what the graph computes in lockstep.

A sequence passes if each stop ends within v/a + 50 ms, the true error p-p is within 1.1 of that of a whole stroke or of
the same moves left alone, the platform stays off its stop, and the true r̈ has no step beyond what three times the jerk
of the strokes makes of it in a sample. Short moves from rest have more error than a stroke from end to end, whether or
not they are stopped.
"""

import argparse
import random
from typing import Any

import numpy as np

from straightcomp_ros.analysis.movements import SETTLED, standstill_figures
from straightcomp_ros.cli.options import add_json, add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, goals, move
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.straightness.residual import peak_to_peak

SUMMARY = "random stops, overrides, jogs and reversals, and a step and scan of many positions"
PURPOSE = "measure"
_STOP_S = 0.05
_ERROR = 1.1
_JERKS = 3.0
_SETTLE_NS = 1_000_000_000
"""In which the platform follows from its start to the map."""
_STILL = 1e-6
"""m/s below which the stage stands."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    parser.add_argument("--sequences", type=int, default=1000, metavar="N", help="random sequences (default: 1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the first sequence (default: 1)")
    parser.add_argument("--positions", type=int, default=100, metavar="N", help="of the step and scan (default: 100)")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    values = chosen_parameters(options)
    stage = values.setdefault("stage", {})
    acceleration = node_parameters("cell", values).stage.motion.acceleration
    # Trapezoids have steps of their own.
    stage["motion.jerk"] = stage.get("motion.jerk") or acceleration / 0.01
    normal = whole_stroke(values)
    found = [sequence(values, seed, normal) for seed in range(options.seed, options.seed + options.sequences)]
    shown: dict[str, Any] = {"normal_pp_um": normal * 1e6, "sequences": len(found)}
    if found:
        shown |= {name: max(one[name] for one in found) for name in found[0] if name not in ("seed", "stops", "failed")}
        shown |= {"stops": sum(one["stops"] for one in found), "failed": [one for one in found if one["failed"]][:20]}
        shown["above_1.1_of_a_stroke"] = sum(one["pp_um"] > _ERROR * normal * 1e6 for one in found)
        shown["failures"] = sum(bool(one["failed"]) for one in found)
    if options.positions:
        shown["step_and_scan"] = step_and_scan(values, options.positions)
    print_json(shown)
    raise SystemExit(1 if shown.get("failures") else 0)


def whole_stroke(values: Any) -> float:
    """True error p-p in m of the stage's own stroke, forward and back, while it moves."""
    simulation = Simulation(values)
    record = simulation.run()
    error = record.true_error(simulation.map)
    assert error is not None
    return peak_to_peak(error[record.motion.window])


def drawn(motion: MotionParameters, draw: random.Random) -> Trajectory:
    """Three moves between places of the stroke, some of them jogs, with rests between."""
    low, high = sorted((motion.start, motion.start + motion.stroke))
    points = [Waypoint(0, draw.uniform(low, high), 0.0)]
    points.append(points[0]._replace(time_ns=_SETTLE_NS))
    for _ in range(3):
        here = points[-1]
        jogged = here.position + draw.choice([-1.0, 1.0]) * draw.choice([1e-4, 1e-3, 1e-2])
        goal = min(max(jogged if draw.random() < 0.4 else draw.uniform(low, high), low), high)
        speed = motion.speed * draw.choice([1.0, 1.0, 0.3])
        points += move(here, goal, speed, motion.acceleration, motion.jerk)
        points.append(points[-1]._replace(time_ns=points[-1].time_ns + draw.randrange(1, 400) * 1_000_000))
    return Trajectory(points)


def sequence(values: Any, seed: int, normal: float) -> dict[str, Any]:
    """One sequence: what it did and how it failed; ``failed`` is empty if it did not."""
    draw = random.Random(seed)
    nodes = node_parameters("driver", values)
    motion, stop = nodes.stage.motion, nodes.stage.platform.stop
    trajectory = drawn(motion, draw)
    simulation = Simulation(values, motion=(trajectory, 0))
    period, at, paces = nodes.stage.period, round(_SETTLE_NS / nodes.stage.period_ns), dict[int, Pace]()
    for _ in range(draw.randrange(1, 7)):
        at += draw.randrange(20, 2500)
        paces[at] = draw.choice([Pace(hold=True)] * 3 + [Pace(), Pace(0.3), Pace(max(0.05, draw.random()))])
    at += 2500
    # It goes on to its end, or ends where it stands.
    paces[at] = Pace() if draw.random() < 0.7 else Pace(end=True)
    record = simulation.run(paces=paces)
    error, x, y = record.true_error(simulation.map), record.true_x, record.true_y
    assert error is not None and x is not None and y is not None
    v = np.diff(x) / period
    a = np.diff(v) / period
    _, slope, curvature = simulation.map.evaluate(x[1:-1])
    mean = 0.5 * (v[1:] + v[:-1])
    steps = np.abs(np.diff(curvature * mean**2 + slope * a))
    # What the guide and three times the jerk make of it, both at their largest.
    jerk = _JERKS * motion.jerk * period * np.abs(slope).max()
    carried = np.abs(np.diff(curvature)) * mean[1:] ** 2 + 3.0 * np.abs(curvature[1:]) * motion.speed * (
        motion.acceleration * period
    )
    begun = round(_SETTLE_NS / nodes.stage.period_ns)
    late, stops = 0.0, 0
    for begin, pace in paces.items():
        allowed = round((abs(v[min(begin, v.size) - 1]) / motion.acceleration + _STOP_S) / period)
        until = min([other for other in paces if other > begin], default=v.size)
        if (pace.hold or pace.end) and begin + allowed < min(until, v.size):
            moving = np.flatnonzero(np.abs(v[begin:until]) > _STILL)
            late = max(late, float(moving[-1] + 1 - allowed) * period + _STOP_S if moving.size else 0.0)
            stops += 1
    pp = peak_to_peak(error[begun:])
    alone = normal
    if pp > _ERROR * normal:
        left = Simulation(values, motion=(trajectory, 0))
        error = left.run().true_error(left.map)
        assert error is not None
        alone = max(normal, peak_to_peak(error[begun:]))
    failed = {
        "stop": late > _STOP_S,
        "error": pp > _ERROR * alone,
        "step": bool((steps > jerk + carried).any()),
        "at_stop": bool(np.abs(y).max() >= stop),
    }
    return {
        "seed": seed,
        "stops": stops,
        "latest_stop_beyond_v_over_a_ms": late * 1e3,
        "pp_um": pp * 1e6,
        "pp_relative_to_the_same_moves": pp / alone,
        "largest_step_of_acceleration": float(steps.max()),
        "largest_acceleration_relative": float(np.abs(a).max() / motion.acceleration),
        "failed": [name for name, one in failed.items() if one],
    }


def step_and_scan(values: Any, positions: int) -> dict[str, Any]:
    """Settling to the band after each of so many steps along the stroke, beside the error at standstill."""
    chosen = {**values, "stage": {**values["stage"], "motion.steps": positions, "motion.pause": 0.5}}
    simulation = Simulation(chosen)
    record = simulation.run()
    figures = standstill_figures(record, simulation.map)[:positions]
    settling = np.array([one.settling for one in figures if one.settling is not None])
    standstill = np.array([one.standstill_pp for one in figures if one.standstill_pp is not None])
    assert len(goals(node_parameters("cell", chosen).stage.motion)) == positions + 1
    known = settling[np.isfinite(settling)]
    return {
        "positions": len(figures),
        "band_um": SETTLED * 1e6,
        "settled": known.size,
        "settling_median_ms": float(np.median(known)) * 1e3 if known.size else None,
        "settling_worst_ms": float(known.max()) * 1e3 if known.size else None,
        "standstill_pp_median_um": float(np.median(standstill)) * 1e6,
        "standstill_pp_worst_um": float(standstill.max()) * 1e6,
    }

"""Random motions of the stage: strokes that are held, slowed down, reversed, ended and gone on with, and jogs between,
with faults that switch the amplifier off on the way; and a step and scan of many positions. Each runs in the simulation
that computes what the graph computes in lockstep.

A sequence passes if each stop ends within v/a + 50 ms, the true error p-p is within 1.1 of the largest of a whole
stroke over nine starts, the platform stays off its stop, and the true r̈ has no step beyond what three times the jerk of
the strokes makes of it in a sample. It begins with a short move forth and back that is not judged: when the amplifier
has just been switched on the law knows no friction, and leaves more error where the platform first leaves rest.
"""

import argparse
import random
from typing import Any

import numpy as np

from straightcomp_ros.analysis.metrics import SETTLED, standstill_figures
from straightcomp_ros.cli.options import add_json, add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, goals, move
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import runs_of_starts
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.straightness.residual import peak_to_peak

SUMMARY = "random stops, overrides, jogs and reversals, and a step and scan of many positions"
PURPOSE = "measure"
_STOP_S = 0.05
_ERROR = 1.1
_JERKS = 3.0
_SETTLE_NS = 1_000_000_000
"""In which the platform follows from its start to the map."""
_FIRST = 0.01
"""m, of the first move forth and back."""
_RECOVERY = 0.3
"""s after the amplifier was switched on again, until the platform follows."""
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
    normal = whole_strokes(values)
    found = [sequence(values, seed, max(normal)) for seed in range(options.seed, options.seed + options.sequences)]
    shown: dict[str, Any] = {"normal_pp_um": [pp * 1e6 for pp in sorted(normal)], "sequences": len(found)}
    if found:
        pp = np.array([one["pp_um"] for one in found])
        shown |= {name: max(one[name] for one in found) for name in found[0] if name not in ("seed", "stops", "failed")}
        shown |= {name: sum(one[name] for one in found) for name in ("stops", "reversals", "faults")}
        shown |= {"pp_um_median": float(np.median(pp)), "pp_um_95_percent": float(np.quantile(pp, 0.95))}
        shown["above_1.1_of_the_median_stroke"] = int((pp > _ERROR * float(np.median(normal)) * 1e6).sum())
        shown["failures"] = sum(bool(one["failed"]) for one in found)
        shown["failed"] = [one for one in found if one["failed"]][:20]
    if options.positions:
        shown["step_and_scan"] = step_and_scan(values, options.positions)
    print_json(shown)
    raise SystemExit(1 if shown.get("failures") else 0)


def whole_strokes(values: Any) -> list[float]:
    """True error p-p in m of the stage's own stroke, forward and back, while it moves, over its starts."""
    runs = ((record, record.true_error(reference)) for record, reference in runs_of_starts(values))
    return [peak_to_peak(error[record.motion.window]) for record, error in runs if error is not None]


def drawn(motion: MotionParameters, draw: random.Random) -> tuple[Trajectory, int]:
    """Three moves between places of the stroke, some of them jogs, with rests between, after a first move forth and
    back; and when they begin, in ns."""
    low, high = sorted((motion.start, motion.start + motion.stroke))
    points = [Waypoint(0, draw.uniform(low, high), 0.0)]
    aside = points[0].position + (_FIRST if points[0].position < 0.5 * (low + high) else -_FIRST)

    def add(rest_ns: int, goal: float, speed: float) -> None:
        points.append(points[-1]._replace(time_ns=points[-1].time_ns + rest_ns))
        points.extend(move(points[-1], goal, speed, motion.acceleration, motion.jerk))

    add(_SETTLE_NS, aside, motion.speed)
    add(100_000_000, points[0].position, motion.speed)
    begin_ns = points[-1].time_ns
    for _ in range(3):
        here = points[-1].position
        jogged = here + draw.choice([-1.0, 1.0]) * draw.choice([1e-4, 1e-3, 1e-2])
        goal = min(max(jogged if draw.random() < 0.4 else draw.uniform(low, high), low), high)
        add(draw.randrange(1, 400) * 1_000_000, goal, motion.speed * draw.choice([1.0, 1.0, 0.3]))
    points.append(points[-1]._replace(time_ns=points[-1].time_ns + 400_000_000))
    return Trajectory(points), begin_ns


def sequence(values: Any, seed: int, normal: float) -> dict[str, Any]:
    """One sequence: what it did and how it failed; ``failed`` is empty if it did not."""
    draw = random.Random(seed)
    nodes = node_parameters("driver", values)
    motion, stop = nodes.stage.motion, nodes.stage.platform.stop
    trajectory, begin_ns = drawn(motion, draw)
    period, period_ns = nodes.stage.period, nodes.stage.period_ns
    at = begun = begin_ns // period_ns
    paces = dict[int, Pace]()
    for _ in range(draw.randrange(1, 7)):
        at += draw.randrange(20, 2500)
        paces[at] = draw.choice([Pace(hold=True)] * 3 + [Pace(), Pace(0.3), Pace(max(0.05, draw.random()))])
    at += 2500
    # It goes on to its end, or ends where it stands.
    paces[at] = Pace() if draw.random() < 0.7 else Pace(end=True)
    off = begun + draw.randrange(20, at - begun + 4000) if draw.random() < 0.3 else -1
    on = off + draw.randrange(20, 1000)
    back = begun + draw.randrange(20, at - begun + 4000) if draw.random() < 0.3 else -1
    machines, reversals = list[SimulatedHardware](), list[int]()

    def wiring(machine: SimulatedHardware) -> SimulatedHardware:
        machines.append(machine)
        return machine

    def observe(sample: Any, *_: Any) -> None:
        machine, number = machines[0], sample.stamp_ns // period_ns
        if number == off:
            machine.disable()
        elif number == on:
            machine.enable()
        elif number == back and machine.motion.moving:
            # Back to where it came from, within the acceleration of strokes.
            goal, seconds = trajectory.positions[0], 1.0
            there = Trajectory([Waypoint(round(seconds * 1e9), goal, 0.0)])
            while machine.motion.joined(there, sample.stamp_ns).largest_acceleration > motion.acceleration:
                seconds *= 1.1
                there = Trajectory([Waypoint(round(seconds * 1e9), goal, 0.0)])
            machine.move(there, sample.stamp_ns)
            reversals.append(number)

    simulation = Simulation(values, motion=(trajectory, 0), wiring=wiring)
    record = simulation.run(observe=observe, paces=paces)
    error, x, y = record.true_error(simulation.map), record.true_x, record.true_y
    assert error is not None and x is not None and y is not None
    v = np.diff(x) / period
    a = np.diff(v) / period
    _, slope, curvature = simulation.map.evaluate(x[1:-1])
    mean = 0.5 * (v[1:] + v[:-1])
    steps = np.abs(np.diff(curvature * mean**2 + slope * a))
    if reversals:
        # The cubic back has an acceleration of its own at both ends.
        steps[max(0, reversals[0] - 3) :] = 0.0
    # What the guide and three times the jerk make of it, both at their largest.
    jerk = _JERKS * motion.jerk * period * np.abs(slope).max()
    carried = np.abs(np.diff(curvature)) * mean[1:] ** 2 + 3.0 * np.abs(curvature[1:]) * motion.speed * (
        motion.acceleration * period
    )
    late, stops = 0.0, 0
    for begin, pace in paces.items():
        allowed = round((abs(v[min(begin, v.size - 1)]) / motion.acceleration + _STOP_S) / period)
        until = min([other for other in (*paces, *reversals) if other > begin], default=v.size)
        if (pace.hold or pace.end) and begin + allowed < min(until, v.size):
            moving = np.flatnonzero(np.abs(v[begin:until]) > _STILL)
            late = max(late, float(moving[-1] + 1 - allowed) * period + _STOP_S if moving.size else 0.0)
            stops += 1
    judged = np.ones(error.size, bool)
    judged[:begun] = False
    if off > 0:
        judged[off : on + round(_RECOVERY / period)] = False
    pp = peak_to_peak(error[judged])
    failed = {
        "stop": late > _STOP_S,
        "error": pp > _ERROR * normal,
        "step": bool((steps > jerk + carried).any()),
        "at_stop": bool(np.abs(y).max() >= stop),
    }
    return {
        "seed": seed,
        "stops": stops,
        "reversals": len(reversals),
        "faults": int(0 < off < error.size),
        "latest_stop_beyond_v_over_a_ms": late * 1e3,
        "pp_um": pp * 1e6,
        "first_move_pp_um": peak_to_peak(error[_SETTLE_NS // period_ns : begun]) * 1e6,
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

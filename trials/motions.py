"""Random motions of the stage: strokes that are held, slowed down, reversed, ended and gone on with, and jogs between,
with faults that switch the amplifier off on the way. Each runs in the simulation that computes what the graph computes
in lockstep.

A sequence passes if each stop ends within v/a + 50 ms, the true error p-p is within 1.1 of the largest of whole
strokes, over as many starts as there are sequences (of more than 300, over 300), the platform stays off its stop, and
the true r̈ has no step beyond what three times the jerk of the strokes makes of it in a sample. It begins with a move
forth and back that is not judged: when the amplifier has just been switched on the law knows no friction, and leaves
more error until the platform has slid both ways.
"""

import argparse
import random
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.analysis.record import Array
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters, in_range
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import Trajectory, Waypoint, move
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, runs_of_starts
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from trials.rig import tracked

SUMMARY = "random stops, overrides, jogs and reversals"
_STOP_S = 0.05
_ERROR = 1.1
_JERKS = 3.0
_MOST_STARTS = 300
"""The largest of many is larger than that of a few: of the shipped stage's strokes 0.151 µm of 9, 0.162 of 60, 0.173 of
300."""
_SETTLE_NS = 1_000_000_000
"""In which the platform follows from its start to the map."""
_FIRST = 0.2
"""m, of the first move forth and back: there the platform slides by micrometres, ten times what its bristles bend."""
_RECOVERY = 0.3
"""s after the amplifier was switched on again, until the platform follows."""
_STILL = 1e-6
"""m/s below which the stage stands."""
_COUNTED = ("stops", "reversals", "faults")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--sequences", type=in_range(int, 1), default=1000, metavar="N", help="random sequences (default: %(default)s)")
    add("--seed", type=int, default=1, metavar="N", help="of the first sequence (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Exit code 1 if a sequence failed."""
    values = chosen_parameters(options)
    motion = node_parameters("cell", values).stage.motion
    # Trapezoids have steps of their own.
    values.setdefault("stage", {})["motion.jerk"] = motion.jerk or motion.acceleration / 0.01
    seeds = range(options.seed, options.seed + options.sequences)
    stage = node_parameters("driver", values).stage
    normal = whole_strokes(values, max(STARTS, min(len(seeds), _MOST_STARTS)))
    found = [
        judged(*in_lockstep(values, planned(stage, seed))) | {"seed": seed} for seed in tracked(seeds, "sequences")
    ]
    for one in found:
        if one["pp_um"] > _ERROR * max(normal) * 1e6:
            one["failed"].append("error")
    failed = [one for one in found if one["failed"]]
    shown: dict[str, Any] = {"sequences": len(found), "failures": len(failed), "failed": failed[:20]}
    shown |= {name: sum(one[name] for one in found) for name in _COUNTED}
    shown |= {name: max(one[name] for one in found) for name in found[0] if name not in (*shown, "seed", "pp_um")}
    print_json(shown | _spread("normal_pp_um", normal) | _spread("pp_um", [one["pp_um"] * 1e-6 for one in found]))
    return int(bool(failed))


def whole_strokes(values: Any, starts: int) -> list[float]:
    """True error p-p in m of the stage's own stroke, forward and back, while it moves, over so many starts."""
    runs = ((record, record.true_error(reference)) for record, reference in runs_of_starts(values, starts))
    return [peak_to_peak(error[record.motion.window]) for record, error in runs if error is not None]


def _spread(name: str, pp: Sequence[float]) -> dict[str, Any]:
    shares = {"median": 0.5, "95_percent": 0.95, "largest": 1.0}
    return {f"{name}_{word}": float(np.quantile(pp, share)) * 1e6 for word, share in shares.items()}


class Act(NamedTuple):
    """What happens after a sample: the stage is asked for a pace, it turns back, or the amplifier goes off or on."""

    at: int
    what: str  # "pace", "back", "off" or "on"
    asked: Any = None  # a pace


class Plan(NamedTuple):
    """A sequence: its motion, the sample from which it is judged, and what happens on the way."""

    stage: StageParameters
    trajectory: Trajectory
    begun: int
    acts: Sequence[Act]


def planned(stage: StageParameters, seed: int) -> Plan:
    """Three moves between places of the stroke, some of them jogs, with rests between, after a first move forth and
    back; and what happens on the way."""
    draw, motion = random.Random(seed), stage.motion
    low, high = sorted((motion.start, motion.start + motion.stroke))
    points = [Waypoint(0, draw.uniform(low, high), 0.0)]
    aside = points[0].position + (_FIRST if points[0].position < 0.5 * (low + high) else -_FIRST)

    def add(rest_ns: int, goal: float, speed: float) -> None:
        points.append(points[-1]._replace(time_ns=points[-1].time_ns + rest_ns))
        points.extend(move(points[-1], goal, speed, motion.acceleration, motion.jerk))

    add(_SETTLE_NS, aside, motion.speed)
    add(100_000_000, points[0].position, motion.speed)
    at = begun = points[-1].time_ns // stage.period_ns
    for _ in range(3):
        here = points[-1].position
        jogged = here + draw.choice([-1.0, 1.0]) * draw.choice([1e-4, 1e-3, 1e-2])
        goal = min(max(jogged if draw.random() < 0.4 else draw.uniform(low, high), low), high)
        add(draw.randrange(1, 400) * 1_000_000, goal, motion.speed * draw.choice([1.0, 1.0, 0.3]))
    points.append(points[-1]._replace(time_ns=points[-1].time_ns + 400_000_000))
    acts = []
    for _ in range(draw.randrange(1, 7)):
        at += draw.randrange(20, 2500)
        pace = draw.choice([Pace(hold=True)] * 3 + [Pace(), Pace(0.3), Pace(max(0.05, draw.random()))])
        acts.append(Act(at, "pace", pace))
    at += 2500
    # It goes on to its end, or ends where it stands.
    acts.append(Act(at, "pace", Pace() if draw.random() < 0.7 else Pace(end=True)))
    off = begun + draw.randrange(20, at - begun + 4000) if draw.random() < 0.3 else -1
    on = off + draw.randrange(20, 1000)
    back = begun + draw.randrange(20, at - begun + 4000) if draw.random() < 0.3 else -1
    acts += [Act(off, "off"), Act(on, "on")] if off > 0 else []
    acts += [Act(back, "back")] if back > 0 else []
    return Plan(stage, Trajectory(points), begun, sorted(acts, key=lambda act: act.at))


def in_lockstep(values: Any, plan: Plan) -> tuple[Plan, StraightnessMap, Array, Array]:
    """The plan with the turns that took place, the map, and true x and y (n,) in m."""
    machines, turns, acceleration = list[SimulatedHardware](), list[Act](), plan.stage.motion.acceleration
    acts = {act.at: act.what for act in plan.acts if act.what != "pace"}

    def wiring(machine: SimulatedHardware) -> SimulatedHardware:
        machines.append(machine)
        return machine

    def back(machine: SimulatedHardware, stamp_ns: int) -> Trajectory:
        """To where it came from, within the acceleration of strokes."""
        for seconds in 1.1 ** np.arange(100):
            there = Trajectory([Waypoint(round(seconds * 1e9), plan.trajectory.positions[0], 0.0)])
            if machine.motion.joined(there, stamp_ns).largest_acceleration <= acceleration:
                break
        return there

    def observe(sample: Any, *_: Any) -> None:
        machine, number = machines[0], sample.stamp_ns // plan.stage.period_ns
        what = acts.get(number)
        if what == "off":
            machine.disable()
        elif what == "on":
            machine.enable()
        elif what == "back" and machine.motion.moving:
            turns.append(Act(number, what))
            machine.move(back(machine, sample.stamp_ns), sample.stamp_ns)

    simulation = Simulation(values, motion=(plan.trajectory, 0), wiring=wiring)
    paces = {act.at: act.asked for act in plan.acts if act.what == "pace"}
    record = simulation.run(observe=observe, paces=paces)
    assert record.true_x is not None and record.true_y is not None
    happened = sorted([*(act for act in plan.acts if act.what != "back"), *turns], key=lambda act: act.at)
    return plan._replace(acts=happened), simulation.map, record.true_x, record.true_y


def judged(plan: Plan, straightness: StraightnessMap, x: Array, y: Array) -> dict[str, Any]:
    """What a sequence did, and how it failed apart from its error; ``failed`` is empty if it did not."""
    stage, motion, period = plan.stage, plan.stage.motion, plan.stage.period
    error = straightness.evaluate(x)[0] - y
    v = np.diff(x) / period
    a = np.diff(v) / period
    _, slope, curvature = straightness.evaluate(x[1:-1])
    mean = 0.5 * (v[1:] + v[:-1])
    steps = np.abs(np.diff(curvature * mean**2 + slope * a))
    # What the guide and three times the jerk make of it, both at their largest.
    jerk = _JERKS * motion.jerk * period * np.abs(slope).max()
    carried = np.abs(np.diff(curvature)) * mean[1:] ** 2 + 3.0 * np.abs(curvature[1:]) * motion.speed * (
        motion.acceleration * period
    )
    late, counted = list[float](), np.arange(error.size) >= plan.begun
    of_the_stage = [act for act in plan.acts if act.what in ("pace", "back") and act.at < v.size]
    for act, following in pairwise([*of_the_stage, Act(v.size, "end")]):
        allowed = round((abs(v[act.at]) / motion.acceleration + _STOP_S) / period)
        if act.what == "pace" and (act.asked.hold or act.asked.end) and act.at + allowed < following.at:
            moving = np.flatnonzero(np.abs(v[act.at : following.at]) > _STILL)
            late.append(float(moving[-1] + 1 - allowed) * period + _STOP_S if moving.size else 0.0)
    at = {act.what: act.at for act in plan.acts}
    if "off" in at:
        counted[at["off"] : at["on"] + round(_RECOVERY / period)] = False
    failed = {
        "stop": max(late, default=0.0) > _STOP_S,
        "step": bool((steps > jerk + carried).any()),
        "at_stop": bool(np.abs(y).max() >= stage.platform.stop),
    }
    return {
        "stops": len(late),
        "reversals": int("back" in at),
        "faults": int("off" in at and at["off"] < error.size),
        "latest_stop_beyond_v_over_a_ms": max(late, default=0.0) * 1e3,
        "pp_um": peak_to_peak(error[counted]) * 1e6,
        "first_move_pp_um": peak_to_peak(error[_SETTLE_NS // stage.period_ns : plan.begun]) * 1e6,
        "largest_acceleration_relative": float(np.abs(a).max() / motion.acceleration),
        "failed": [name for name, one in failed.items() if one],
    }

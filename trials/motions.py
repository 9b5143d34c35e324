"""Random motions of the stage: strokes that are held, slowed down, reversed, ended and gone on with, and jogs between,
with faults that switch the amplifier off on the way. Each runs in the simulation that computes what the graph computes
in lockstep; with --live the sequences run in one running graph, one after the other, after nine whole strokes.

A sequence passes if each stop ends within v/a + 50 ms, the true error p-p is within 1.1 of the largest of whole
strokes, over as many starts as there are sequences (of more than 300, over 300), the platform stays off its stop, and
the true r̈ has no step beyond what three times the jerk of the strokes makes of it in a sample. It begins with a move
forth and back that is not judged: when the amplifier has just been switched on the law knows no friction, and leaves
more error until the platform has slid both ways.
"""

import argparse
import random
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.analysis.record import Array
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters, whole_number
from straightcomp_ros.cli.output import print_json, require_ros
from straightcomp_ros.contract import STAGE_STATE, TRUTH
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import Trajectory, Waypoint, cycles, move
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, runs_of_starts
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
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
_LATE = 100
"""Samples in which a live motion has begun."""
_TO_START_NS = 8_000_000_000
_PATIENCE_S = 400.0
_COUNTED = ("stops", "reversals", "faults")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--sequences", type=whole_number(1), default=1000, metavar="N", help="random sequences (default: %(default)s)")
    add("--seed", type=int, default=1, metavar="N", help="of the first sequence (default: %(default)s)")
    add("--live", metavar="DIR", help="run the sequences in a running graph; bag and logs go here")


def run(options: argparse.Namespace) -> int:
    """Exit code 1 if a sequence failed."""
    values = chosen_parameters(options)
    motion = node_parameters("cell", values).stage.motion
    # Trapezoids have steps of their own.
    values.setdefault("stage", {})["motion.jerk"] = motion.jerk or motion.acceleration / 0.01
    seeds = range(options.seed, options.seed + options.sequences)
    plans = [planned(node_parameters("driver", values).stage, seed) for seed in seeds]
    if options.live:
        normal, found = live(values, plans, Path(options.live).absolute())
    else:
        normal = whole_strokes(values, max(STARTS, min(len(seeds), _MOST_STARTS)))
        found = [judged(*in_lockstep(values, plan)) for plan in tracked(plans, "sequences")]
    for seed, one in zip(seeds, found, strict=True):
        one["seed"] = seed
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
    asked: Any = None  # the pace; of a turn the trajectory that joins the motion, once it is known


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
            turns.append(Act(number, what, back(machine, sample.stamp_ns)))
            machine.move(turns[-1].asked, sample.stamp_ns)

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


def live(values: Any, plans: Sequence[Plan], folder: Path) -> tuple[list[float], list[dict[str, Any]]]:
    """As :func:`whole_strokes` and :func:`judged`, but of one running graph."""
    require_ros()
    from diagnostic_msgs.msg import DiagnosticStatus
    from std_srvs.srv import SetBool, Trigger

    from straightcomp_ros.cell.launcher import LaunchError
    from straightcomp_ros.runtime.graph_client import message_from_waypoints
    from straightcomp_ros.runtime.safety_panel import LATCHED, tripper
    from straightcomp_ros.runtime.stage_state import stage_state
    from trials.stand import Stand

    values = {**values, "driver": {**values["driver"], "blend": True}}
    stage, states = node_parameters("driver", values).stage, [stage_state(DiagnosticStatus())]
    motion, period_ns = stage.motion, stage.period_ns
    strokes = Plan(stage, Trajectory(cycles(motion, STARTS)), 0, [])
    plans = [strokes, *(in_lockstep(values, plan)[0] for plan in plans)]
    with Stand(folder, values, composed=True) as stand:
        stand.node.create_subscription(
            DiagnosticStatus, STAGE_STATE, lambda message: states.append(stage_state(message)), LATCHED
        )
        trip = tripper(stand.node)

        def wait(condition: Callable[[], bool]) -> None:
            if not stand.until(condition, _PATIENCE_S):
                raise LaunchError(f"the graph does not go on (logs in {folder})")

        def enable() -> None:
            stand.call(Trigger, "driver/reset_fault")
            wait(stand.enable)

        def do(act: Act) -> Act:
            now = act._replace(at=time.time_ns())
            if act.what == "back":
                stand.move(message_from_waypoints(act.asked.waypoints))
            elif act.what == "off":
                trip(Fault.FOLLOWING_ERROR, "asked for")
            elif act.what == "on":
                enable()
            elif act.asked.end:
                stand.call(Trigger, "driver/end_motion")
            else:
                if not act.asked.hold:
                    stand.set("driver", {"override": act.asked.override})
                stand.call(SetBool, "driver/hold", data=act.asked.hold)
            return now

        def follow(plan: Plan) -> tuple[Plan, int, int]:
            """Run a motion; the plan with the times of its acts, and those of begin and end, ns since the epoch."""
            number, begin_ns, acts = states[-1].number, time.time_ns(), list[Act]()
            stand.move(message_from_waypoints(plan.trajectory.waypoints))
            for act in plan.acts:
                stand.spin((begin_ns + act.at * period_ns - time.time_ns()) * 1e-9)
                acts.append(do(act))
            wait(lambda: states[-1].number > number and states[-1].condition == "rest")
            do(Act(0, "pace", Pace()))
            return plan._replace(acts=acts), begin_ns, time.time_ns()

        wait(lambda: stand.active and len(states) > 1)
        enable()
        runs = []
        for plan in plans:
            to_start = Waypoint(_TO_START_NS, plan.trajectory.positions[0], 0.0)
            follow(Plan(stage, Trajectory([to_start]), 0, []))
            runs.append(follow(plan))
        stand.stop()
        truth = read_streams(stand.bag, {TRUTH.topic: TRUTH.layout})[TRUTH.topic]
    straightness, found = load_map(node_parameters("feedforward", values).stage.guide), list[dict[str, Any]]()
    for number, (plan, begin_ns, end_ns) in enumerate(runs):
        stamps = np.arange(truth.stamp[np.searchsorted(truth.stamp, begin_ns)], end_ns, period_ns)
        x, y = (np.interp(stamps, truth.stamp, truth.columns[name]) for name in ("true_x", "true_y"))
        if not number:  # the strokes
            error = straightness.evaluate(x)[0] - y
            settle, once = round(motion.settle * stage.rate), cycles(motion, 1)[-1].time_ns // period_ns
            normal = [peak_to_peak(error[k * once + settle : (k + 1) * once - settle]) for k in range(STARTS)]
            continue
        acts = [act._replace(at=round((act.at - begin_ns) / period_ns)) for act in plan.acts]
        one = judged(plan._replace(begun=plan.begun + _LATE, acts=acts), straightness, x, y)
        found.append(one | {"lost_samples": stamps.size - int(np.isin(stamps, truth.stamp).sum())})
    return normal, found

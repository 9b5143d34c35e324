"""Random motions of the stage: strokes that are held, slowed down, reversed, ended and gone on with, and jogs between,
with faults that switch the amplifier off on the way; and a step and scan of many positions. Each runs in the simulation
that computes what the graph computes in lockstep; with --live the sequences run in one running graph, one after the
other, after nine whole strokes.

A sequence passes if each stop ends within v/a + 50 ms, the true error p-p is within 1.1 of the largest of whole
strokes, over as many starts as there are sequences (of more than 300, over 300), the platform stays off its stop, and
the true r̈ has no step beyond what three times the jerk of the strokes makes of it in a sample. It begins with a move
forth and back that is not judged: when the amplifier has just been switched on the law knows no friction, and leaves
more error until the platform has slid both ways.
"""

import argparse
import random
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.metrics import SETTLED, standstill_figures
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.cli.options import add_json, add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import print_json, require_ros
from straightcomp_ros.contract import STAGE_STATE, TRUTH
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import Trajectory, Waypoint, cycles, goals, move
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, runs_of_starts
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.straightness.residual import peak_to_peak

SUMMARY = "random stops, overrides, jogs and reversals, and a step and scan of many positions"
PURPOSE = "measure"
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
Array = NDArray[np.float64]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    parser.add_argument("--sequences", type=int, default=1000, metavar="N", help="random sequences (default: 1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the first sequence (default: 1)")
    parser.add_argument("--positions", type=int, default=100, metavar="N", help="of the step and scan (default: 100)")
    parser.add_argument("--live", metavar="DIR", help="run the sequences in a running graph; bag and logs go here")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    values = chosen_parameters(options)
    motion = node_parameters("cell", values).stage.motion
    # Trapezoids have steps of their own.
    values.setdefault("stage", {})["motion.jerk"] = motion.jerk or motion.acceleration / 0.01
    seeds = range(options.seed, options.seed + options.sequences)
    if options.live:
        normal, found = live(values, seeds, Path(options.live).absolute())
    else:
        normal = whole_strokes(values, max(STARTS, min(len(seeds), _MOST_STARTS)))
        plans = (planned(values, seed) for seed in seeds)
        found = [judged(values, plan, *in_lockstep(values, plan)) for plan in plans]
    largest = max(normal)
    for seed, one in zip(seeds, found, strict=True):
        one["seed"] = seed
        if one["pp_um"] > _ERROR * largest * 1e6:
            one["failed"].append("error")
    shown: dict[str, Any] = {f"normal_{name}": number for name, number in _spread(normal).items()}
    shown["sequences"] = len(found)
    if found:
        pp = np.array([one["pp_um"] for one in found])
        shown |= {name: max(one[name] for one in found) for name in found[0] if name not in ("seed", "stops", "failed")}
        shown |= {name: sum(one[name] for one in found) for name in ("stops", "reversals", "faults")}
        shown |= _spread(pp * 1e-6)
        shown["above_1.1_of_the_median_stroke"] = int((pp > _ERROR * float(np.median(normal)) * 1e6).sum())
        shown["failures"] = sum(bool(one["failed"]) for one in found)
        shown["failed"] = [one for one in found if one["failed"]][:20]
    if options.positions:
        shown["step_and_scan"] = step_and_scan(values, options.positions)
    print_json(shown)
    raise SystemExit(1 if shown.get("failures") else 0)


def whole_strokes(values: Any, starts: int) -> list[float]:
    """True error p-p in m of the stage's own stroke, forward and back, while it moves, over so many starts."""
    runs = ((record, record.true_error(reference)) for record, reference in runs_of_starts(values, starts))
    return [peak_to_peak(error[record.motion.window]) for record, error in runs if error is not None]


def _spread(pp: Sequence[float] | Array) -> dict[str, float]:
    shares = {"median": 0.5, "95_percent": 0.95, "largest": 1.0}
    return {f"pp_um_{name}": float(np.quantile(pp, share)) * 1e6 for name, share in shares.items()}


class Plan(NamedTuple):
    """A sequence: its motion, the sample from which it is judged, paces by sample, and the samples at which the
    amplifier goes off and on again and at which the stage turns back; −1: it does not."""

    trajectory: Trajectory
    begun: int
    paces: Mapping[int, Pace]
    off: int
    on: int
    back: int


def planned(values: Any, seed: int) -> Plan:
    """Three moves between places of the stroke, some of them jogs, with rests between, after a first move forth and
    back; and what happens on the way."""
    draw, stage = random.Random(seed), node_parameters("driver", values).stage
    motion = stage.motion
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
    return Plan(Trajectory(points), begun, paces, off, on, back)


def in_lockstep(values: Any, plan: Plan) -> tuple[StraightnessMap, Array, Array, list[tuple[int, Trajectory]]]:
    """The map, true x and y (n,) in m, and when the stage turned back, with its trajectory."""
    machines, turns = list[SimulatedHardware](), list[tuple[int, Trajectory]]()
    stage = node_parameters("driver", values).stage

    def wiring(machine: SimulatedHardware) -> SimulatedHardware:
        machines.append(machine)
        return machine

    def observe(sample: Any, *_: Any) -> None:
        machine, number = machines[0], sample.stamp_ns // stage.period_ns
        if number == plan.off:
            machine.disable()
        elif number == plan.on:
            machine.enable()
        elif number == plan.back and machine.motion.moving:
            # Back to where it came from, within the acceleration of strokes.
            goal, seconds = plan.trajectory.positions[0], 1.0
            there = Trajectory([Waypoint(round(seconds * 1e9), goal, 0.0)])
            while machine.motion.joined(there, sample.stamp_ns).largest_acceleration > stage.motion.acceleration:
                seconds *= 1.1
                there = Trajectory([Waypoint(round(seconds * 1e9), goal, 0.0)])
            machine.move(there, sample.stamp_ns)
            turns.append((number, there))

    simulation = Simulation(values, motion=(plan.trajectory, 0), wiring=wiring)
    record = simulation.run(observe=observe, paces=plan.paces)
    assert record.true_x is not None and record.true_y is not None
    return simulation.map, record.true_x, record.true_y, turns


def judged(
    values: Any, plan: Plan, straightness: StraightnessMap, x: Array, y: Array, turns: list[tuple[int, Trajectory]]
) -> dict[str, Any]:
    """What a sequence did, and how it failed apart from its error; ``failed`` is empty if it did not."""
    stage = node_parameters("driver", values).stage
    motion, period = stage.motion, stage.period
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
    late, stops, others = 0.0, 0, [*plan.paces, *(number for number, _ in turns)]
    for begin, pace in plan.paces.items():
        allowed = round((abs(v[min(begin, v.size - 1)]) / motion.acceleration + _STOP_S) / period)
        until = min([other for other in others if other > begin], default=v.size)
        if (pace.hold or pace.end) and begin + allowed < min(until, v.size):
            moving = np.flatnonzero(np.abs(v[begin:until]) > _STILL)
            late = max(late, float(moving[-1] + 1 - allowed) * period + _STOP_S if moving.size else 0.0)
            stops += 1
    counted = np.ones(error.size, bool)
    counted[: plan.begun] = False
    if plan.off > 0:
        counted[plan.off : plan.on + round(_RECOVERY / period)] = False
    failed = {
        "stop": late > _STOP_S,
        "step": bool((steps > jerk + carried).any()),
        "at_stop": bool(np.abs(y).max() >= stage.platform.stop),
    }
    return {
        "stops": stops,
        "reversals": len(turns),
        "faults": int(0 < plan.off < error.size),
        "latest_stop_beyond_v_over_a_ms": late * 1e3,
        "pp_um": peak_to_peak(error[counted]) * 1e6,
        "first_move_pp_um": peak_to_peak(error[_SETTLE_NS // stage.period_ns : plan.begun]) * 1e6,
        "largest_step_of_acceleration": float(steps.max()),
        "largest_acceleration_relative": float(np.abs(a).max() / motion.acceleration),
        "failed": [name for name, one in failed.items() if one],
    }


def live(values: Any, seeds: Sequence[int], folder: Path) -> tuple[list[float], list[dict[str, Any]]]:
    """As :func:`whole_strokes` and :func:`judged`, but of one running graph."""
    require_ros()
    from diagnostic_msgs.msg import DiagnosticStatus
    from rcl_interfaces.srv import SetParametersAtomically
    from std_srvs.srv import SetBool, Trigger

    from straightcomp_ros.cell.launcher import LaunchError
    from straightcomp_ros.runtime.graph_client import message_from_waypoints
    from straightcomp_ros.runtime.safety_panel import LATCHED, tripper
    from straightcomp_ros.runtime.stage_state import StageState
    from trials.stand import Stand, request_of

    values = {**values, "driver": {**values["driver"], "blend": True}}
    stage = node_parameters("driver", values).stage
    motion, period_ns, states, runs = stage.motion, stage.period_ns, [StageState()], list[tuple[list[int], list[int]]]()
    plans = [planned(values, seed) for seed in seeds]
    turns = [in_lockstep(values, plan)[3] for plan in plans]
    with Stand(folder, values, composed=True) as stand:
        stand.node.create_subscription(
            DiagnosticStatus, STAGE_STATE, lambda message: states.append(StageState.of(message)), LATCHED
        )
        trip = tripper(stand.node)

        def wait(condition: Callable[[], bool]) -> None:
            if not stand.until(condition, _PATIENCE_S):
                raise LaunchError(f"the graph does not go on (logs in {folder})")

        def enable() -> None:
            stand.call(Trigger, "driver/reset_fault", Trigger.Request())
            wait(stand.enable)

        def ask(pace: Pace) -> None:
            if pace.end:
                stand.call(Trigger, "driver/end_motion", Trigger.Request())
                return
            if not pace.hold:
                override = request_of({"override": pace.override})
                stand.call(SetParametersAtomically, "driver/set_parameters_atomically", override)
            stand.call(SetBool, "driver/hold", SetBool.Request(data=pace.hold))

        def follow(trajectory: Trajectory, acts: Sequence[tuple[int, Callable[[], object]]] = ()) -> list[int]:
            """Run a motion, with acts so many samples after its begin; the stamps of begin, acts and end in ns."""
            number, begin_ns, stamps = states[-1].number, time.time_ns(), list[int]()
            stand.move(message_from_waypoints(trajectory.waypoints))
            for at, act in acts:
                stand.spin((begin_ns + at * period_ns - time.time_ns()) * 1e-9)
                stamps.append(time.time_ns())
                act()
            wait(lambda: states[-1].number > number and states[-1].condition == "rest")
            ask(Pace())
            return [begin_ns, *stamps, time.time_ns()]

        def acts_of(plan: Plan, turn: Sequence[tuple[int, Trajectory]]) -> list[tuple[int, Callable[[], object]]]:
            acts: list[tuple[int, Callable[[], object]]] = [(at, partial(ask, pace)) for at, pace in plan.paces.items()]
            if plan.off > 0:
                acts += [(plan.off, partial(trip, Fault.FOLLOWING_ERROR, "asked for")), (plan.on, enable)]
            acts += [(at, partial(stand.move, message_from_waypoints(there.waypoints))) for at, there in turn]
            return sorted(acts, key=itemgetter(0))

        wait(lambda: set(stand.heartbeats.states.values()) == {"active"} and len(states) > 1)
        enable()
        for plan, turn in [(None, []), *zip(plans, turns, strict=True)]:
            trajectory = plan.trajectory if plan else Trajectory(cycles(motion, STARTS))
            follow(Trajectory([Waypoint(_TO_START_NS, trajectory.positions[0], 0.0)]))
            acts = acts_of(plan, turn) if plan else []
            runs.append(([at for at, _ in acts], follow(trajectory, acts)))
        stand.stop()
        truth = read_streams(stand.bag, {TRUTH.topic: TRUTH.layout})[TRUTH.topic]
    straightness = load_map(node_parameters("feedforward", values).stage.guide)
    found = list[dict[str, Any]]()
    for plan, turn, (asked, at) in zip([None, *plans], [[], *turns], runs, strict=True):
        stamps = np.arange(truth.stamp[np.searchsorted(truth.stamp, at[0])], at[-1], period_ns)
        x, y = (np.interp(stamps, truth.stamp, truth.columns[name]) for name in ("true_x", "true_y"))
        if plan is None:
            error = straightness.evaluate(x)[0] - y
            settle, once = round(motion.settle * stage.rate), cycles(motion, 1)[-1].time_ns // period_ns
            normal = [peak_to_peak(error[k * once + settle : (k + 1) * once - settle]) for k in range(STARTS)]
            continue
        index = {sample: round((one - at[0]) / period_ns) for sample, one in zip(asked, at[1:], strict=False)}
        paces = {index[sample]: pace for sample, pace in plan.paces.items()}
        happened = plan._replace(
            begun=plan.begun + _LATE, paces=paces, off=index.get(plan.off, -1), on=index.get(plan.on, -1)
        )
        one = judged(values, happened, straightness, x, y, [(index[sample], there) for sample, there in turn])
        lost = stamps.size - int(np.isin(stamps, truth.stamp).sum())
        found.append(one | {"lost_samples": lost})
    return normal, found


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

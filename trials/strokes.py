"""Run many strokes of the whole graph in real time, in turns, and say what each condition costs in accuracy.

The conditions are all combinations of --graphs (separate processes, or driver, feedforward and controller in one),
--loads (quiet, or with four busy processes and one that writes to the disk without a pause) and --priorities. With
--pair the machine of a second stage file runs too: each stage alone, then both at once, in two namespaces. Exit code 1
if a stroke failed, or if a stage has more than 1.2 times its error alone while the other moves. The errors without what
the stalls of the host disturbed say whether it was the host: one of virtual machines stalls them more often where all
of their CPUs work. Run it on a computer at rest; a stroke takes half a minute. Bags are in --output, by condition."""

import argparse
import itertools
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.cell.demonstration import DemonstrationFailed, judged, recorded
from straightcomp_ros.cell.launcher import isolated_environment
from straightcomp_ros.cli.options import add_parameter_options, check_range, chosen_parameters, whole_number
from straightcomp_ros.cli.output import print_json, require_ros
from straightcomp_ros.offline.starts import spread, with_values
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, Values
from trials.rig import add_output, output, tracked

SUMMARY = "accuracy of live strokes: composed or separate, loaded or quiet, one stage or two"
GRAPHS, LOADS = ("separate", "composed"), ("quiet", "busy")
BUSY = 4
ERRORS = "true_pp_um", "undisturbed_pp_um"
"""Of a stroke, the second one without what the stalls of the host disturbed."""
FIGURES = (*ERRORS, "control_rms_step_A", "latency_p50_us", "latency_p99_us")
LARGEST_RATIO = 1.2
"""Of a stage's median error while another stage moves to that alone."""
_WRITE = """
import os, sys
while True:
    with open(sys.argv[1], "wb") as file:
        for _ in range(64):
            file.write(bytes(1 << 20))
        os.fsync(file.fileno())
"""


class Condition(NamedTuple):
    """What a stroke runs under: ``stages`` are those that move at once, by name."""

    load: str
    priority: int
    graph: str
    stages: tuple[str, ...]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    runs = "strokes of each condition (default: %(default)s)"
    add("--runs", type=whole_number(1), default=10, metavar="N", help=runs)
    add("--graphs", nargs="+", choices=GRAPHS, default=GRAPHS, help="default: both")
    add("--loads", nargs="+", choices=LOADS, default=LOADS, help="default: both")
    priorities = "SCHED_FIFO priorities, 0 for none (default: 40 0)"
    add("--priorities", nargs="+", type=int, default=(40, 0), metavar="P", help=priorities)
    add("--pair", metavar="FILE", help="stage file of a second machine: each alone, and both at once")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Exit code 1 if a stroke failed or a pair disturbs each other."""
    require_ros()
    for priority in options.priorities:
        check_range("--priorities", priority, 0, 98)
    stages, moving = {"a": chosen_parameters(options)}, [("a",)]
    if options.pair:
        stages["b"] = chosen_parameters(argparse.Namespace(**{**vars(options), "stage": options.pair}))
        moving += [("b",), ("a", "b")]
    # Those that are compared come one right after the other.
    wanted = itertools.product(options.loads, options.priorities, options.graphs, moving)
    turns = list(itertools.product(range(1, options.runs + 1), itertools.starmap(Condition, wanted)))
    strokes, failures = defaultdict[tuple[Condition, str], list[Mapping[str, Any]]](list), list[str]()
    with output(options) as folder:
        for turn, condition in tracked(turns, "strokes"):
            words = condition.graph, condition.load, str(condition.priority), *condition.stages
            place = folder / "_".join(words) / str(turn)
            try:
                for stage, stroke in run_together(condition, stages, place).items():
                    strokes[condition, stage].append(stroke)
            except DemonstrationFailed as error:
                failures.append(f"{place.relative_to(folder)}: {error}")
    rows = {key: row(*key, found) for key, found in strokes.items()}
    for (condition, stage), one in rows.items():
        alone = rows.get((condition._replace(stages=(stage,)), stage))
        if len(condition.stages) > 1 and alone:
            one["ratio_to_alone"] = {error: one[error]["median"] / alone[error]["median"] for error in ERRORS}
    ratios = [one["ratio_to_alone"][ERRORS[0]] for one in rows.values() if "ratio_to_alone" in one]
    good = not failures and all(ratio <= LARGEST_RATIO for ratio in ratios)
    print_json({"rows": [*rows.values()], "failures": failures, "passed": good})
    return int(not good)


def run_together(condition: Condition, stages: Mapping[str, Values], folder: Path) -> dict[str, dict[str, Any]]:
    """Figures of one stroke of each stage of ``condition``, all at once; evaluated when all have ended.

    Raises:
        DemonstrationFailed: a graph failed.
    """
    chosen = {stage: at_priority(stages[stage], condition.priority) for stage in condition.stages}
    folder.mkdir(parents=True)
    make = partial(recorded, environment=isolated_environment(), composed=condition.graph == "composed")
    # A process for each: a graph's nodes end with the thread that has started them.
    with loaded(condition.load == "busy", folder), ProcessPoolExecutor(len(chosen), get_context("spawn")) as pool:
        graphs = [pool.submit(make, values, folder / stage, namespace=stage) for stage, values in chosen.items()]
    for graph in graphs:
        graph.result()
    found = {stage: judged(values, folder / stage) for stage, values in chosen.items()}
    return {stage: one.figures() | {"stalls": len(one.evaluation.stalls)} for stage, one in found.items()}


def at_priority(values: Values, priority: int) -> Values:
    """``values`` with this SCHED_FIFO priority for all nodes; 0: no real-time scheduling, nor CPUs that stay awake."""
    for node in NODE_PARAMETERS:
        values = with_values(values, node, {"realtime.priority": priority})
    return values if priority else with_values(values, "driver", {"realtime.keep_awake": False})


@contextmanager
def loaded(busy: bool, folder: Path) -> Iterator[None]:
    """Busy processes and one that writes to the disk, in sessions of their own like another user's programs."""
    commands = [[sys.executable, "-c", "while True: pass"]] * BUSY
    commands.append([sys.executable, "-c", _WRITE, str(folder / "written")])
    with ExitStack() as stack:
        for command in commands if busy else ():
            process = stack.enter_context(subprocess.Popen(command, start_new_session=True))
            stack.callback(process.kill)
        yield
    (folder / "written").unlink(missing_ok=True)


def row(condition: Condition, stage: str, strokes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the strokes of one stage under one condition left; the reasons are those of strokes not in order."""
    return {
        **condition._asdict(),
        "stage": stage,
        "strokes": len(strokes),
        **{name: spread(one[name] for one in strokes)._asdict() for name in FIGURES},
        **{name: sum(one[name] for one in strokes) for name in ("lost_samples", "stalls")},
        "not_in_order": [f"{one['verdict']}: {one['reason']}" for one in strokes if one["verdict"] != "in_order"],
        "held_up": [one["held_up"] for one in strokes if one["held_up"]],
    }

"""The whole graph once: five nodes as processes, one cycle of the stage, a bag, and its evaluation."""

from __future__ import annotations

import select
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag
from straightcomp_ros.analysis.metrics import Metrics, MetricsError, evaluate
from straightcomp_ros.bags import BagError
from straightcomp_ros.configuration import node_parameters
from straightcomp_ros.hardware.can.budget import HEARTBEAT_PERIOD
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.launcher import Graph, LaunchError, exit_words, verb_command
from straightcomp_ros.model.stage import forward_and_back
from straightcomp_ros.straightness.map import StraightnessMap, load_map

_RECORDED = ("driver", "feedforward", "controller", "logger")
_SLACK_S = 90.0
"""Start, discovery and a busy machine, beyond the duration of the cycle itself."""


class DemonstrationFailed(RuntimeError):
    """The run is not what was asked for; the message says which node or which figure, and why."""


@dataclass(frozen=True)
class Demonstration:
    """A finished run: its bag, what it holds, and the figures."""

    bag: Path
    evaluation: BagEvaluation
    map: StraightnessMap
    metrics: Metrics

    def figures(self) -> dict[str, Any]:
        """Display values by name, as `straightcomp demo --json` prints them."""
        evaluation = self.evaluation
        return {
            "law": evaluation.record.law,
            "expected_samples": evaluation.expected_samples,
            "received_samples": evaluation.received_samples,
            "lost_samples": evaluation.lost_samples,
            "lost_commands": evaluation.lost_commands,
            **self.metrics.to_display(),
            "latency_p50_us": evaluation.latency_us(50),
            "latency_p99_us": evaluation.latency_us(99),
            "bag": str(self.bag),
        }


def demonstrate(
    values: Mapping[str, Mapping[str, Any]], output: Path, progress: Callable[[float], None] = lambda fraction: None
) -> Demonstration:
    """Run the graph for one cycle and evaluate the bag.

    Args:
        values: parameters by node and dotted name.
        output: folder that gets ``bag/``, ``logs/`` and ``parameters.yaml``; an earlier bag there is replaced.
        progress: called with the fraction of the cycle that is done.

    Raises:
        DemonstrationFailed: a node died, the cycle failed, or the bag is short.
        ParameterError: a parameter is refused.
        SurveyError: the map is refused.
    """
    bag, parameter_file = output / "bag", output / "parameters.yaml"
    duration = forward_and_back(node_parameters("cell", values["cell"]).motion)[-1].time_ns * 1e-9
    straightness = load_map(node_parameters("feedforward", values["feedforward"]).map)
    output.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(bag, ignore_errors=True)
    parameter_file.write_text(_as_parameter_file(values))
    machine = _emulated_machine(values["driver"], parameter_file)
    _run_graph(bag, parameter_file, output / "logs", duration, progress, machine)
    try:
        evaluation = evaluate_bag(bag)
        metrics = evaluate(evaluation.record, straightness)
    except (BagError, MetricsError) as error:
        raise DemonstrationFailed(str(error)) from error
    recorded = float(evaluation.record.time[-1])
    if recorded < 0.99 * duration:
        raise DemonstrationFailed(f"bag {bag} is short: {recorded:.1f} s of a cycle of {duration:.1f} s")
    return Demonstration(bag, evaluation, straightness, metrics)


def _as_parameter_file(values: Mapping[str, Mapping[str, Any]]) -> str:
    # An empty section is refused by rcl.
    tree = {f"/**/{node}": {"ros__parameters": dict(section)} for node, section in values.items() if section}
    return yaml.safe_dump(tree, sort_keys=False)


def on_hub(driver: Mapping[str, Any], socket: str) -> dict[str, Any]:
    """Parameters that take the driver's machine out of its process, to an emulated board on a hub at ``socket``."""
    simulated = node_parameters("driver", driver).simulated
    timeout = simulated.command_timeout
    return {
        "hardware": "can",
        "can.interface": INTERFACE,
        "can.channel": socket,
        "can.simulated_stage": True,
        "can.rate": simulated.rate,
        # A board that forgives a stalled desktop needs a driver that does.
        "can.command_timeout": timeout,
        "can.sample_timeout": timeout,
        "can.heartbeat_timeout": max(timeout, 3.0 * HEARTBEAT_PERIOD),
    }


def _emulated_machine(driver: Mapping[str, Any], parameter_file: Path) -> dict[str, list[str]]:
    """Programs that stand for the bus and the board where the driver's bus is a hub."""
    parameters = node_parameters("driver", driver)
    if parameters.hardware != "can" or parameters.can.interface != INTERFACE:
        return {}
    return {
        "hub": verb_command("can", "hub", "--socket", parameters.can.channel),
        "board": verb_command("dsp", "--params-file", str(parameter_file)),
    }


def _run_graph(
    bag: Path,
    parameter_file: Path,
    logs: Path,
    duration: float,
    progress: Callable[[float], None],
    machine: Mapping[str, Sequence[str]],
) -> None:
    try:
        with Graph(logs) as graph:
            for name, command in machine.items():
                graph.start_program(name, command)
            for name in _RECORDED:
                extra = {"output": str(bag)} if name == "logger" else {}
                graph.start(name, extra, parameter_file)
            cell = graph.start("cell", {"progress": True}, parameter_file, read_output=True)
            _follow(graph, cell, (*machine, *_RECORDED), time.monotonic() + duration + _SLACK_S, progress)
            codes = graph.stop(_RECORDED)
            if codes["logger"] != 0:
                raise LaunchError(f"logger: {exit_words(codes['logger'])}: {graph.last_words('logger')}")
            # The bag is complete and the amplifier off by now: how the others ended does not touch the result.
            for name, code in codes.items():
                if code != 0:
                    print(f"node '{name}' did not stop cleanly: {exit_words(code)}", file=sys.stderr)
    except LaunchError as error:
        raise DemonstrationFailed(f"{error} (logs in {logs})") from error


def _follow(
    graph: Graph, cell: Any, watched: Sequence[str], deadline: float, progress: Callable[[float], None]
) -> None:
    """Pass the cell's progress on until it ends; raise LaunchError if it or another node fails."""
    while cell.poll() is None:
        graph.check(watched)
        if time.monotonic() > deadline:
            raise LaunchError("the cycle did not end in time")
        if select.select([cell.stdout], [], [], 0.2)[0]:
            word, _, fraction = cell.stdout.readline().partition(" ")
            if word == "progress":
                progress(float(fraction))
    if cell.returncode != 0:
        raise LaunchError(f"cell: {graph.last_words('cell')}")

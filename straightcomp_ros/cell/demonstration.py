"""Demonstrates the whole graph: five nodes as processes, one cycle of the stage, a bag, and its evaluation."""

import math
import secrets
import socket
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag, percentile_us
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import Metrics, evaluate
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.cell.cell_sequence import check_strokes
from straightcomp_ros.cell.launcher import (
    IN_THE_LOOP,
    RECORDED,
    LaunchError,
    executable_command,
    in_namespace,
    isolated_environment,
    run_cycle,
    verb_command,
)
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.model.motion import cycles
from straightcomp_ros.opcua.admission import OPERATOR, OpcuaParameters, add_user
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import Values, by_node, node_parameters
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.timing.node_timing import (
    NORMAL,
    REFUSED,
    NodeTiming,
    amplifier_on,
    blamed,
    held_up,
    summarise,
)

_USER, _PASSWORD = "demo", "STRAIGHTCOMP_OPCUA_PASSWORD"


class DemonstrationFailed(RuntimeError):
    """The run failed or its bag is incomplete; the message names the node or the figure, and the reason. ``held_up``
    says what delayed the nodes in the loop meanwhile; empty if nothing did for long."""

    def __init__(self, message: str, held_up: str = "") -> None:
        super().__init__(message)
        self.held_up = held_up


@dataclass(frozen=True)
class Demonstration:
    """A finished run: bag, evaluation, map, figures, the error p-p in m without what the stalls of the host disturbed,
    each node's timing while the amplifier was on, and the verdict."""

    bag: Path
    evaluation: BagEvaluation
    map: StraightnessMap
    metrics: Metrics
    undisturbed_pp: float
    timing: Mapping[str, NodeTiming]
    verdict: Verdict
    unclean: Sequence[str] = ()  # a sentence for each node that did not stop by itself

    def figures(self) -> dict[str, Any]:
        """Display values by name, as printed by `straightcomp demo --json`."""
        evaluation = self.evaluation
        return {
            "law": evaluation.record.law,
            "expected_samples": evaluation.expected_samples,
            "received_samples": evaluation.received_samples,
            "lost_samples": evaluation.lost_samples,
            "lost_commands": evaluation.lost_commands,
            **self.metrics.to_display(),
            "undisturbed_pp_um": self.undisturbed_pp * 1e6,
            "latency_p50_us": percentile_us(evaluation.latency, 50),
            "latency_p99_us": percentile_us(evaluation.latency, 99),
            "bag": str(self.bag),
            "timing": {node: timing.to_display() for node, timing in self.timing.items()},
            "held_up": self.held_up,
            **self.verdict._asdict(),
        }

    @property
    def held_up(self) -> str:
        """What delayed the nodes in the loop while the amplifier was on; empty if nothing did for long."""
        return blamed({node: timing.held_up for node, timing in self.timing.items() if node in IN_THE_LOOP})

    @property
    def by_priority(self) -> bool:
        """Whether the system gave real-time priority to every node in the loop."""
        loop = [timing for node, timing in self.timing.items() if node in IN_THE_LOOP]
        return bool(loop) and all(timing.held_up.scheduling not in ("", NORMAL, REFUSED) for timing in loop)


def demonstrate(values: Values, output: Path, *, opcua_strokes: int = 0, **running: Any) -> Demonstration:
    """Run the graph for one cycle, as of :func:`recorded`, and evaluate the bag: :func:`judged`."""
    unclean = recorded(values, output, opcua_strokes=opcua_strokes, **running)
    return judged(values, output, opcua_strokes, unclean)


def recorded(
    values: Values,
    output: Path,
    *,
    progress: Callable[[float], None] = lambda fraction: None,
    opcua_strokes: int = 0,
    namespace: str = "",
    environment: Mapping[str, str] | None = None,
    composed: bool = False,
) -> list[str]:
    """Run the graph for one cycle; returns a sentence for each node that did not stop by itself.

    Args:
        values: parameters of all nodes.
        output: folder that gets ``bag/``, ``logs/`` and ``parameters.yaml``; made if need be. There must be no bag.
        progress: called with the finished fraction of the cycle.
        opcua_strokes: strokes that a client of the OPC UA gateway runs; 0: the cell runs its own number.
        environment: of the nodes, as of :func:`~straightcomp_ros.cell.launcher.run_cycle`.
        composed: run driver, feedforward and controller in one process.

    Raises:
        DemonstrationFailed: a node died, or the cycle failed.
        ParameterError, SurveyError: a parameter, or the map's survey file, is refused.
    """
    bag, logs, parameter_file = output / "bag", output / "logs", output / "parameters.yaml"
    duration, _ = planned(values, opcua_strokes)
    output.mkdir(parents=True, exist_ok=True)
    environment, programs = dict(environment or isolated_environment()), emulated_machine(values, parameter_file)
    client = None
    try:
        with tempfile.TemporaryDirectory(prefix="straightcomp_") as folder:
            if opcua_strokes:
                # On a command line every user could read the password.
                environment[_PASSWORD] = password = secrets.token_urlsafe(16)
                values, client = _driven_by_opcua(values, Path(folder) / "users", opcua_strokes, password)
                programs["opcua"] = [*executable_command("opcua_node"), "--ros-args", *in_namespace(namespace)]
                programs["opcua"] += ["--params-file", str(parameter_file)]
            write_whole(parameter_file, as_parameter_file(values))
            return run_cycle(
                bag,
                parameter_file,
                logs,
                duration,
                progress,
                programs=programs,
                in_place_of_cell=client,
                namespace=namespace,
                environment=environment,
                composed=composed,
            )
    except LaunchError as error:
        raise DemonstrationFailed(f"{error} (logs in {logs})", _held_up(bag)) from error


def judged(values: Values, output: Path, opcua_strokes: int = 0, unclean: Sequence[str] = ()) -> Demonstration:
    """Evaluate what :func:`recorded` recorded in the folder ``output``.

    Raises:
        DemonstrationFailed: the bag cannot be read, or is short.
    """
    bag, motion = output / "bag", node_parameters("cell", values).stage.motion
    duration, straightness = planned(values, opcua_strokes)
    try:
        evaluation = evaluate_bag(bag)
        record = evaluation.record
        metrics, reports = evaluate(record, straightness), evaluation.reports
    except (BagError, MetricsError) as error:
        raise DemonstrationFailed(str(error)) from error
    recorded = float(record.time[-1])
    # The gateway rests for the pause between strokes, and its client chooses when to switch on and off.
    least = 0.99 * duration - 2.0 * motion.settle * opcua_strokes
    if recorded < least:
        raise DemonstrationFailed(f"bag {bag} is short: {recorded:.1f} s of a cycle of {duration:.1f} s")
    begin_ns, end_ns = amplifier_on(reports.get("driver", []))
    timing = {node: summarise(reports.get(node, []), begin_ns, end_ns) for node in RECORDED}
    partial = evaluation.partial()
    late = evaluation.stalls, evaluation.latency
    run = judged_motion(record, straightness, by_node(values), straightness, *late)
    verdict = partial or verdict_of(run)
    return Demonstration(bag, evaluation, straightness, metrics, run.undisturbed, timing, verdict, unclean)


def planned(values: Values, opcua_strokes: int) -> tuple[float, StraightnessMap]:
    """Duration of the cycle in s, and the map. Raises as :func:`recorded` for what it refuses."""
    cell = node_parameters("cell", values)
    if not opcua_strokes:
        check_strokes(cell.stage.motion, cell.strokes)
    duration = cycles(cell.stage.motion, opcua_strokes or cell.strokes)[-1].time_ns * 1e-9
    return duration, load_map(cell.stage.guide)


def _held_up(bag: Path) -> str:
    """What delayed the nodes of a run that failed, as far as its bag shows."""
    try:
        reports = read_reports(bag)
    except BagError:
        return ""
    return blamed({node: held_up([one.values for one in reports.get(node, [])]) for node in IN_THE_LOOP})


def _driven_by_opcua(values: Values, users: Path, strokes: int, password: str) -> tuple[Values, list[str]]:
    """Parameters with a gateway for this run alone, whose file of ``users`` is made here, and the command of a client
    that runs ``strokes``."""
    add_user(users, _USER, password, OPERATOR)
    port = free_port()
    gateway = {**values.get("opcua", {}), "opcua.users": str(users), "opcua.port": port}
    url = OpcuaParameters(port=port).endpoint
    client = verb_command("opcua", "cycle", "--url", url, "--user", _USER, "--strokes", str(strokes), "--progress")
    return {**values, "opcua": gateway}, client


def free_port() -> int:
    """A TCP port of this computer on which no program listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def on_hub(values: Values, socket: str) -> dict[str, Any]:
    """Driver parameters that replace its simulated machine by an emulated board on a hub at ``socket``."""
    driver = node_parameters("driver", values)
    timeout = driver.simulated.command_timeout
    state, beat = driver.can.make_wire().intervals(driver.stage.rate)
    most = {one.name: one.maximum or math.inf for one in declarations(CanParameters)}
    return {
        "hardware": "can",
        "can.interface": INTERFACE,
        "can.channel": socket,
        "can.simulated_stage": True,
        # As long as the board's own, which tolerates a stalled desktop, and as its frames need.
        "can.command_timeout": timeout,
        "can.sample_timeout": timeout,
        "can.heartbeat_timeout": min(max(timeout, 3.0 * beat, 3.0 * state), most["heartbeat_timeout"]),
        "can.answer_timeout": min(max(driver.can.answer_timeout, 3.0 * state), most["answer_timeout"]),
    }


def emulated_machine(values: Values, parameter_file: Path) -> dict[str, list[str]]:
    """Commands by name of the programs that emulate the board and its bus; empty unless the bus is a hub."""
    parameters = node_parameters("driver", values)
    on_a_hub = parameters.hardware == "can" and parameters.can.interface == INTERFACE
    return {"board": verb_command("dsp", "--hub", "--params-file", str(parameter_file))} if on_a_hub else {}

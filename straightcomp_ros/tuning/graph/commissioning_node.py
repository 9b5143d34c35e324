"""commissioning: runs the steps of commissioning and frequency responses on the graph when a cell asks for them.

A process of its own does the work, since it may compute for minutes and may be interrupted at any time. This node
starts it, reports how it goes, and interrupts it.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.task import Future
from std_srvs.srv import Trigger

import straightcomp_ros.nodes  # noqa: F401 - before NumPy: one thread of OpenBLAS
from straightcomp_ros.contract import COMMISSIONING_STATE
from straightcomp_ros.control.excitation import MultisineParameters
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import CommissioningNodeParameters, node_parameters
from straightcomp_ros.parameters.output_files import making
from straightcomp_ros.runtime.guarded_node import GuardedNode, Refused
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.ros_parameters import declare
from straightcomp_ros.runtime.runner import Runnable, run
from straightcomp_ros.runtime.safety_panel import LATCHED
from straightcomp_ros.timing.node_timing import SAMPLES
from straightcomp_ros.tuning.commissioning import STEP_NAMES, CommissioningError

_LOOK_S = 0.1
_STOP_WITHIN_S = 30.0
_LONGEST_REASON = 2000
_ACCEPTANCE = "acceptance"
_PLOT = "frequency_response.png"


class Result(NamedTuple):
    """How the work ended."""

    good: bool
    sentence: str


class CommissioningNode(Runnable):
    """Provides ``~/run`` and ``~/stop``, ``~/measure_response``, and each step of commissioning by its name."""

    def __init__(self, node: GuardedNode) -> None:
        self._parameters = parameters = declare(node, CommissioningNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        if not parameters.output:
            raise ParameterError("parameter 'output' is empty; allowed: a folder for the record and the bags")
        self._folder = Path(parameters.output).resolve()
        self._folder.mkdir(parents=True, exist_ok=True)
        self._process: BaseProcess | None = None
        self._doing, self._answers = "", 0
        self._publisher = node.create_publisher(DiagnosticStatus, COMMISSIONING_STATE, LATCHED)
        node.offer(Trigger, "~/run", self._on_run)
        node.offer(Trigger, "~/stop", self._on_stop)
        node.offer(Trigger, "~/measure_response", self._on_measure_response)
        for step in STEP_NAMES:
            node.offer(Trigger, f"~/{step}", partial(self._on_step, step))
        node.create_timer(_LOOK_S, self._look)
        Diagnostics(node, lambda: {SAMPLES: self._answers, "doing": self._doing})
        self._report("", True, "ready")

    def _on_run(self) -> str:
        """Do all steps that have not passed; the topic `commissioning_state` reports how it goes."""
        return self._begin("all steps", partial(commission, self._parameters, ""))

    def _on_step(self, step: str) -> str:
        """Do one step of commissioning alone, even if it is done: `connection` and so on."""
        return self._begin(step, partial(commission, self._parameters, step))

    def _on_measure_response(self) -> str:
        """Measure the frequency response under the controller's present law, with plots in the output folder."""
        return self._begin("measure_response", measure_response)

    def _on_stop(self) -> str:
        """End what is going on, with the amplifier off."""
        if not self._interrupt():
            raise Refused("nothing is going on")
        return f"stops {self._doing}"

    def _begin(self, doing: str, work: Callable[[Path, str], Result]) -> str:
        if self._process is not None:
            raise Refused(f"{self._doing} is going on; ~/stop ends it")
        # A new interpreter: a copy of this process would share its ROS context.
        new = multiprocessing.get_context("spawn")
        self._answer, answer = new.Pipe(duplex=False)
        namespace = self.node.get_namespace().strip("/")
        self._process = new.Process(target=_work, args=(work, self._folder, namespace, answer))
        self._process.start()
        answer.close()
        self._doing = doing
        self._report(doing, True, "is going on", running=True)
        return f"begins {doing}"

    def _interrupt(self) -> bool:
        if self._process is None or self._process.pid is None:
            return False
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGINT)
        return True

    def _look(self) -> None:
        if self._process is None or self._process.is_alive():
            return
        result = Result(False, f"its process ended with exit code {self._process.exitcode}")
        with contextlib.suppress(EOFError):
            if self._answer.poll():
                result = Result(*self._answer.recv())
        doing, self._process, self._doing = self._doing, None, ""
        self._answers += 1
        self._report(doing, *result)

    def _report(self, doing: str, good: bool, message: str, running: bool = False) -> None:
        level = DiagnosticStatus.OK if good else DiagnosticStatus.ERROR
        values = [KeyValue(key="running", value=str(running).lower())]
        self._publisher.publish(DiagnosticStatus(level=level, name=doing, message=message, values=values))
        words = f"{doing}: {message}" if doing else message
        # Not in one line: rclpy lets each line log with one severity only.
        if good:
            self.node.get_logger().info(words)
        else:
            self.node.get_logger().error(words)

    def close(self) -> None:
        """End what is going on; it leaves the amplifier off."""
        if self._process is None or not self._interrupt():
            return
        self._process.join(_STOP_WITHIN_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def commission(parameters: CommissioningNodeParameters, step: str, folder: Path, namespace: str) -> Result:
    """Do one step of commissioning on the running graph, or without a name all steps that have not passed."""
    # Only here: the steps import all of the design.
    from straightcomp_ros.tuning.commissioning import MADE
    from straightcomp_ros.tuning.commissioning.procedure import Procedure
    from straightcomp_ros.tuning.graph.machine_access import running_graph

    sentence = "all steps have been done"
    with making(folder, MADE, anew=False), running_graph(folder, namespace) as (machine, values, tell):
        procedure = Procedure(
            machine,
            values,
            folder,
            evaluations=parameters.evaluations,
            machines=parameters.machines,
            learning_strokes=parameters.learn,
        )
        done = procedure.outcomes.get(_ACCEPTANCE)
        if not step and parameters.learn and done is not None and done.passed and not done.gains:
            raise CommissioningError(
                f"parameter 'learn': step '{_ACCEPTANCE}' has passed without it; ~/{_ACCEPTANCE} repeats it"
            )
        for name in [step] if step else procedure.remaining():
            tell(name)
            outcome = procedure.run(name)
            sentence = outcome.sentence
            if not outcome.passed:
                return Result(False, sentence)
    return Result(True, sentence)


def measure_response(folder: Path, namespace: str) -> Result:
    """Measure the frequency response under the controller's present law and plot it."""
    # Only here: both import much.
    from straightcomp_ros.tuning.frequency_response.response_plot import plot_response
    from straightcomp_ros.tuning.graph.machine_access import running_graph

    plot = folder / _PLOT
    bags = plot.with_name(f"{plot.stem}_graph")
    with (
        making(bags, ("bags", "logs", "parameters.yaml"), force=True) as place,
        running_graph(place, namespace) as (machine, values, tell),
    ):
        tell("frequency response")
        found = machine.response(values, MultisineParameters())
    name = node_parameters("controller", values).stage.name
    plot_response(found, plot, f"Stage '{name}' under law '{found.law}'")
    return Result(found.explained, f"the description {'explains' if found.explained else 'does not explain'} the plant")


def _work(work: Callable[[Path, str], Result], folder: Path, namespace: str, answer: Connection) -> None:
    """The other process: do ``work``, send its result, and log what it prints."""
    with (folder / "commissioning.log").open("w") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
    signal.signal(signal.SIGINT, _stop)
    try:
        result = work(folder, namespace)
    except KeyboardInterrupt:
        result = Result(False, "interrupted; the amplifier is off")
    except Exception as error:
        # The node reports an error of any kind.
        traceback.print_exc()
        result = Result(False, (str(error) or type(error).__name__)[:_LONGEST_REASON])
    answer.send(tuple(result))


def _stop(*_: object) -> None:
    # A second request must not interrupt what the first has begun: to release the machine.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros commissioning_node`."""
    return run("commissioning", CommissioningNode)


if __name__ == "__main__":
    sys.exit(main())

"""commissioning: runs the verbs `commission` and `frequency-response` on the graph when a cell asks for them.

A process of its own does the work, since it may compute for minutes and may be interrupted at any time. This node
starts it, reports how it goes, and interrupts it.
"""

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.task import Future
from std_srvs.srv import Trigger

import straightcomp_ros.nodes  # noqa: F401 - the verbs inherit it: one thread of OpenBLAS
from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.contract import COMMISSIONING_STATE, SAFETY_STATE
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import CommissioningNodeParameters
from straightcomp_ros.runtime.guarded_node import GuardedNode, Refused
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.ros_parameters import declare
from straightcomp_ros.runtime.runner import Runnable, run
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.timing.node_timing import SAMPLES
from straightcomp_ros.tuning.commissioning import STEP_NAMES

_LOOK_S = 0.1
_STOP_WITHIN_S = 30.0
_LONGEST_REASON = 2000
_PLOT = "frequency_response.png"
_INTERRUPTED = (128 + signal.SIGTERM, -signal.SIGTERM)
"""Exit codes of a verb that was terminated: after it has released the machine, or before it had one."""


class _Work(NamedTuple):
    """What is going on: its name, its process, and the files of the process's standard output and error."""

    doing: str
    process: subprocess.Popen[bytes]
    printed: IO[bytes]
    log: IO[str]


class CommissioningNode(Runnable):
    """Provides ``~/run`` and ``~/stop``, ``~/measure_response``, and each step of commissioning by its name."""

    def __init__(self, node: GuardedNode) -> None:
        self._parameters = parameters = declare(node, CommissioningNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        if not parameters.output:
            raise ParameterError("parameter 'output' is empty; allowed: a folder for the record and the bags")
        self._folder = Path(parameters.output).resolve()
        self._folder.mkdir(parents=True, exist_ok=True)
        self._work: _Work | None = None
        self._answers, self._amplifier = 0, ""
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        self._publisher = node.create_publisher(DiagnosticStatus, COMMISSIONING_STATE, LATCHED)
        node.offer(Trigger, "~/run", self._on_run)
        node.offer(Trigger, "~/stop", self._on_stop)
        node.offer(Trigger, "~/measure_response", self._on_measure_response)
        for step in STEP_NAMES:
            node.offer(Trigger, f"~/{step}", partial(self._on_step, step))
        node.create_timer(_LOOK_S, self._look)
        Diagnostics(node, lambda: {SAMPLES: self._answers, "doing": self._work.doing if self._work else ""})
        self._report("", True, "ready")

    def _on_run(self) -> str:
        """Do all steps that have not passed; the topic `commissioning_state` reports how it goes."""
        return self._begin("all steps", "commission", **self._of_commission())

    def _on_step(self, step: str) -> str:
        """Do one step of commissioning alone, even if it is done: `connection` and so on."""
        return self._begin(step, "commission", only=step, **self._of_commission())

    def _on_measure_response(self) -> str:
        """Measure the frequency response under the controller's present law, with plots in the output folder."""
        return self._begin("measure_response", "frequency-response", "--force", output=self._folder / _PLOT)

    def _on_stop(self) -> str:
        """End what is going on; an amplifier that it switched on goes off."""
        if self._work is None:
            raise Refused("nothing is going on")
        self._work.process.terminate()
        return f"stops {self._work.doing}"

    def _of_commission(self) -> dict[str, Any]:
        chosen = self._parameters
        numbers = {"evaluations": chosen.evaluations, "machines": chosen.machines, "learn": chosen.learn}
        return {"output": self._folder, **numbers}

    def _begin(self, doing: str, verb: str, *words: str, **options: object) -> str:
        if self._work is not None:
            raise Refused(f"{self._work.doing} is going on; ~/stop ends it")
        if namespace := self.node.get_namespace().strip("/"):
            options["namespace"] = namespace
        given = [f"--{name}={value}" for name, value in options.items()]
        try:
            # Both are read at the end, wherever the output folder is then.
            printed = tempfile.TemporaryFile()  # noqa: SIM115
            log = (self._folder / "commissioning.log").open("w+", errors="replace")
            process = subprocess.Popen(
                verb_command(verb, "--graph=running", "--json", *words, *given),
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=log,
                # An interrupt from the terminal is for this node, which then ends the verb.
                start_new_session=True,
            )
        except OSError as error:
            raise Refused(f"{doing} cannot begin: {error}") from error
        self._work = _Work(doing, process, printed, log)
        self._report(doing, True, "is going on", running=True)
        return f"begins {doing}"

    def _look(self) -> None:
        work = self._work
        if work is None or work.process.poll() is None:
            return
        self._work = None
        self._answers += 1
        self._report(work.doing, *self._result(work))

    def _result(self, work: _Work) -> tuple[bool, str]:
        """Whether the work, which has ended, went well, and a sentence about it."""
        found, code = dict[str, Any](), work.process.returncode
        with work.printed as printed, work.log as log:
            printed.seek(0)
            log.seek(0)
            lines = log.read().splitlines()
            with contextlib.suppress(ValueError):
                found = json.load(printed)
        if code in _INTERRUPTED:
            # It may have ended before it had the machine: then the amplifier is as another client left it.
            return False, f"interrupted{self._amplifier}"
        if "steps" in found:
            sentences = [step["sentence"] for step in found["steps"].values()]
            return code == 0, sentences[-1] if sentences else "all steps have been done"
        if "model_explains_the_plant" in found:
            explains = found["model_explains_the_plant"]
            return explains, f"the description {'explains' if explains else 'does not explain'} the plant"
        # Its last line is "straightcomp VERB: sentence".
        said = lines[-1].partition(": ")[2][:_LONGEST_REASON] if code > 0 and lines else ""
        return False, said or f"it ended with exit code {code}"

    def _on_safety_state(self, message: DiagnosticStatus) -> None:
        amplifier = "on" if SafetyState.of(message).amplifier_on else "off"
        self._amplifier = f"; the driver last reported the amplifier {amplifier}"

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
        """End what is going on; an amplifier that it switched on goes off."""
        if self._work is None:
            return
        process = self._work.process
        process.terminate()
        try:
            process.wait(_STOP_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


main = partial(run, "commissioning", CommissioningNode)
"""Entry point of `ros2 run straightcomp_ros commissioning_node`."""


if __name__ == "__main__":
    sys.exit(main())

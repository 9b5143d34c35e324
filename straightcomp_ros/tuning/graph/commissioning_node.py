"""commissioning: runs the steps of commissioning and frequency responses on the graph when a cell asks for them.

The work is done by the command line's verbs in a process of their own, which may compute for minutes and may be stopped
at any time. This node starts it, says how it goes, and stops it.
"""

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.contract import COMMISSIONING_STATE
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import CommissioningNodeParameters
from straightcomp_ros.runtime.declare import declare
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.runner import Runnable, run
from straightcomp_ros.runtime.safety_panel import LATCHED
from straightcomp_ros.timing.node_timing import SAMPLES
from straightcomp_ros.tuning.commissioning import STEP_NAMES

_LOOK_S = 0.1
_STOP_WITHIN_S = 30.0
_LAST_WORDS = 2000


class CommissioningNode(Runnable):
    """Serves ``~/run`` and ``~/stop``, ``~/measure_response``, and each step of commissioning by its name."""

    def __init__(self, node: Node) -> None:
        self._parameters = parameters = declare(node, CommissioningNodeParameters)
        self.node, self.done, self.realtime, self.loop = node, Future(), parameters.realtime, None
        if not parameters.output:
            raise ParameterError("parameter 'output' is empty; allowed: a folder for the record and the bags")
        self._folder = Path(parameters.output).resolve()
        self._folder.mkdir(parents=True, exist_ok=True)
        self._process: subprocess.Popen[bytes] | None = None
        self._doing, self._answers = "", 0
        self._output: IO[bytes] | None = None
        self._publisher = node.create_publisher(DiagnosticStatus, COMMISSIONING_STATE, LATCHED)
        node.create_service(Trigger, "~/run", self._on_run)
        node.create_service(Trigger, "~/stop", self._on_stop)
        node.create_service(Trigger, "~/measure_response", self._on_measure_response)
        for step in STEP_NAMES:
            node.create_service(Trigger, f"~/{step}", partial(self._on_step, step))
        node.create_timer(_LOOK_S, self._look)
        Diagnostics(node, lambda: {SAMPLES: self._answers, "doing": self._doing})
        self._tell("", True, "ready")

    def _on_run(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Do all steps that have not passed; the topic `commissioning_state` tells how it goes."""
        return self._begin("all steps", self._steps(), response)

    def _on_step(self, step: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Do one step of commissioning alone, even if it is done: `connection` and so on."""
        return self._begin(step, self._steps("--only", step), response)

    def _on_measure_response(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Measure the frequency response under the controller's present law, with plots in the output folder."""
        plot = self._folder / "frequency_response.png"
        return self._begin("measure_response", ["frequency-response", "--output", str(plot), "--force"], response)

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End what is going on, with the amplifier off."""
        if self._process is None:
            response.success, response.message = False, "nothing is going on"
        else:
            self._process.send_signal(signal.SIGINT)
            response.success, response.message = True, f"stops {self._doing}"
        return response

    def _steps(self, *arguments: str) -> list[str]:
        chosen = ((name, getattr(self._parameters, name)) for name in ("evaluations", "machines", "learn"))
        words = [word for name, value in chosen for word in (f"--{name}", str(value))]
        return ["commission", "--output", str(self._folder), *words, *arguments]

    def _begin(self, doing: str, words: Sequence[str], response: Trigger.Response) -> Trigger.Response:
        if self._process is not None:
            response.success, response.message = False, f"{self._doing} is going on; ~/stop ends it"
            return response
        namespace = self.node.get_namespace().strip("/")
        words = [*words, "--graph", "running", "--json", *(["--namespace", namespace] if namespace else [])]
        self._output = (self._folder / "commissioning.log").open("w+b")
        self._process = subprocess.Popen(
            verb_command(*words), stdin=subprocess.DEVNULL, stdout=self._output, stderr=self._output
        )
        self._doing = doing
        self._tell(doing, True, "is going on", running=True)
        response.success, response.message = True, f"begins {doing}"
        return response

    def _look(self) -> None:
        if self._process is None or self._process.poll() is None:
            return
        code, doing = self._process.returncode, self._doing
        self._process, self._doing = None, ""
        self._answers += 1
        self._tell(doing, code == 0, self._last_words())

    def _last_words(self) -> str:
        """The last sentence of the process."""
        assert self._output is not None
        self._output.seek(0)
        text = self._output.read().decode(errors="replace")
        self._output.close()
        return _sentence(text)

    def _tell(self, doing: str, good: bool, message: str, running: bool = False) -> None:
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
        if self._process is None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_STOP_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _sentence(text: str) -> str:
    """What a verb's output ends with: the sentence of its last step, or its last line."""
    lines = [line for line in text.splitlines() if line.strip()]
    said = ""
    for line in lines:
        try:
            told: dict[str, Any] = json.loads(line)
        except ValueError:
            continue
        steps = told.get("steps")
        if steps:
            said = str(list(steps.values())[-1]["sentence"])
        elif "model_explains_the_plant" in told:
            explains = "explains" if told["model_explains_the_plant"] else "does not explain"
            said = f"the description {explains} the plant"
    return said or (lines[-1][:_LAST_WORDS] if lines else "it said nothing")


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros commissioning_node`."""
    return run("commissioning", CommissioningNode)


if __name__ == "__main__":
    sys.exit(main())

"""An incident of each fault: made, packed, and opened again, if asked for by another user without ROS.

    sudo python -m trials incidents --user visitor

What y, or x within a sample, shows is done to a simulated machine, and found by the watches of driver and controller;
every other fault (a node that is gone, a full disk, an operator) has the reason that the table of faults has for it.
Prints for each fault the size of its incident and its first line; the exit code is 1 if one does not name its fault,
or opens with another line or other bits of the commands.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.simulated_run import START_NS, SimulatedRun
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.cli.output import CommandFailed, print_json
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.messages.cdr import ENCAPSULATION, NANOSECONDS, append_aligned
from straightcomp_ros.offline.incident import NO_REASON, pack
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node, node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.watch import ErrorWatch, SampleWatch
from trials.faulty_machine import FaultyHardware

SUMMARY = "incidents of all faults, packed and opened"
_AT_S = 0.6
"""Time of the disturbance in the run."""
_ERROR_LIMIT = 50e-6
"""m, of the following error."""
_REPORTING = {Fault.MAP_MISSING: "feedforward", Fault.SAMPLE_TIMEOUT: "controller"}
"""The node whose diagnostics name a fault, where it is not the driver."""
_INJECTED = {
    Fault.SAMPLE_NOT_FINITE: "sample NaN",
    Fault.X_JUMP: "jump in x",
    Fault.Y_OUT_OF_RANGE: "y out of range",
    Fault.Y_FROZEN: "encoder y frozen",
    Fault.FOLLOWING_ERROR: "y out of range",
}
_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
_LOGGED = {
    Fault.HEARTBEAT_LOST: ("cell", "[ERROR] [cell]: cycle failed: heartbeat_lost: no heartbeat of feedforward for 1 s"),
    Fault.RECORDING_STOPPED: ("logger", "[ERROR] [logger]: recording stopped: bag run: 0 bytes are free on its disk"),
}


class _Found(Exception):
    """A fault was found, at a sample, with a reason."""


class _Watched(FaultyHardware):
    """The machine with its disturbance, behind the driver's watch, which sees a sample before the law does."""

    def __init__(self, machine: Any, watch: SampleWatch, wanted: Fault) -> None:
        super().__init__(machine)
        self._watch, self._wanted, self._commanded = watch, wanted, 0.0

    def write(self, current: float, at_ns: int) -> None:
        self._commanded = current
        self._inner.write(current, at_ns)

    def read(self, now_ns: int) -> Any:
        if now_ns > _AT_S * 1e9 and not self.injected:
            self.inject(_INJECTED.get(self._wanted, ""))
        found, wanted = super().read(now_ns), self._wanted
        for sample, _ in found:
            finding = self._watch.check(sample, self._commanded)
            self._watch.hold()
            if wanted not in _INJECTED and sample.stamp_ns >= _AT_S * 1e9:
                finding = wanted, wanted.value.means
            if finding and finding[0] is wanted:
                raise _Found(sample, finding[1])
        return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--user", metavar="NAME", help="open the incidents as this user, without ROS (root only)")


def run(options: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(prefix="incidents_") as name:
        folder = Path(name)
        folder.chmod(0o755)
        rows = [one_incident(fault, folder, options.user) for fault in Fault]
    print_json({"incidents": rows})
    if wrong := [row["fault"] for row in rows if not row["named"] or not row["same"]]:
        raise CommandFailed(f"incidents that do not name their fault, or open otherwise: {', '.join(wrong)}")


def one_incident(fault: Fault, folder: Path, user: str | None = None) -> dict[str, Any]:
    """Make, pack and open the incident of a fault in ``folder``; what came of it."""
    own = folder / fault.label
    bag, file = own / "bag", folder / f"{fault.label}.zip"
    record_fault(fault, bag)
    packed = pack(bag, file, [])
    file.chmod(0o644)
    opened = _opened(file, folder / f"{fault.label}_opened", user)
    shutil.rmtree(own)
    first, there = packed.cause, opened["as_packed"]
    return {
        "fault": fault.label,
        "bytes": packed.size,
        "first_line": first,
        "named": first.startswith(f"fault {fault.label}: ") and not first.endswith(NO_REASON),
        "same": (opened["cause"], opened["audit"]) == (first, there["audit"]) and " 0 differ" in opened["audit"],
        "audit": opened["audit"],
    }


def _opened(file: Path, folder: Path, user: str | None) -> dict[str, Any]:
    # Whatever ROS this environment has, the other computer has none: its modules cannot be imported.
    code = "import sys; sys.modules['rclpy'] = None; from straightcomp_ros.cli.main import main; sys.exit(main())"
    as_user: list[str] = []
    if user:
        folder = Path(f"/home/{user}") / f"{file.stem}_{time.time_ns()}"
        path = os.pathsep.join(filter(None, sys.path))
        as_user = ["runuser", "-u", user, "--", "env", f"PYTHONPATH={path}", f"HOME={folder.parent}"]
    words = [*as_user, sys.executable, "-c", code, "incident", "open", str(file), "-o", str(folder), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=folder.parent)
    shutil.rmtree(folder, ignore_errors=True)
    if done.returncode:
        raise CommandFailed(f"{file.name}: exit code {done.returncode}: {done.stderr}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def record_fault(fault: Fault, bag: Path) -> None:
    """Record a run in simulated time that ends with a fault, as the logger would have it."""
    values = shipped_parameters()
    values["stage"] |= {"motion.stroke": 0.2, "motion.settle": 0.1, "motion.pause": 0.1}
    driver, errors = node_parameters("driver", values), ErrorWatch(_ERROR_LIMIT)
    watch = SampleWatch(driver.watch, driver.stage)

    def observe(sample: Sample, truth: Any, reference: Any, command: Any, age: float) -> None:
        finding = errors.check(reference[0] - sample.y, amplifier_on=True)
        if finding and finding[0] is fault:
            raise _Found(sample, finding[1])
        run.add(sample, truth, reference, command, age)

    simulation = Simulation(values, wiring=lambda machine: _Watched(machine, watch, fault))
    bag.parent.mkdir(parents=True)
    with SimulatedRun(bag, by_node(values), simulation.delay) as run:
        run._bag.add(Topic(DIAGNOSTICS, _ARRAY))
        try:
            simulation.run(observe=observe)
            raise CommandFailed(f"{fault.label}: was not found")
        except _Found as found:
            # The sample of the fault has no answer; the node's next diagnostics name the fault.
            sample, text = found.args
            stamp = START_NS + sample.stamp_ns
            columns = (sample.x, sample.y, math.nan, math.nan)
            run._bag.write(f"/{ENCODER.topic}", ENCODER.layout.pack(stamp, *columns), stamp, stamp)
            if fault not in _LOGGED:
                diagnostics = _diagnostics(_REPORTING.get(fault, "driver"), f"{fault.label}: {text}", stamp)
                run._bag.write(DIAGNOSTICS, diagnostics, stamp, stamp)
    if fault in _LOGGED:
        node, line = _LOGGED[fault]
        (bag.parent / "logs").mkdir()
        (bag.parent / "logs" / f"{node}.log").write_text(line + "\n")


def _diagnostics(node: str, error: str, stamp_ns: int) -> bytes:
    """A DiagnosticArray with one status of level ERROR and one value."""
    message = bytearray(ENCAPSULATION)
    append_aligned(message, *divmod(stamp_ns, NANOSECONDS), "", 1)
    message.append(2)
    append_aligned(message, f"/{node}", error, "simulated", 1, "error", error)
    return bytes(message)

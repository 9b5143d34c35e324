"""An incident of each fault: made, packed, and opened again, if asked for by another user without ROS.

    sudo python -m trials incidents --user visitor

Each is of a simulated run that ends with a sample as the fault makes it, and a node that reports the fault by the words
that the table of faults has for it.
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
from contextlib import suppress
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
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.safety.faults import Fault
from trials.faulty_machine import FAULTS

SUMMARY = "incidents of all faults, packed and opened"
_AT_NS = 600_000_000
"""Time of the fault in the run."""
_REPORTING = {Fault.MAP_MISSING: "feedforward", Fault.SAMPLE_TIMEOUT: "controller"}
"""The node whose diagnostics name a fault, where it is not the driver."""
_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
_LOGGED = {
    Fault.HEARTBEAT_LOST: ("cell", "[ERROR] [cell]: cycle failed: heartbeat_lost: no heartbeat of feedforward for 1 s"),
    Fault.RECORDING_STOPPED: ("logger", "[ERROR] [logger]: recording stopped: bag run: 0 bytes are free on its disk"),
}


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
    simulation = Simulation(values)

    def observe(sample: Sample, *answer: Any) -> None:
        if sample.stamp_ns < _AT_NS:
            run.add(sample, *answer)
            return
        for found, change in FAULTS.values():
            sample = change(sample, sample) if found is fault else sample
        # It has no answer.
        columns, stamp = (sample.x, sample.y, math.nan, math.nan), START_NS + sample.stamp_ns
        run._bag.write(f"/{ENCODER.topic}", ENCODER.layout.pack(stamp, *columns), stamp, stamp)
        if fault not in _LOGGED:
            text = f"{fault.label}: {fault.value.means}"
            run._bag.write(DIAGNOSTICS, _diagnostics(_REPORTING.get(fault, "driver"), text, stamp), stamp, stamp)
        raise StopIteration

    bag.parent.mkdir(parents=True)
    with SimulatedRun(bag, by_node(values), simulation.delay) as run, suppress(StopIteration):
        run._bag.add(Topic(DIAGNOSTICS, _ARRAY))
        simulation.run(observe=observe)
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

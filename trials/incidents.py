"""An incident of each fault: recorded in simulated time, packed, and opened again where no ROS can be imported.

Prints for each fault the size of its incident and its first line; the exit code is 1 if one does not name its fault,
or opens with another line or other bits of the commands.
"""

import argparse
import json
import math
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.simulated_run import START_NS, SimulatedRun
from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.cli.output import CommandFailed, print_json
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.offline.incident import NO_REASON, pack
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.safety.faults import Fault

SUMMARY = "incidents of all faults, packed and opened"
PURPOSE = "judge"
_AT_S = 0.6
"""Time of the fault in the run."""
_REPORTED_BY = {Fault.MAP_MISSING: "feedforward", Fault.SAMPLE_TIMEOUT: "controller"}
"""All others are reported by the driver, but for those that only a log has:"""
_LOGGED = {
    Fault.HEARTBEAT_LOST: ("cell", "[ERROR] [cell]: cycle failed: heartbeat_lost: no heartbeat of feedforward for 1 s"),
    Fault.RECORDING_STOPPED: ("logger", "[ERROR] [logger]: recording stopped: bag run: 0 bytes are free on its disk"),
}
_TYPES = [("std_msgs", "Header"), ("builtin_interfaces", "Time")] + [
    ("diagnostic_msgs", name) for name in ("KeyValue", "DiagnosticStatus", "DiagnosticArray")
]


class _Fault(Exception):
    """The fault's moment has come; with the sample."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def run(options: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(prefix="incidents_") as name:
        rows = [one_incident(fault, Path(name)) for fault in Fault]
    print_json({"incidents": rows})
    if wrong := [row["fault"] for row in rows if not row["named"] or not row["same"]]:
        raise CommandFailed(f"incidents that do not name their fault, or open otherwise: {', '.join(wrong)}")


def one_incident(fault: Fault, folder: Path) -> dict[str, Any]:
    """Make, pack and open the incident of a fault in ``folder``; what came of it."""
    own, file = folder / fault.label, folder / f"{fault.label}.zip"
    record_fault(fault, own / "bag")
    packed = pack(own / "bag", file, [])
    shutil.rmtree(own)
    # Whatever ROS this environment has, the other computer has none: its modules cannot be imported.
    code = "import sys; sys.modules['rclpy'] = None; from straightcomp_ros.cli.main import main; sys.exit(main())"
    words = ["incident", "open", str(file), "-o", str(folder / f"{fault.label}_opened"), "--json"]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    if done.returncode:
        raise CommandFailed(f"{file.name}: exit code {done.returncode}: {done.stderr}")
    opened, first = json.loads(done.stdout), packed.cause
    audit = opened["audit"]
    return {
        "fault": fault.label,
        "bytes": packed.size,
        "first_line": first,
        "named": first.startswith(f"fault {fault.label}: ") and not first.endswith(NO_REASON),
        "same": (opened["cause"], opened["as_packed"]["audit"]) == (first, audit) and " 0 differ" in audit,
        "verdict": opened["verdict"],
        "audit": audit,
    }


def record_fault(fault: Fault, bag: Path) -> None:
    """Record a run in simulated time that ends with a fault, as the logger would have it."""
    values = shipped_parameters()
    values["stage"] |= {"motion.stroke": 0.2, "motion.settle": 0.1, "motion.pause": 0.1}

    def observe(sample: Sample, truth: Any, reference: Any, command: Any, age: float) -> None:
        if sample.stamp_ns >= _AT_S * 1e9:
            raise _Fault(sample)
        run.add(sample, truth, reference, command, age)

    simulation = Simulation(values)
    bag.parent.mkdir(parents=True)
    with SimulatedRun(bag, by_node(values), simulation.delay) as run:
        run._bag.add_topic(DIAGNOSTICS, "diagnostic_msgs/msg/DiagnosticArray")
        try:
            simulation.run(observe=observe)
        except _Fault as found:
            # The sample of the fault has no answer; the node's next diagnostics name the fault.
            (sample,) = found.args
            stamp = START_NS + sample.stamp_ns
            y = 5e-3 if fault is Fault.Y_OUT_OF_RANGE else sample.y
            run._bag.write(
                f"/{ENCODER.topic}", ENCODER.layout.pack(stamp, sample.x, y, math.nan, math.nan), stamp, stamp
            )
            if fault not in _LOGGED:
                error = f"{fault.label}: found at x = {sample.x * 1e3:.1f} mm, y = {y * 1e6:.1f} µm"
                node = _REPORTED_BY.get(fault, "driver")
                run._bag.write(DIAGNOSTICS, _diagnostics(node, error, stamp), stamp, stamp)
    if fault in _LOGGED:
        (bag.parent / "logs").mkdir()
        node, line = _LOGGED[fault]
        (bag.parent / "logs" / f"{node}.log").write_text(line + "\n")


def _diagnostics(node: str, error: str, stamp_ns: int) -> bytes:
    store = typestore()
    types = {name: store.types[f"{package}/msg/{name}"] for package, name in _TYPES}
    header = types["Header"](types["Time"](*divmod(stamp_ns, 10**9)), "")
    status = types["DiagnosticStatus"](2, f"/{node}", error, "simulated", [types["KeyValue"]("error", error)])
    message = types["DiagnosticArray"](header, [status])
    return bytes(store.serialize_cdr(message, "diagnostic_msgs/msg/DiagnosticArray"))

"""The recording of each fault, for tests and pages of incidents: a simulated run that ends with a sample as the fault
makes it, and a node that reports the fault by the words that the table of faults has for it."""

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.simulated_run import START_NS, SimulatedRun
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.messages.cdr import ENCAPSULATION, NANOSECONDS, append_aligned
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.safety.faults import Fault
from trials.faulty_machine import FAULTS

_AT_NS = 600_000_000
"""Time of the fault in the run."""
_REPORTING = {Fault.MAP_MISSING: "feedforward", Fault.SAMPLE_TIMEOUT: "controller"}
"""The node whose diagnostics name a fault, where it is not the driver."""
_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
_LOGGED = {
    Fault.HEARTBEAT_LOST: ("cell", "[ERROR] [cell]: cycle failed: heartbeat_lost: no heartbeat of feedforward for 1 s"),
    Fault.RECORDING_STOPPED: ("logger", "[ERROR] [logger]: recording stopped: bag run: 0 bytes are free on its disk"),
}


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

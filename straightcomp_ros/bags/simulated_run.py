"""A simulated run as a bag: the streams that the graph's logger would have recorded, without a graph."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from straightcomp_ros.bags.recorded_nodes import attach_parameters
from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, DRIVER_STATE, ENCODER, REFERENCE, STREAMS, TRUTH
from straightcomp_ros.parameters.output_files import clear

START_NS = 1_000_000_000
"""Stamp of the first sample: simulated time has no date, but ROS takes a stamp of zero for none."""


class SimulatedRun:
    """Writes each sample with its answer; as a context manager it finishes the bag, also of a run that fails, and
    removes it when the program is stopped (Ctrl-C), but for a folder that was there. Stamps and times of reception are
    simulated time. Raises BagError when the folder holds files or cannot be written.

    Args:
        directory: the bag's folder; must be empty or absent.
        parameters: by node and dotted name, attached as the logger attaches them, with the survey that they name.
        delay: from each sample to the arrival of its command, in sampling periods.
    """

    def __init__(self, directory: Path, parameters: Mapping[str, Mapping[str, Any]], delay: float) -> None:
        self._made = not os.path.exists(directory)
        self._bag = BagWriter(directory)
        self._delay, self._applied = delay, 0.0
        self._last_ns: int | None = None
        try:
            for stream in STREAMS:
                self._bag.add(Topic(f"/{stream.topic}", stream.layout.type_name, TopicQos("best_effort", depth=1000)))
            # A simulation has a feedforward, also where all its parameters are defaults.
            attach_parameters(self._bag, {"feedforward": {}, **parameters})
            self._bag.add_metadata("simulation", {"delay_samples": str(delay)})
        except BaseException as error:
            self.__exit__(type(error))
            raise

    def add(self, sample: Any, truth: Any, reference: Any, command: Any, reference_age: float) -> None:
        """Write one sample: `Sample` and `Truth` of the hardware, (r, ṙ, r̈), the law's `Command`, and the age in s of
        the reference that it was computed from."""
        stamp = START_NS + sample.stamp_ns
        # The command before this one has come in since its sample.
        latency = math.nan if self._last_ns is None else self._delay * (stamp - self._last_ns) * 1e-9
        on = 0.0 if math.isnan(sample.current) else 1.0
        for stream, numbers in (
            (ENCODER, (sample.x, sample.y, math.nan, sample.current)),
            (TRUTH, truth),
            (DRIVER_STATE, (latency, 0.0, self._applied, on)),
            (REFERENCE, reference),
            (COMMAND, command[:1]),
            (CONTROLLER_STATE, (*command[1:], reference_age)),
        ):
            self._bag.write(f"/{stream.topic}", stream.layout.pack(stamp, *numbers), stamp, stamp)
        self._last_ns, self._applied = stamp, command.current

    def __enter__(self) -> SimulatedRun:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._bag.close()
        except KeyboardInterrupt as stop:
            kind = type(stop)
            raise
        finally:
            if kind is not None and not issubclass(kind, Exception):
                # Half of a run in simulated time would be taken for a whole one.
                clear(self._bag.directory, made=self._made)

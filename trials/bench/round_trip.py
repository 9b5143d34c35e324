"""Times the round trip from an emulated board to its host and back, with hub, board and host as separate processes."""

import json
import signal
import statistics
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bench.processes import cores, usage
from straightcomp_ros.cell.demonstration import on_hub
from straightcomp_ros.cell.launcher import Graph, LaunchError, verb_command
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import Command
from straightcomp_ros.hardware.can.hub import Frame
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.hardware.can.link import Link, filter_of
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.parameters.node_parameters import STAGE, node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.stage.description import StageParameters

_BURST, _BURSTS = 100, 20
_PATIENCE_S = 30.0
_LOOK_S = 0.1


class RoundTripFailed(RuntimeError):
    """The measurement failed; the message gives the reason."""


@dataclass(frozen=True)
class RoundTrip:
    """Result of the measurement.

    Attributes:
        times: in s, from the board's sending of a sample until another node of the bus has read the host's answer.
        send_us: median µs to hand a frame to python-can's interface of the hub.
        receive_us: median µs to take one from it.
        hub_cores: CPU cores that the hub kept busy.
        lost: samples that did not arrive; those lost in cuts do not count.
        cuts: number of times that the hub cut the link.
        reopened: number of times that the host found the link cut and opened it again.
    """

    times: NDArray[np.float64]
    send_us: float
    receive_us: float
    hub_cores: float
    lost: int
    cuts: int
    reopened: int


def measure_round_trip(values: Mapping[str, Mapping[str, Any]], folder: Path, seconds: float, cuts: int) -> RoundTrip:
    """Answer each sample of an emulated board for ``seconds``, then cut the link ``cuts`` times.

    Args:
        values: parameters by node and dotted name: the board is the driver's machine, on its kind of bus.
        folder: an empty folder with a short path.
        seconds: length of the measurement.
        cuts: how often to cut the link.

    Raises:
        RoundTripFailed: a process ended, or no sample arrives.
        ParameterError: a parameter is refused.
    """
    values = {**values, "driver": {**values["driver"], **on_hub(values, str(folder / "bus"))}}
    driver = node_parameters("driver", values)
    parameters = driver.can
    file = folder / "parameters.yaml"
    file.write_text(as_parameter_file({node: values.get(node, {}) for node in (STAGE, "driver")}))
    priority = str(driver.realtime.priority)
    programs = {
        "hub": verb_command("can", "hub", "--socket", parameters.channel, "--priority", priority, "--json"),
        "board": verb_command("dsp", "--params-file", str(file)),
    }
    host = _Host(parameters, driver.stage)
    try:
        with Graph(folder / "logs") as graph:
            hub = graph.start_program("hub", programs["hub"])
            _until(lambda: (folder / "bus").is_socket(), "the hub makes no socket", graph, ["hub"])
            send_us, receive_us = _costs(parameters)
            host.start()
            graph.start_program("board", programs["board"])
            _until(lambda: bool(host.answers), "no sample came from the board", graph, ["hub", "board"])
            begin = usage({"hub": hub.pid})
            times = _times(parameters, host, seconds)
            end = usage({"hub": hub.pid})
            graph.check(["hub", "board"])
            lost = host.receiver.sequence.lost
            for _ in range(cuts):
                _cut(hub, host, graph)
            host.close()
            graph.stop(["board", "hub"])
            counters = json.loads(graph.last_words("hub"))
    except (LaunchError, OSError, can.CanError) as error:
        raise RoundTripFailed(str(error)) from error
    finally:
        host.close()
    if not len(times):
        raise RoundTripFailed("no answer came through the hub")
    return RoundTrip(
        times, send_us, receive_us, cores(begin, end)["hub"], lost, counters["cuts"], host.link.openings - 1
    )


class _Host:
    """Answers each sample with "off" in a separate thread, like the driver's loop."""

    def __init__(self, parameters: CanParameters, stage: StageParameters) -> None:
        self.receiver = Receiver(parameters, stage)
        self.wire = self.receiver.wire
        self.link = Link(parameters, self.receiver.identifiers, self._receive, time.time_ns)
        self.answers = 0
        self.sent_s: dict[int, float] = {}
        """When the board sent a sample, by the echo in the answer."""
        if not self.wire.echo_modulus:
            raise RoundTripFailed(f"{self.wire.dbc.file} has no echo of the sample in a command: nothing to time by")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="host", daemon=True)

    def start(self) -> None:
        """Open the bus and answer, until :meth:`close`."""
        self.link.start()
        self._thread.start()

    def close(self) -> None:
        """Leave the bus."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self.link.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            self.link.wait(_LOOK_S)

    def _receive(self, frame: Frame, arrival_ns: int) -> None:
        self.receiver.take(frame, arrival_ns)
        samples = self.receiver.samples
        if samples:
            number, *_ = samples.pop()
            samples.clear()
            echo = number % self.wire.echo_modulus
            self.sent_s[echo] = frame.stamp_ns * 1e-9
            for frames in self.wire.commands:
                command = Command(self.answers % frames.alive_modulus, False, False, 0.0, echo)
                self.link.send(frames.identifier, frames.pack(command), fd=frames.fd)
            self.answers += 1


def _bus(parameters: CanParameters, identifier: int) -> can.BusABC:
    filters: list[Any] = [filter_of(identifier)]
    return can.Bus(interface=INTERFACE, channel=parameters.channel, fd=parameters.fd, can_filters=filters)


def _costs(parameters: CanParameters) -> tuple[float, float]:
    """Median µs of a frame for sender and receiver; the receiver's frames have arrived before."""
    identifier, payload = 0x123, bytes(16 if parameters.fd else 8)
    sending, receiving = [], []
    with _bus(parameters, identifier) as sender, _bus(parameters, identifier) as receiver:
        for _ in range(_BURSTS):
            begin = time.perf_counter_ns()
            for _ in range(_BURST):
                sender.send(
                    can.Message(
                        arbitration_id=identifier,
                        is_extended_id=False,
                        is_fd=parameters.fd,
                        bitrate_switch=parameters.fd,
                        data=payload,
                    )
                )
            sending.append((time.perf_counter_ns() - begin) * 1e-3 / _BURST)
            time.sleep(0.01)
            begin = time.perf_counter_ns()
            for _ in range(_BURST):
                if receiver.recv(_PATIENCE_S) is None:
                    raise RoundTripFailed("a frame did not come through the hub")
            receiving.append((time.perf_counter_ns() - begin) * 1e-3 / _BURST)
    return statistics.median(sending), statistics.median(receiving)


def _times(parameters: CanParameters, host: _Host, seconds: float) -> NDArray[np.float64]:
    command = next(frames for frames in host.wire.commands if "echo" in frames.fields)
    times = []
    with _bus(parameters, command.identifier) as node:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = node.recv(0.1)
            if message is not None:
                now = time.time()
                sent = host.sent_s.pop(command.unpack(bytes(message.data)).echo or 0, None)
                if sent is not None:
                    times.append(now - sent)
    return np.array(times)


def _cut(hub: subprocess.Popen[str], host: _Host, graph: Graph) -> None:
    openings, answers = host.link.openings, host.answers
    hub.send_signal(signal.SIGUSR1)
    _until(
        lambda: host.link.openings > openings and host.answers > answers + 100,
        "the bus did not come back after a cut",
        graph,
        ["hub", "board"],
    )


def _until(condition: Callable[[], bool], words: str, graph: Graph, programs: list[str]) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not condition():
        graph.check(programs)
        if time.monotonic() > end:
            raise RoundTripFailed(f"{words} within {_PATIENCE_S:g} s")
        time.sleep(0.005)

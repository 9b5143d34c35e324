"""The connection to the bus, opened again when it fails: the driver's, and the emulated board's.

python-can's Notifier ends with the first error. Here an error closes the bus, and it is opened again, at first soon,
then less often; opening may take seconds and has its own thread. The caller's thread reads: handing frames to another
thread would cost a wake-up and the interpreter's lock for each.
"""

import contextlib
import errno
import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.frame_log import FrameLog
from straightcomp_ros.hardware.can.hub import ERROR, FD_FRAME, Frame
from straightcomp_ros.hardware.can.hub_bus import INTERFACE, HubBus, frame_of, message_of
from straightcomp_ros.parameters.declaration import ParameterError

_SHORTEST_WAIT_S, _LONGEST_WAIT_S = 0.02, 1.0
_AT_ONCE = 256
_PAUSE_S = 0.0005
_SAME_CLOCK_NS = 5_000_000_000
"""Longest time between a frame and its reading; beyond it the system's clock was set."""
_SYSTEM_STAMPS = ("socketcan", "virtual", INTERFACE)
"""Interfaces that stamp by the system's clock. An adapter's own drifts: python-can's kvaser and vector compare it with
the system's only as they open."""


def check_interface(parameters: CanParameters) -> None:
    """Raise ParameterError if python-can knows no such interface."""
    if parameters.interface not in can.interfaces.BACKENDS:
        known = ", ".join(sorted(can.interfaces.BACKENDS))
        raise ParameterError(f"parameter 'can.interface': '{parameters.interface}' is not known; allowed: {known}")


def opened_bus(parameters: CanParameters, filters: Sequence[dict[str, Any]] | None = None) -> can.BusABC:
    """Open the bus; raises can.CanError."""
    further: dict[str, Any] = {"data_bitrate": parameters.data_bitrate} if parameters.fd else {}
    try:
        return can.Bus(
            interface=parameters.interface,
            channel=parameters.channel,
            bitrate=parameters.bitrate,
            fd=parameters.fd,
            can_filters=filters,
            **{**parameters.further_options(), **further},
        )
    except Exception as error:
        # Interfaces of python-can raise any error of their drivers.
        raise can.CanInitializationError(str(error)) from error


class Link:
    """Receives in :meth:`wait`, which calls back, and sends by :meth:`send`; one thread calls both.

    ``receive(frame, arrival_ns)`` is called for each frame with one of ``identifiers`` and for each error frame; in
    identifiers of 29 bits EXTENDED_ID is set; ``clock`` is the host's time in ns.

    Raises:
        ParameterError: python-can knows no such interface.
        HardwareError: the frame log cannot be made.
    """

    openings = 0
    """How often the bus was opened."""
    transmit_full = 0
    """Frames that were not sent because the queue was full or the bus closed."""
    overloads = 0
    """How often more frames had arrived than are read at once."""

    def __init__(
        self,
        parameters: CanParameters,
        identifiers: Sequence[int],
        receive: Callable[[Frame, int], None],
        clock: Callable[[], int],
    ) -> None:
        check_interface(parameters)
        self._parameters = parameters
        self.log = FrameLog(Path(os.path.expanduser(parameters.log)), parameters.channel) if parameters.log else None
        self._identifiers = frozenset(identifiers)
        self._filters = [filter_of(identifier) for identifier in identifiers]
        self._receive = receive
        self._clock = clock
        self._bus: can.BusABC | None = None
        self._opener: threading.Thread | None = None
        self._closing = False
        self._wait_s, self._next_opening_s = _SHORTEST_WAIT_S, 0.0
        self._name = f"CAN {parameters.interface} {parameters.channel}"
        self.problem = f"{self._name} is not open yet"
        """Why the bus is closed; empty while it is open."""

    def start(self) -> None:
        """Open the bus, or open it again after a pause without reading, to drop old frames."""
        if self.log:
            self.log.start()
        if self._bus is not None:
            self.problem = f"{self._name} is being opened again"
            self._drop(self._bus)
        self._open_soon()

    def open(self) -> None:
        """Open the bus in this thread; :attr:`problem` says why it is closed all the same."""
        try:
            bus = opened_bus(self._parameters, self._filters)
        except Exception as error:
            self._lose(None, error)
            return
        self.openings += 1
        self.problem = ""
        self._bus = bus
        if self._closing:
            self._drop(bus)

    def wait(self, timeout_s: float) -> int:
        """Take the frames that have arrived, waiting up to ``timeout_s`` for the first; returns how many."""
        bus = self._bus
        if bus is None:
            self._open_soon()
            time.sleep(timeout_s)
            return 0
        try:
            return self._read(bus, timeout_s)
        except Exception as error:
            # Interfaces of python-can raise any error of their drivers; the driver node's loop must survive them all.
            self._lose(bus, error)
            return 0

    def send(self, identifier: int, payload: bytes, *, fd: bool) -> bool:
        """Hand a frame to the bus without waiting; False if it was not taken."""
        bus, frame = self._bus, Frame(0, identifier, FD_FRAME if fd else 0, payload)
        try:
            if isinstance(bus, HubBus):
                bus.send_frame(*frame[1:])
            elif bus is not None:
                bus.send(message_of(frame), timeout=0)
        except (can.CanError, OSError, ValueError) as error:
            # That the interface is down the kernel reports once, to who calls first; all else reading finds too.
            cause = error if isinstance(error, OSError) else error.__cause__
            if isinstance(cause, OSError) and cause.errno == errno.ENETDOWN:
                self._lose(bus, error)
            bus = None
        if bus is None:
            self.transmit_full += 1
            return False
        if self.log:
            message = message_of(frame._replace(stamp_ns=time.time_ns()))
            message.is_rx = False
            self.log.put(message)
        return True

    def close(self) -> None:
        self._closing = True
        if self._opener is not None:
            self._opener.join(2.0)
        self._drop(self._bus)
        if self.log:
            self.log.close()

    def _open_soon(self) -> None:
        busy = self._opener is not None and self._opener.is_alive()
        if self._bus is None and not busy and time.monotonic() >= self._next_opening_s:
            # It inherits this thread's priority: if it held the interpreter's lock without a CPU, the loop would wait.
            self._opener = threading.Thread(target=self.open, name="can", daemon=True)
            self._opener.start()

    def _lose(self, bus: can.BusABC | None, error: Exception) -> None:
        self.problem = f"{self._name}: {error}"
        self._drop(bus)
        self._next_opening_s = time.monotonic() + self._wait_s
        self._wait_s = min(2.0 * self._wait_s, _LONGEST_WAIT_S)

    def _drop(self, bus: can.BusABC | None) -> None:
        self._bus = None
        if bus is not None:
            with contextlib.suppress(Exception):
                bus.shutdown()

    def _read(self, bus: can.BusABC, timeout_s: float) -> int:
        frame = _next_frame(bus, timeout_s)
        taken = 0
        if frame is not None:
            # Not as soon as it opens: SocketCAN opens an interface that is down, and says so when it is read.
            self._wait_s = _SHORTEST_WAIT_S
        while frame is not None:
            # recv_frame() of the hub's interface does not filter, and an error frame has no identifier.
            if frame.identifier in self._identifiers or frame.flags & ERROR:
                self._take(frame)
            taken += 1
            if taken >= _AT_ONCE:
                # A babbling node must not keep the other nodes from running.
                self.overloads += 1
                time.sleep(_PAUSE_S)
                break
            frame = _next_frame(bus, 0.0)
        return taken

    def _take(self, frame: Frame) -> None:
        """Pass on and log a frame with its time on the bus: its stamp if that is of the system's clock, else now."""
        now_ns, system_ns = self._clock(), time.time_ns()
        late_ns = system_ns - frame.stamp_ns
        if not (self._parameters.interface in _SYSTEM_STAMPS and 0 <= late_ns < _SAME_CLOCK_NS):
            frame, late_ns = frame._replace(stamp_ns=system_ns), 0
        self._receive(frame, now_ns - late_ns)
        if self.log:
            self.log.put(message_of(frame))


def filter_of(identifier: int) -> dict[str, Any]:
    """python-can's filter that passes the frames with this identifier alone."""
    extended = bool(identifier & EXTENDED_ID)
    mask = 0x1FFFFFFF if extended else 0x7FF
    return {"can_id": identifier & mask, "can_mask": mask, "extended": extended}


def _next_frame(bus: can.BusABC, timeout_s: float) -> Frame | None:
    if isinstance(bus, HubBus):
        return bus.recv_frame(timeout_s)
    message = bus.recv(timeout_s)
    return None if message is None else frame_of(message)

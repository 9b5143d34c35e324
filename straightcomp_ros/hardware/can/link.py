"""A python-can bus that is opened again when it fails, read by a thread of its own.

python-can's Notifier ends with the first error and says nothing of silence; here an error closes the bus, and the
thread tries again, at first soon, then less often.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can

from straightcomp_ros.hardware.can.frame_log import FrameLog
from straightcomp_ros.hardware.can.parameters import CanParameters
from straightcomp_ros.parameters import ParameterError

_SHORTEST_WAIT_S, _LONGEST_WAIT_S = 0.02, 1.0
_RECEIVE_TIMEOUT_S = 0.1
_AT_ONCE = 256
_PAUSE_S = 0.0005
_SAME_CLOCK_S = 5.0


def check_interface(parameters: CanParameters) -> None:
    """Raise ParameterError if python-can knows no such interface."""
    if parameters.interface not in can.interfaces.BACKENDS:
        known = ", ".join(sorted(can.interfaces.BACKENDS))
        raise ParameterError(f"parameter 'can.interface': '{parameters.interface}' is not known; allowed: {known}")


def opened_bus(parameters: CanParameters, filters: Sequence[dict[str, Any]] | None = None) -> can.BusABC:
    """Open the bus; ``filters`` as in python-can, None lets all frames through.

    Raises:
        can.CanError, OSError: the interface does not open; some raise what their drivers do.
    """
    rates = {"data_bitrate": parameters.data_bitrate} if parameters.fd else {}
    return can.Bus(
        interface=parameters.interface,
        channel=parameters.channel,
        bitrate=parameters.bitrate,
        fd=parameters.fd,
        can_filters=filters,
        **rates,
        **parameters.further_options(),
    )


class Link:
    """Frames in by a callback, frames out by :meth:`send`; neither waits for the other.

    Args:
        parameters: which bus.
        identifiers: CAN identifiers to let through.
        receive: ``receive(message, arrival_ns)``, called in the thread for each frame.
        clock: the host's time in ns, as :mod:`straightcomp_ros.hardware.interface` has it.

    Raises:
        ParameterError: python-can knows no such interface.
        HardwareError: the frame log cannot be made.
    """

    def __init__(
        self,
        parameters: CanParameters,
        identifiers: Sequence[int],
        receive: Callable[[can.Message, int], None],
        clock: Callable[[], int],
    ) -> None:
        check_interface(parameters)
        self._parameters = parameters
        self.log = FrameLog(Path(parameters.log).expanduser(), parameters.channel) if parameters.log else None
        self._filters = [{"can_id": identifier, "can_mask": 0x7FF, "extended": False} for identifier in identifiers]
        self._receive = receive
        self._clock = clock
        self._bus: can.BusABC | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="can", daemon=True)
        self.openings = 0
        """Times that the bus was opened."""
        self.transmit_full = 0
        """Frames that were not sent because the queue was full or the bus closed."""
        self.overloads = 0
        """Times that more frames came at once than were read at once."""
        self.problem = f"CAN {parameters.interface} {parameters.channel} is not open yet"
        """Why the bus is closed; empty while it is open."""

    def start(self) -> None:
        """Start the thread, once: it takes this thread's scheduling."""
        if self._thread.ident is not None:
            return
        # Both threads have the same priority: one that held the interpreter and got no CPU would hold up the other, and
        # the driver's loop.
        if self.log:
            self.log.start()
        self._thread.start()

    def send(self, identifier: int, payload: bytes, *, fd: bool) -> bool:
        """Hand a frame to the bus, without waiting; False if it was not taken. One thread may call this."""
        bus = self._bus
        message = can.Message(
            arbitration_id=identifier,
            is_extended_id=False,
            data=payload,
            is_fd=fd,
            bitrate_switch=fd,
        )
        try:
            if bus is not None:
                bus.send(message, timeout=0)
                if self.log:
                    message.timestamp, message.is_rx = time.time(), False
                    self.log.put(message)
                return True
        except (can.CanError, OSError, ValueError):
            # The thread finds out what is wrong, if it is more than a full queue.
            pass
        self.transmit_full += 1
        return False

    def close(self) -> None:
        """End the thread and close the bus."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        if self.log:
            self.log.close()

    def _run(self) -> None:
        wait_s = _SHORTEST_WAIT_S
        while not self._closing.is_set():
            try:
                self._bus = opened_bus(self._parameters, self._filters)
                self.openings += 1
                self.problem = ""
                wait_s = _SHORTEST_WAIT_S
                self._read(self._bus)
            except Exception as error:
                # Back ends of python-can raise whatever their drivers do; a thread must not die of any of it.
                parameters = self._parameters
                self.problem = f"CAN {parameters.interface} {parameters.channel}: {error}"
            finally:
                bus, self._bus = self._bus, None
                if bus is not None:
                    with contextlib.suppress(Exception):
                        bus.shutdown()
            self._closing.wait(wait_s)
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)

    def _read(self, bus: can.BusABC) -> None:
        while not self._closing.is_set():
            message = bus.recv(_RECEIVE_TIMEOUT_S)
            taken = 0
            while message is not None:
                self._receive(message, self._arrival(message))
                if self.log:
                    self.log.put(message)
                taken += 1
                if taken >= _AT_ONCE:
                    # A babbling node must not keep the driver's own loop from running.
                    self.overloads += 1
                    time.sleep(_PAUSE_S)
                    break
                message = bus.recv(0)

    def _arrival(self, message: can.Message) -> int:
        """When the frame was on the bus: the adapter's time, if it is the system's, else now."""
        now_ns = self._clock()
        late = time.time() - message.timestamp
        return now_ns - round(late * 1e9) if 0.0 <= late < _SAME_CLOCK_S else now_ns

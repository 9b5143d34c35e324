"""From frames to samples: every check between the wire and a number that may be used.

Payloads and times of arrival go in, samples come out; neither python-can nor threads are involved. The checks in their
order: length, CRC with data id, range of the alive counter, state, number, plausibility.
"""

import math
from collections import deque

from straightcomp_ros.hardware.can import frames
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import truth_of
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, FrameError
from straightcomp_ros.hardware.can.sample_clock import SampleClock
from straightcomp_ros.hardware.can.sequence import Sequence
from straightcomp_ros.hardware.interface import Sample, Truth
from straightcomp_ros.stage.description import StageParameters

_REASONS = ("length", "crc", "alive", "state", "implausible", "encoders", "foreign", "truth")
_ERRORS = ("error_frames", "error_passive", "bus_off")
_STRIKE = 4
_UNSETTLED = 9.0
_CONTROLLER, _BUS_OFF = 0x04, 0x40
"""Error classes of linux/can/error.h: with the first, the payload's second byte is the controller's state."""
_PASSIVE = 0x10 | 0x20


class Receiver:
    """Samples of one board; the caller empties :attr:`samples`.

    Attributes:
        samples: new samples, oldest first: number, sample, and an emulated board's truth.
        amplifier: state in the newest good frame; None before the first.
        board_fault: why the board switched off.
        newest_ns: time of arrival of the newest usable sample.
        heartbeat_ns: time of arrival of the newest heartbeat; ``node_state`` is its content.
        boot_ups: boot-up messages since the start.
        strikes: error counter of bad frames, see ``strike_limit``; ``strike_outs``: how often it reached the limit.
        counts: refused frames by reason, and errors that the interface reported.
        identifiers: CAN identifiers that this receiver reads.
    """

    def __init__(self, parameters: CanParameters, stage: StageParameters) -> None:
        self.codec = frames.Codec(parameters.node, parameters.fd)
        self._period_ns = period_ns = stage.period_ns
        self.clock = SampleClock(period_ns)
        self.sequence = Sequence(self._elapsed)
        self.samples: deque[tuple[int, Sample, Truth | None]] = deque()
        self.received = self.overflowed = self.stale = self.boot_ups = self.strikes = self.strike_outs = 0
        self.counts = dict.fromkeys(_REASONS + _ERRORS, 0)
        self.amplifier: Amplifier | None = None
        self.board_fault = BoardFault.NONE
        self.newest_ns = self.heartbeat_ns = self._arrival_ns = 0
        self.node_state: int | None = None
        self._memory, self._strike_limit = parameters.sample_memory, parameters.strike_limit
        self._stale_ns = round(parameters.sample_timeout * 1e9)
        self._x_step = stage.motion.highest_speed * period_ns * 1e-9 / frames.POSITION_COUNT
        self._y_step = parameters.y_speed * period_ns * 1e-9 / frames.POSITION_COUNT
        self._accepted: frames.Encoder | None = None
        self._alive = self._stamp_ns = 0
        self._current = 0.0
        self._truth: tuple[int, Truth | None] = (-1, None)
        ids = self.codec.ids
        self._handlers = {self.codec.encoder_id: self._encoder, ids.heartbeat: self._heartbeat}
        if not self.codec.fd:
            self._handlers[ids.current] = self._coil_current
        elif parameters.simulated_stage:
            self._handlers[ids.truth] = self._hear_truth
        self.identifiers = list(self._handlers)

    def restart(self) -> None:
        """Forget the board's samples, as after its restart; counters stay."""
        self.clock.reset()
        self.sequence.reset()
        self._accepted = self.amplifier = None
        self.strikes = 0

    def receive(self, identifier: int, payload: bytes, arrival_ns: int) -> None:
        """Take one frame of the bus."""
        handler = self._handlers.get(identifier)
        if handler is None:
            self.counts["foreign"] += 1
            return
        try:
            handler(payload, arrival_ns)
        except FrameError as error:
            self._strike(str(error))

    def receive_error_frame(self, classes: int, details: bytes) -> None:
        """Count an error that the interface reports, by the identifier and the payload of Linux's error frame."""
        self.counts["error_frames"] += 1
        if classes & _BUS_OFF:
            self.counts["bus_off"] += 1
        if classes & _CONTROLLER and len(details) > 1 and details[1] & _PASSIVE:
            self.counts["error_passive"] += 1

    def _strike(self, reason: str) -> None:
        self.counts[reason] += 1
        self.strikes += _STRIKE
        if self.strikes >= self._strike_limit:
            self.strike_outs += 1
            self.restart()

    def _elapsed(self, index: int, arrival_ns: int) -> float:
        if self.clock.settled:
            return self.clock.elapsed(index, arrival_ns)
        # The first frames may all be late, so the time between two of them is not yet meaningful.
        return max((arrival_ns - self._arrival_ns) / self._period_ns, _UNSETTLED)

    def _encoder(self, payload: bytes, arrival_ns: int) -> None:
        frame = self.codec.unpack_encoder(payload)
        if not frames.amplifier_of(frame.status):
            raise FrameError("state")
        self._alive = frame.alive
        ahead = self.sequence.ahead(frame, arrival_ns)
        if ahead is None:
            self.sequence.wait(frame, arrival_ns)
        else:
            self._place(frame, ahead, arrival_ns)

    def _place(self, frame: frames.Encoder, ahead: int, arrival_ns: int) -> None:
        if not self.sequence.plausible(ahead, arrival_ns):
            raise FrameError("implausible")
        if ahead <= 0:
            self.sequence.count_old(ahead)
            return
        last = self._accepted or frame
        if abs(frame.x - last.x) > 2 + self._x_step * ahead or abs(frame.y - last.y) > 2 + self._y_step * ahead:
            raise FrameError("implausible")
        self._accepted = frame
        index = self.sequence.accept(frame, ahead)
        self.clock.observe(index, arrival_ns)
        self.received += 1
        self._arrival_ns = arrival_ns
        self.amplifier = Amplifier(frames.amplifier_of(frame.status))
        self.board_fault = frames.fault_of(frame.status)
        if self.strikes:
            self.strikes -= 1
        if not frames.encoders_valid(frame.status):
            self.counts["encoders"] += 1
        elif self.clock.settled:
            self._deliver(frame, index, arrival_ns)

    def _deliver(self, frame: frames.Encoder, index: int, arrival_ns: int) -> None:
        stamp_ns = self.clock.stamp(index)
        if stamp_ns <= self._stamp_ns:
            # After a reset of the clock, stamps must still not run backwards.
            return
        self._stamp_ns, self.newest_ns = stamp_ns, arrival_ns
        if arrival_ns - stamp_ns > self._stale_ns:
            self.stale += 1
        if frame.current is not None:
            self._current = frame.current * frames.CURRENT_COUNT
        current = self._current if self.amplifier is Amplifier.ON else math.nan
        sample = Sample(stamp_ns, frame.x * frames.POSITION_COUNT, frame.y * frames.POSITION_COUNT, current)
        counter, truth = self._truth
        self.samples.append((index, sample, truth if counter == frame.counter else None))
        if len(self.samples) > self._memory:
            self.samples.popleft()
            self.overflowed += 1

    def _coil_current(self, payload: bytes, arrival_ns: int) -> None:
        frame = self.codec.unpack_current(payload)
        self._current = frame.current * frames.CURRENT_COUNT
        jumps = self.sequence.jumps
        placed = self.sequence.place(frame.counter, self._alive)
        if self.sequence.jumps > jumps:
            self.clock.reset()
        for number, (waiting, waiting_ns) in placed:
            if self.sequence.index is None:
                self.sequence.index = number - 1
            try:
                self._place(waiting, number - self.sequence.index, waiting_ns)
            except FrameError as error:
                self._strike(str(error))

    def _hear_truth(self, payload: bytes, _: int) -> None:
        try:
            self._truth = truth_of(payload)
        except FrameError as error:
            # Nothing acts on the truth, so a damaged one does not count as a bad frame.
            self.counts[str(error)] += 1

    def _heartbeat(self, payload: bytes, arrival_ns: int) -> None:
        if len(payload) != 1:
            raise FrameError("length")
        self.node_state = payload[0] & 0x7F
        self.heartbeat_ns = arrival_ns
        if payload[0] == frames.BOOT_UP:
            self.boot_ups += 1
            self.restart()

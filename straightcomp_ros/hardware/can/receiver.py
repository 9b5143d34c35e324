"""From frames to samples: every check between the wire and a number that may be used.

Payloads and times of arrival go in, samples come out; neither python-can nor threads are involved. The checks in their
order: length, CRC with data id, range of the counters, state, number, plausibility.
"""

import math
from collections import deque
from collections.abc import Callable
from functools import partial

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import FrameError, Frames, Report
from straightcomp_ros.hardware.can.hub import ERROR, REMOTE, Frame
from straightcomp_ros.hardware.can.sample_numbers import FrameSets, SampleClock, SampleNumbers
from straightcomp_ros.hardware.interface import Sample, State, Truth
from straightcomp_ros.model.motion import reach
from straightcomp_ros.stage.description import StageParameters

_REASONS = ("length", "crc", "alive", "state", "implausible", "encoders", "current", "foreign", "truth", "remote")
_ERRORS = ("error_frames", "error_passive", "bus_off")
_BAD_FRAME = 4
_CONTROLLER, _BUS_OFF = 0x04, 0x40
"""Error classes of linux/can/error.h: with the first, the payload's second byte is the controller's state."""
_PASSIVE = 0x10 | 0x20


class Receiver:
    """Samples of one board; the caller empties :attr:`samples`.

    Attributes:
        current: newest coil current; for a board that does not measure it, set it to the commanded one.
        samples: new samples, oldest first: number, sample, and an emulated board's truth.
        amplifier: state in the newest good frame; None before the first.
        referenced: whether x is counted from its reference; None while the board has not said it since its restart.
        ambiguous: x may be one of several positions on the stage's travel, whole turns of its counter apart.
        board_fault: the board's code of why it switched off; None before the first.
        newest_ns: time of arrival of the newest usable sample.
        status_ns: time of arrival of the newest state of the amplifier.
        heartbeat_ns: time of arrival of the newest heartbeat; ``node_state`` is its content.
        boot_ups: boot-up messages since the start.
        error_counter: of bad frames, see ``strike_limit``; ``error_limit_hits``: how often it reached the limit.
        counts: refused frames by reason, and errors that the interface reported.
        identifiers: CAN identifiers that this receiver reads.
        sets: what became of the frames of samples whose signals are in several messages.
        emulator: the frames of an emulated board's stage and truth, if it is one.
    """

    def __init__(self, parameters: CanParameters, stage: StageParameters) -> None:
        self.wire = wire = parameters.make_wire()
        self._period_ns = period_ns = stage.period_ns
        self.clock = SampleClock(period_ns)
        self._modulus = wire.sample_modulus
        slow = wire.counting is not None and wire.counting not in wire.parts
        self.sequence = SampleNumbers(self.clock, period_ns, self._modulus, wire.number_modulus if slow else 0)
        self.sets: FrameSets[Report] = FrameSets(len(wire.parts), wire.part_modulus, period_ns)
        numbered = wire.parts[0]
        self._alive_modulus = numbered.counts("alive") if numbered.counts("counter") else 0
        self.samples: deque[tuple[int, Sample, Truth | None]] = deque()
        self.received = self.overflowed = self.stale = self.boot_ups = self.error_counter = self.error_limit_hits = 0
        self.counts = dict.fromkeys(_REASONS + _ERRORS, 0)
        self.amplifier: State | None = None
        self.board_fault: int | None = None
        self.referenced: bool | None = None
        self._said: dict[int, tuple[int | None, ...] | None] = {}
        """By identifier the newest frame's counter, and what its page does not say; None of a sample."""
        self.ambiguous = False
        self._homed_ns: int | None = None
        """When x became referenced, while no good reading has come since."""
        self._x_modulus = wire.sample.x_modulus
        if self._x_modulus:
            low, high = reach(stage.motion)
            self._travel = low - stage.guide.runout, high + stage.guide.runout
        self.newest_ns = self.status_ns = self.heartbeat_ns = self._stamp_ns = 0
        self.node_state: int | None = None
        self.current = 0.0
        self._memory, self._error_limit = parameters.sample_memory, parameters.strike_limit
        self._stale_ns = round(parameters.sample_timeout * 1e9)
        self._x_step = stage.motion.highest_speed * period_ns * 1e-9
        self._y_step = parameters.y_speed * period_ns * 1e-9
        self._x_noise = wire.noise("x", stage.encoder.x_resolution)
        self._y_noise = wire.noise("y", stage.encoder.y_resolution)
        self._accepted: int | None = None
        """Count of the newest accepted frame; 0 for frames without."""
        self._good: tuple[float, float] | None = None
        """Newest good reading."""
        self._since = 0
        """Samples from it to the newest accepted one."""
        self._truth: tuple[int, Truth | None] = (-1, None)
        self._handlers: dict[int, Callable[[bytes, int], None]] = {
            identifier: partial(self._receive, frames) for identifier, frames in wire.reports.items()
        }
        if len(wire.parts) > 1:
            for number, frames in enumerate(wire.parts):
                self._handlers[frames.identifier] = partial(self._receive_component, number, frames)
        if wire.heartbeat:
            self._handlers[wire.heartbeat.identifier] = partial(self._receive_heartbeat, wire.heartbeat)
        self.emulator = EmulatorFrames(wire) if parameters.simulated_stage else None
        if self.emulator and parameters.fd:
            self._handlers[self.emulator.truth_id] = partial(self._receive_truth, self.emulator)
        self.identifiers = list(self._handlers)

    def restart(self) -> None:
        """Forget the board's samples and its reference, as after its restart; counters stay."""
        self._begin_anew()
        self.referenced = self._homed_ns = None

    def _begin_anew(self) -> None:
        self.sequence.reset()
        self.sets.reset()
        self._said.clear()
        self.amplifier = None
        self.error_counter = 0

    def take(self, frame: Frame, arrival_ns: int) -> None:
        """Take a frame of any kind; one without data, or of no known identifier, is counted."""
        handler = self._handlers.get(frame.identifier)
        if frame.flags & ERROR:
            self._count_error(frame.identifier, frame.data)
        elif frame.flags & REMOTE:
            self.counts["remote"] += 1
        elif handler is None:
            self.counts["foreign"] += 1
        else:
            try:
                handler(frame.data, arrival_ns)
            except FrameError as error:
                self.counts[str(error)] += 1
                self.error_counter += _BAD_FRAME
                if self.error_counter >= self._error_limit:
                    self.error_limit_hits += 1
                    self._begin_anew()

    def _count_error(self, classes: int, details: bytes) -> None:
        """An error that the interface reports, by the identifier and the payload of Linux's error frame."""
        self.counts["error_frames"] += 1
        self.counts["bus_off"] += bool(classes & _BUS_OFF)
        self.counts["error_passive"] += bool(classes & _CONTROLLER and len(details) > 1 and details[1] & _PASSIVE)

    def _receive(self, frames: Frames, payload: bytes, arrival_ns: int) -> None:
        report = frames.unpack(payload)
        if report.x is not None:
            self._said[frames.identifier] = None
            self._take_sample(report, arrival_ns)
            return
        # Pages may count together, or each by itself.
        said = report.alive, *[value is None for value in report]
        if report.alive is not None and said == self._said.get(frames.identifier):
            # The task that fills these frames may have stopped, with its last one in the mailbox.
            self.sequence.repeated += 1
            return
        self._said[frames.identifier] = said
        self._take_reference(report, arrival_ns)
        self._take_status(report, arrival_ns)
        if report.counter is not None and (placed := self.sequence.place(report.counter, arrival_ns)):
            self._place(*placed)

    def _receive_component(self, number: int, frames: Frames, payload: bytes, arrival_ns: int) -> None:
        """Take a frame with a component of a sample, whose others come in frames of other messages."""
        report = frames.unpack(payload)
        if whole := self.sets.add(number, report, report.number or 0, arrival_ns):
            self._take_sample(*whole)

    def _take_sample(self, report: Report, arrival_ns: int) -> None:
        ahead = self.sequence.ahead(report.number, arrival_ns)
        if ahead is None:
            self.sequence.wait(report, arrival_ns)
        else:
            self._place(report, ahead, arrival_ns)

    def _place(self, report: Report, ahead: int, arrival_ns: int) -> None:
        """Take a sample that is so many ahead of the newest."""
        sequence = self.sequence
        if sequence.index is None:
            # What was accepted before had other numbers.
            self._accepted = self._good = None
        if not sequence.plausible(ahead, arrival_ns):
            raise FrameError("implausible")
        last, x, y = self._accepted, report.x, report.y
        assert x is not None and y is not None
        self._take_reference(report, arrival_ns)
        ambiguous = False
        if self._x_modulus:
            x, ambiguous = self._unwrapped(x, ahead, arrival_ns)
        alive = report.alive or 0
        if last is not None and self._alive_modulus and (alive - last - ahead) % self._alive_modulus:
            # Frames and samples do not count alike.
            raise FrameError("alive")
        if ahead <= 0:
            sequence.count_old(ahead)
            return
        if report.good and not self._is_near(x, y, ahead):
            raise FrameError("implausible")
        self._accepted, self._since = alive, self._since + ahead
        index = sequence.accept(report.number, ahead, arrival_ns)
        self.received += 1
        self._take_status(report, arrival_ns)
        if self.error_counter:
            self.error_counter -= 1
        if not report.good:
            self.counts["encoders"] += 1
            return
        self._good, self._since, self._homed_ns = (x, y), 0, None
        self.ambiguous = ambiguous
        if self.clock.settled:
            self._deliver(x, y, index, arrival_ns)

    def _unwrapped(self, x: float, ahead: int, arrival_ns: int) -> tuple[float, bool]:
        """The position of the stage, and whether it may be another one, from what its counter says.

        The turn of the counter follows from the last sample if the stage cannot have moved by half a turn since. Else
        it is known where only one turn is on the travel, and after homing, which ends in the turn of the reference: or
        a little before it, where the counter begins at the reference.
        """
        turn, (least, largest) = self._x_modulus, self._travel
        if self._good is not None:
            last_x, _ = self._good
            ahead += self._since
            if self._x_noise + self._x_step * ahead < 0.5 * turn:
                return last_x + math.remainder(x - last_x, turn), self.ambiguous
        if self._homed_ns is not None:
            way = self._x_noise + self._x_step * (1.0 + (arrival_ns - self._homed_ns) / self._period_ns)
            if way < 0.5 * turn:
                begin, end = self.wire.sample.turn
                begin -= math.copysign(way, end - begin)
                least, largest = max(least, min(begin, end)), min(largest, max(begin, end))
        turns = range(math.ceil((least - x) / turn), math.floor((largest - x) / turn) + 1)
        return (x + turns[0] * turn, False) if len(turns) == 1 else (x, True)

    def _is_near(self, x: float, y: float, ahead: int) -> bool:
        """Whether stage and platform can have come here since the last good reading."""
        if self._good is None:
            return True
        last_x, last_y = self._good
        ahead += self._since
        near_x: bool = abs(x - last_x) <= self._x_noise + self._x_step * ahead
        near_y: bool = abs(y - last_y) <= self._y_noise + self._y_step * ahead
        return near_x and near_y

    def _take_reference(self, report: Report, arrival_ns: int) -> None:
        """A board that becomes referenced counts x from another zero, and in the turn of the reference."""
        if report.referenced is not None:
            if report.referenced and self.referenced is False:
                self._good, self._homed_ns = None, arrival_ns
            self.referenced = report.referenced

    def _take_status(self, report: Report, arrival_ns: int) -> None:
        if report.amplifier is not None:
            self.amplifier, self.status_ns = report.amplifier, arrival_ns
        if report.fault is not None:
            self.board_fault = report.fault
        if report.current is not None:
            if math.isnan(report.current):
                self.counts["current"] += 1
            else:
                self.current = report.current

    def _deliver(self, x: float, y: float, index: int, arrival_ns: int) -> None:
        stamp_ns = self.clock.stamp(index)
        if stamp_ns <= self._stamp_ns:
            # After a reset of the clock, stamps must still not run backwards.
            return
        self._stamp_ns, self.newest_ns = stamp_ns, arrival_ns
        if arrival_ns - stamp_ns > self._stale_ns:
            self.stale += 1
        current = self.current if self.amplifier is State.ON else math.nan
        sample = Sample(stamp_ns, x, y, current)
        counter, truth = self._truth
        known = truth is not None and (not self._modulus or (counter - index) % self._modulus == 0)
        self.samples.append((index, sample, truth if known else None))
        if len(self.samples) > self._memory:
            self.samples.popleft()
            self.overflowed += 1

    def _receive_truth(self, emulator: EmulatorFrames, payload: bytes, _: int) -> None:
        try:
            self._truth = emulator.truth_of(payload)
        except FrameError:
            # Nothing acts on the truth, so a damaged one does not count as a bad frame.
            self.counts["truth"] += 1

    def _receive_heartbeat(self, heartbeat: Frames, payload: bytes, arrival_ns: int) -> None:
        (self.node_state,) = heartbeat.unpack(payload)
        self.heartbeat_ns = arrival_ns
        if self.node_state == self.wire.meaning.heartbeat.boot_up_value:
            self.boot_ups += 1
            self.restart()

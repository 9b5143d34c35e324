"""The board on CAN behind the hardware interface: handshake, monitoring, latched faults."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy

from straightcomp_ros.hardware.can.board_dbc import gaps
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import Command
from straightcomp_ros.hardware.can.link import Link
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.interface import SILENT_SAMPLES, Hardware, HardwareError, Sample, State, Truth
from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.model.paced_motion import Pace, PacedMotion
from straightcomp_ros.safety.faults import Fault, Finding
from straightcomp_ros.stage.description import StageParameters

_REMEMBERED = 512
"""Samples whose numbers are kept for the echo in a command."""
_UNNAMED = Fault.BOARD, "the board reports: a fault"
_BEAT = "no heartbeat"
_UNREADY: dict[State | None, str] = {
    State.ON: "the board has not switched its amplifier off yet",
    State.FAULT: "the board has not cleared its fault yet",
}
"""Why the amplifier must not be switched on while the board reports this."""
_TIMEOUTS = 4
"""Times `command_timeout` without a command that are a fault: a board reports its own timeout before, which says more;
and with the default of 5 ms this is within the 30 ms that docs/safety.md promises."""
_TURNS = 3
"""Reads of the bus without a sample after which monitoring must run."""


class CanHardware(Hardware):
    """A board that samples by itself and is switched by the pattern in each command.

    This class latches every fault, the board's and its own. Commands then say "off" until the fault has been reset and
    the amplifier is enabled again.

    ``clock`` is the host's time in ns, as passed to :meth:`read`; ``make_link`` opens the bus and raises as
    :class:`~straightcomp_ros.hardware.can.link.Link` does; ``x`` is where an emulator's stage stands at first, m.
    """

    fault: Finding | None = None
    heartbeat_losses = 0
    """How often the heartbeat was lost while the amplifier was on."""

    def __init__(
        self,
        parameters: CanParameters,
        stage: StageParameters,
        clock: Callable[[], int],
        make_link: Callable[..., Link] = Link,
        x: float = 0.0,
    ) -> None:
        self._parameters = parameters
        self._clock = clock
        self._stage, self._rate, self.motion = stage.motion, stage.rate, PacedMotion(stage.motion, x)
        self._receiver = Receiver(parameters, stage)
        self._wire = self._receiver.wire
        self._link = make_link(parameters, self._receiver.identifiers, self._receiver.take, clock)
        self._numbers: dict[int, int] = {}
        self._newest_number = self._turn = self._deadline_ns = self._command_ns = 0
        self._silence_ns = max(_TIMEOUTS * parameters.command_timeout * 1e9, SILENT_SAMPLES * stage.period_ns)
        self._sample_silence_s, self._state_silence_s = parameters.silences(stage.rate)
        self._within = f"within {parameters.answer_timeout * 1e3:g} ms"
        self._current = 0.0
        self._wanted = self._was_on = self._resetting = False
        self._seen = self._upsets()

    def start(self, now_ns: int) -> None:
        # After a pause without reading, there may be another board.
        self._receiver.restart()
        self._await_answer()
        self._link.start()

    def wait(self, timeout_ns: int) -> None:
        for _ in range(_TURNS):
            if not self._link.wait(timeout_ns * 1e-9) or self._receiver.samples:
                break

    def read(self, now_ns: int) -> list[tuple[Sample, Truth | None]]:
        self._watch(now_ns)
        waiting = self._receiver.samples
        # Bounded: samples that arrive meanwhile are for the next call.
        fresh = [waiting.popleft() for _ in range(len(waiting))]
        for number, sample, _ in fresh:
            self._numbers[sample.stamp_ns] = self._newest_number = number
        while len(self._numbers) > _REMEMBERED:
            del self._numbers[next(iter(self._numbers))]
        return [(sample, truth) for _, sample, truth in fresh]

    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        if not math.isfinite(current):
            raise ValueError(f"control current {current} A is not finite")
        number = self._newest_number if sample_ns is None else self._numbers.get(sample_ns, self._newest_number)
        if self._send(number, current):
            self._current, self._command_ns = current, self._clock()

    def enable(self) -> None:
        if self.fault:
            raise HardwareError(f"a fault is latched: {self.fault[1]}")
        if refusal := self._not_ready(self._clock()):
            raise HardwareError(refusal)
        if not self._wanted:
            # The board switches on at an edge, so it must have seen "off" before.
            self._send(self._newest_number)
            self._wanted, self._was_on, self._resetting = True, False, False
            self._seen = self._upsets()
            self._await_answer()

    def disable(self) -> None:
        self._wanted = self._was_on = False
        self._current = 0.0
        self._await_answer()
        self._send(self._newest_number)

    def reset_fault(self) -> None:
        if self.fault:
            self.fault = None
            self._resetting = True
            self._await_answer()
            self._send(self._newest_number)

    def move(self, trajectory: Trajectory, start_ns: int) -> None:
        frames, begun = self._frames_for_stage(), copy(self.motion)
        begun.position(start_ns)
        if not begun.moving and trajectory.times[0] <= 0:
            # Where the emulator's stage stands it knows itself.
            begun = PacedMotion(self._stage, trajectory.position(0))
            begun.ask(self.motion.pace)
            begun.number = self.motion.number
        # An emulator that has started meanwhile does not know the pace.
        pace = frames.pace_payload(begun.pace)
        begun.begin(trajectory, start_ns)
        self._send_to_stage([pace, *frames.stage_payloads(trajectory.waypoints)])
        self.motion = begun

    def home(self, now_ns: int) -> None:
        if self._receiver.emulator is None:
            super().home(now_ns)  # it refuses
        frames = self._frames_for_stage()
        self._send_to_stage([frames.pace_payload(self.motion.pace), *frames.stage_payloads(())])

    def pace(self, pace: Pace) -> None:
        frame = self._frames_for_stage().pace_payload(pace)
        self.motion.position(self._clock())
        # An override may wait: it is sent with the next motion. A stop or the end of a hold must not: where the motion
        # is over here, the emulator's stage may still move, or be held on its way.
        stops = pace.hold or pace.end or self.motion.pace.hold
        if stops or not (self.motion.over and self._link.problem):
            self._send_to_stage([frame])
        self.motion.ask(pace)

    def _frames_for_stage(self) -> EmulatorFrames:
        emulator = self._receiver.emulator
        if emulator is None:
            raise HardwareError(self.stage_refusal)
        return emulator

    def _send_to_stage(self, frames: Iterable[tuple[int, bytes]]) -> None:
        for identifier, payload in frames:
            if not self._link.send(identifier, payload, fd=False):
                raise HardwareError(f"the stage's frames were not sent: {self._link.problem or 'transmit queue full'}")

    def close(self) -> None:
        super().close()
        self._link.close()

    @property
    def state(self) -> State:
        return State.FAULT if self.fault else State.ON if self._wanted and self._was_on else State.OFF

    @property
    def lost_samples(self) -> int:
        return self._receiver.sequence.lost + self._receiver.overflowed

    @property
    def applied_current(self) -> float:
        return self._current if self.state is State.ON else 0.0

    @property
    def unreferenced(self) -> str:
        receiver = self._receiver
        if "referenced" in self._wire.homes and not receiver.referenced:
            # None: it has not said anything.
            return self._no_word if receiver.referenced is None else "the board reports no reference"
        if receiver.ambiguous:
            turn_mm = self._wire.sample.x_modulus * 1e3
            return f"x repeats itself every {turn_mm:g} mm, and more than one such turn is on the travel"
        return ""

    @property
    def stage_refusal(self) -> str:
        simulated = self._receiver.emulator is not None
        return "" if simulated else "the stage takes no orders over CAN; 'can.simulated_stage' is for the emulator's"

    @property
    def _no_word(self) -> str:
        return ": ".join(filter(None, ("nothing has come from the board yet", self.link_problem)))

    @property
    def link_problem(self) -> str:
        rate = self._receiver.clock.other_rate
        other = f"the board samples at about {rate:.0f} Hz, 'stage.rate' is {self._rate:g} Hz" if rate else ""
        return self._link.problem or other

    @property
    def newest_arrival_ns(self) -> int:
        return self._receiver.newest_ns

    def remarks(self) -> Sequence[str]:
        return gaps(self._wire)

    def counters(self) -> Mapping[str, object]:
        receiver, sequence, link, log = self._receiver, self._receiver.sequence, self._link, self._link.log
        counters: dict[str, object] = {
            "received": receiver.received,
            "lost": sequence.lost,
            "incomplete": receiver.sets.incomplete,
            "repeated": sequence.repeated + receiver.sets.repeated,
            "out_of_order": sequence.out_of_order + receiver.sets.out_of_order,
            "stale": receiver.stale,
            "counter_jumps": sequence.jumps,
            "strikes": receiver.error_counter,
            "strike_outs": receiver.error_limit_hits,
            "boot_ups": receiver.boot_ups,
            "heartbeat_losses": self.heartbeat_losses,
            "openings": link.openings,
            "transmit_full": link.transmit_full,
            "overloads": link.overloads,
            **receiver.counts,
        }
        if receiver.amplifier is State.FAULT and receiver.board_fault is not None:
            counters["board_fault"] = self._wire.fault_words(receiver.board_fault)
        if log:
            counters |= {"logged": log.written, "log_dropped": log.dropped}
        problems = {"link": link.problem, "log": log.problem if log else ""}
        counters |= {name: problem for name, problem in problems.items() if problem}
        return {f"can_{name}": value for name, value in counters.items()}

    def _upsets(self) -> dict[str, int]:
        """Counters of events that must not happen while the amplifier is on, by the text of the fault."""
        receiver = self._receiver
        return {
            "the board restarted (boot-up message)": receiver.boot_ups,
            "too many frames failed their checks": receiver.error_limit_hits,
            "the board's sample counter jumped": receiver.sequence.jumps,
            "the CAN controller is bus-off": receiver.counts["bus_off"],
        }

    def _watch(self, now_ns: int) -> None:
        reported = self._receiver.amplifier
        if self._resetting:
            if reported is State.FAULT and now_ns <= self._deadline_ns:
                self._send(self._newest_number)
                return
            self._resetting = False
        if reported is State.FAULT and self.fault in (None, _UNNAMED):
            # At once; its code may come in a later frame.
            code = self._receiver.board_fault
            named = code is not None and code != self._wire.meaning.fault.none_value
            words = f"the board reports: {self._wire.fault_words(code or 0)}"
            self._latch((Fault.BOARD, words) if named else _UNNAMED)
        if self._wanted:
            if found := self._finding(now_ns, reported):
                self._latch(found)
        elif reported is not State.ON:
            # Should it switch on by itself, it has this long to obey.
            self._await_answer()
        else:
            # The frame that said "off" may be lost.
            self._send(self._newest_number)
            # Not by an older state: that may come in frames of its own, or not at all.
            if self.fault is None and self._receiver.status_ns > self._deadline_ns:
                self._latch((Fault.BOARD, f"the board did not switch off {self._within}"))

    def _finding(self, now_ns: int, reported: State | None) -> Finding | None:
        """The fault of a board that is to be on."""
        for words, count in self._upsets().items():
            if count != self._seen[words]:
                return Fault.BOARD, words
        if found := self._idle() or self._silence(now_ns):
            return found
        if reported is State.ON:
            # By a command that was sent: "on" goes out with a current only.
            self._was_on = True
            age_ns = now_ns - self._command_ns
            if age_ns > self._silence_ns:
                return Fault.COMMAND_TIMEOUT, f"no command was sent for {age_ns * 1e-6:.1f} ms"
        elif self._was_on:
            return Fault.BOARD, "the board switched the amplifier off"
        elif now_ns > self._deadline_ns:
            return Fault.BOARD, f"the board did not switch on {self._within}"
        return None

    def _idle(self) -> Finding | None:
        """The fault if the board's heartbeat says that it does not work."""
        state, operational = self._receiver.node_state, self._wire.meaning.heartbeat.operational_value
        if self._wire.heartbeat and state != operational:
            return Fault.BOARD, f"the board's heartbeat says state {state}, not {operational} (operational)"
        return None

    def _silence(self, now_ns: int) -> Finding | None:
        """The fault if heartbeat, samples or state have stopped; the state may come in frames of its own."""
        receiver = self._receiver
        heartbeat_s = self._parameters.heartbeat_timeout if self._wire.heartbeat else math.inf
        for newest_ns, timeout_s, kind, what in (
            (receiver.heartbeat_ns, heartbeat_s, Fault.HEARTBEAT_LOST, _BEAT),
            (receiver.newest_ns, self._sample_silence_s, Fault.SAMPLE_TIMEOUT, "no good sample"),
            (receiver.status_ns, self._state_silence_s, Fault.HEARTBEAT_LOST, "no state of the amplifier"),
        ):
            age_ns = now_ns - newest_ns
            if age_ns > timeout_s * 1e9:
                self.heartbeat_losses += self._wanted and what == _BEAT
                problem = f" ({self._link.problem})" if self._link.problem else ""
                return kind, f"{what} for {min(age_ns * 1e-6, 1e6):.1f} ms{problem}"
        return None

    def _not_ready(self, now_ns: int) -> str:
        receiver = self._receiver
        heartbeat = self._wire.heartbeat
        if (heartbeat and not receiver.heartbeat_ns) or not receiver.status_ns or not receiver.newest_ns:
            return self._no_word
        if found := self._idle() or self._silence(now_ns):
            return found[1]
        return "" if self._wanted else _UNREADY.get(receiver.amplifier, "")

    def _latch(self, found: Finding) -> None:
        """Switch off, unless a fault was latched before, which now gets its name."""
        before, self.fault = self.fault, found
        if before is None:
            self.disable()

    def _await_answer(self) -> None:
        self._deadline_ns = self._clock() + round(self._parameters.answer_timeout * 1e9)

    def _send(self, number: int, current: float = 0.0) -> bool:
        asked = current if self._wanted else 0.0
        command = Command(0, self._wanted, self._resetting, asked, number % (self._wire.echo_modulus or 1))
        # Packed before any is sent: a current that does not fit is refused as a whole.
        payloads = [one.pack(command._replace(alive=self._turn % one.alive_modulus)) for one in self._wire.commands]
        frames = zip(self._wire.commands, payloads, strict=True)
        sent = sum(self._link.send(one.identifier, payload, fd=one.fd) for one, payload in frames)
        # A count that was sent, if only in one of several messages, must not come again.
        self._turn += sent > 0
        complete = sent == len(self._wire.commands)
        if complete and self._wire.current is None:
            self._receiver.current = asked
        return complete

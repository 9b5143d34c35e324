"""The board on CAN behind the hardware interface: handshake, monitoring, latched faults."""

import math
from collections.abc import Callable, Mapping, Sequence

from straightcomp_ros.hardware.can.board_dbc import gaps
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import Amplifier, Command
from straightcomp_ros.hardware.can.link import Link
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.interface import Hardware, HardwareError, Sample, State, Truth
from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.safety.faults import Fault, Finding
from straightcomp_ros.stage.description import StageParameters

_REMEMBERED = 512
"""Samples whose numbers are kept for the echo in a command."""
_UNNAMED = "the board reports: a fault"
_TURNS = 3
"""Reads of the bus without a sample after which monitoring must run."""


class CanHardware(Hardware):
    """A board that samples by itself and is switched by the pattern in each command.

    This class latches every fault, the board's and its own. Commands then say "off" until the fault has been reset and
    the amplifier is enabled again.

    ``clock`` is the host's time in ns, as passed to :meth:`read`; ``make_link`` opens the bus and raises as
    :class:`~straightcomp_ros.hardware.can.link.Link` does.
    """

    fault = ""
    heartbeat_losses = 0
    """How often the heartbeat was lost while the amplifier was on."""

    def __init__(
        self,
        parameters: CanParameters,
        stage: StageParameters,
        clock: Callable[[], int],
        make_link: Callable[..., Link] = Link,
    ) -> None:
        self._parameters = parameters
        self._clock = clock
        self._receiver = Receiver(parameters, stage)
        self._wire = wire = self._receiver.wire
        self._stage_frames = EmulatorFrames(parameters.node, wire) if parameters.simulated_stage else None
        self._link = make_link(parameters, self._receiver.identifiers, self._receiver.take, clock)
        self._numbers: dict[int, int] = {}
        self._newest_number = self._turn = self._deadline_ns = 0
        self._current = 0.0
        self._wanted = self._was_on = self._resetting = False
        self._fault_kind = Fault.BOARD
        self._seen = self._upsets()

    def start(self, now_ns: int) -> None:
        # After a pause without reading, there may be another board.
        self._receiver.restart()
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
        command = self._wire.command
        if not command.fits("current", current):
            least, largest = command.spans["current"]
            allowed = f"{least:.6g} to {largest:.6g} A"
            raise ValueError(f"control current {current} A does not fit its frame; allowed: {allowed}")
        number = self._newest_number if sample_ns is None else self._numbers.get(sample_ns, self._newest_number)
        if self._send(number, current):
            self._current = current

    def enable(self) -> None:
        if self.fault:
            raise HardwareError(f"a fault is latched: {self.fault}")
        refusal = self._not_ready(self._clock())
        if refusal:
            raise HardwareError(refusal)
        if not self._wanted:
            # The board switches on at an edge, so it must have seen "off" before.
            self._send(self._newest_number)
            self._wanted, self._was_on = True, False
            self._seen = self._upsets()
            self._await_answer()

    def disable(self) -> None:
        self._wanted = self._was_on = False
        self._current = 0.0
        self._send(self._newest_number)

    def reset_fault(self) -> None:
        if self.fault:
            self.fault = ""
            self._resetting = True
            self._await_answer()
            self._send(self._newest_number)

    def move(self, trajectory: Trajectory, start_ns: int) -> None:
        if self._stage_frames is None:
            raise HardwareError("the stage takes no orders over CAN; 'can.simulated_stage' is for the emulator's")
        for identifier, payload in self._stage_frames.stage_payloads(trajectory.waypoints):
            if not self._link.send(identifier, payload, fd=False):
                raise HardwareError(f"stage trajectory was not sent: {self._link.problem or 'transmit queue full'}")

    def close(self) -> None:
        super().close()
        self._link.close()

    @property
    def state(self) -> State:
        return State.FAULT if self.fault else State.ON if self._wanted and self._was_on else State.OFF

    @property
    def fault_kind(self) -> Fault | None:
        return self._fault_kind if self.fault else None

    @property
    def lost_samples(self) -> int:
        return self._receiver.sequence.lost + self._receiver.sequence.unplaced + self._receiver.overflowed

    @property
    def applied_current(self) -> float:
        return self._current if self.state is State.ON else 0.0

    @property
    def newest_arrival_ns(self) -> int:
        return self._receiver.newest_ns

    def remarks(self) -> Sequence[str]:
        return gaps(self._wire)

    def counters(self) -> Mapping[str, object]:
        receiver, sequence, link = self._receiver, self._receiver.sequence, self._link
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
        if receiver.amplifier is Amplifier.FAULT and receiver.board_fault is not None:
            counters["board_fault"] = self._wire.fault_words(receiver.board_fault)
        if link.problem:
            counters["link"] = link.problem
        if link.log:
            counters |= {"logged": link.log.written, "log_dropped": link.log.dropped}
            if link.log.problem:
                counters["log"] = link.log.problem
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
            if reported is Amplifier.FAULT and now_ns <= self._deadline_ns:
                self._send(self._newest_number)
                return
            self._resetting = False
        if reported is Amplifier.FAULT and self.fault in ("", _UNNAMED):
            self._take_board_fault()
        if self._wanted:
            self._watch_running(now_ns, reported)
        elif reported is Amplifier.ON:
            # The frame that said "off" may be lost.
            self._send(self._newest_number)

    def _take_board_fault(self) -> None:
        """Latch the board's fault at once, and name it as soon as its code has come, which may be in a later frame."""
        code = self._receiver.board_fault
        named = code is not None and code != self._wire.meaning.fault.none_value
        reason = f"the board reports: {self._wire.fault_words(code or 0)}" if named else _UNNAMED
        if not self.fault:
            self._latch(Fault.BOARD, reason)
        self.fault = reason

    def _watch_running(self, now_ns: int, reported: Amplifier | None) -> None:
        for words, count in self._upsets().items():
            if count != self._seen[words]:
                self._latch(Fault.BOARD, words)
                return
        silence = self._silence(now_ns)
        if silence is not None:
            self._latch(*silence)
        elif reported is Amplifier.ON:
            self._was_on = True
        elif self._was_on:
            self._latch(Fault.BOARD, "the board switched the amplifier off")
        elif now_ns > self._deadline_ns:
            self._latch(Fault.BOARD, f"the board did not switch on within {self._parameters.answer_timeout * 1e3:g} ms")

    def _silence(self, now_ns: int) -> Finding | None:
        """The fault if heartbeat, state or samples have stopped."""
        parameters, receiver = self._parameters, self._receiver
        heartbeat_age, status_age, sample_age = (
            now_ns - then for then in (receiver.heartbeat_ns, receiver.status_ns, receiver.newest_ns)
        )
        problem = f" ({self._link.problem})" if self._link.problem else ""
        if self._wire.heartbeat and heartbeat_age > parameters.heartbeat_timeout * 1e9:
            self.heartbeat_losses += self._wanted
            return Fault.HEARTBEAT_LOST, f"no heartbeat for {_ms(heartbeat_age)} ms{problem}"
        if sample_age > parameters.sample_timeout * 1e9:
            return Fault.SAMPLE_TIMEOUT, f"no good sample for {_ms(sample_age)} ms{problem}"
        # The amplifier's state may come in frames of its own, which can stop while the samples go on.
        if status_age > max(parameters.heartbeat_timeout, parameters.sample_timeout) * 1e9:
            return Fault.HEARTBEAT_LOST, f"no state of the amplifier for {_ms(status_age)} ms{problem}"
        return None

    def _not_ready(self, now_ns: int) -> str:
        receiver = self._receiver
        heartbeat = self._wire.heartbeat
        if (heartbeat and not receiver.heartbeat_ns) or not receiver.status_ns or not receiver.newest_ns:
            return f"nothing has come from the board yet{': ' if self._link.problem else ''}{self._link.problem}"
        operational = self._wire.meaning.heartbeat.operational_value
        if heartbeat and receiver.node_state != operational:
            return f"the board's heartbeat says state {receiver.node_state}, not {operational} (operational)"
        silence = self._silence(now_ns)
        return silence[1] if silence is not None else ""

    def _latch(self, kind: Fault, reason: str) -> None:
        self.fault, self._fault_kind = reason, kind
        self.disable()

    def _await_answer(self) -> None:
        self._deadline_ns = self._clock() + round(self._parameters.answer_timeout * 1e9)

    def _send(self, number: int, current: float = 0.0) -> bool:
        asked = current if self._wanted else 0.0
        command = Command(0, self._wanted, self._resetting, asked, number % (self._wire.echo_modulus or 1))
        sent = 0
        for frames in self._wire.commands:
            payload = frames.pack(command._replace(alive=self._turn % frames.alive_modulus))
            sent += self._link.send(frames.identifier, payload, fd=frames.fd)
        # A count that was sent, if only in one of several messages, must not come again.
        self._turn += sent > 0
        complete = sent == len(self._wire.commands)
        if complete and self._wire.current is None:
            self._receiver.current = asked
        return complete


def _ms(age_ns: int) -> str:
    return f"{min(age_ns * 1e-6, 1e6):.1f}"

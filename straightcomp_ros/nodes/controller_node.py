"""controller: encoder samples and their references in, control current out."""

import math
import time
from collections.abc import Callable
from functools import partial

from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import SetBool

from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, ENCODER, REFERENCE, STAGE_STATE
from straightcomp_ros.control.excitation import Injection, made_injection
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.laws import OPEN_LOOP, make_law, prepare_all
from straightcomp_ros.control.learning import Learning
from straightcomp_ros.control.margins import NotLinear, missing_margin
from straightcomp_ros.control.pairing import Pairing
from straightcomp_ros.control.servo import FADE_TIME, Servo
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters
from straightcomp_ros.runtime.guarded_node import Refused
from straightcomp_ros.runtime.loops import Loop, MessageLoop, PeriodicLoop, WorkerThread, awaited, sendings
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.runner import run_managed
from straightcomp_ros.runtime.safety_panel import LATCHED, tripper
from straightcomp_ros.runtime.stage_state import stage_state
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.watch import ErrorWatch
from straightcomp_ros.timing.delays import StampGaps
from straightcomp_ros.timing.node_timing import EXCITATION, EXCITING, FINISHED, LOST, SAMPLES

_LOOK_FOR_SILENCE_S = 0.05
_SPARE_REFERENCES = 2
"""The loop fetches references when those it holds reach fewer than so many samples ahead."""

Answer = tuple[int, Command, float]
"""Stamp of the sample in ns, the law's command, age of the reference in s."""


def _mark_cut(learning: Learning, message: DiagnosticStatus) -> None:
    learning.cut = stage_state(message).cut


class ControllerComponent:
    """Pairs each sample with its reference and steps the law.

    ``trigger`` says what begins a cycle: the arrival of a sample, a timer, or in lockstep each message. When a cycle
    finds several new samples the law steps through all of them in order: its velocity estimate and its integral need
    every sample, and a replay of the bag gives the same commands.
    """

    def __init__(self, node: ManagedNode, parameters: ControllerNodeParameters) -> None:
        self._node, self._parameters = node, parameters
        # `control.law` may change while the loop runs.
        prepare_all()
        lockstep = parameters.trigger == "lockstep"
        self._worker = WorkerThread(node.get_logger().error)
        run = self._worker.run if not lockstep else lambda job: job()
        learning, law, rate = parameters.learning, parameters.control.law, parameters.stage.rate
        self._learning = Learning(learning, law, rate, run) if learning.learn else None
        if self._learning is not None:
            self._learning.check_file()
        self._law = self._made(parameters)
        if self._learning is not None:
            node.create_subscription(DiagnosticStatus, STAGE_STATE, partial(_mark_cut, self._learning), LATCHED)
        self._servo = Servo(self._law, learning=self._learning)
        self._new_pairing = partial(Pairing, parameters.lead_ns, wait=lockstep)
        self._pairing = self._new_pairing()
        rate, streams = parameters.stage.rate, node.streams
        self._publish_command = streams.publisher(COMMAND, None if lockstep else rate, at_once=True)
        self._publish_state = streams.publisher(CONTROLLER_STATE, rate)
        self._samples_seen = self._commands = self._refused = 0
        self._gaps = StampGaps()
        self._trip = tripper(node)
        self._error_watch = ErrorWatch(parameters.error_limit)
        self._excitation = ExcitationService(node, self._servo, self._made_injection, self._left_travel)
        self._silent, self._seen = 0, 0
        self._samples, self._references = streams.queue(ENCODER), streams.batches(REFERENCE)
        period_ns = parameters.stage.period_ns
        self._spare_ns = _SPARE_REFERENCES * period_ns
        self._apart_ns = period_ns // 2
        self.loop: Loop = (
            PeriodicLoop(period_ns, lambda wake_ns: self._cycle())
            if parameters.trigger == "timer"
            else MessageLoop(period_ns, self._wait_in_lockstep if lockstep else self._wait, self._cycle)
        )
        streams.follow(self._cycle)
        if not lockstep:
            self._silence_looks = math.ceil(parameters.sample_timeout / _LOOK_FOR_SILENCE_S)
            node.create_timer(_LOOK_FOR_SILENCE_S, self._look_for_silence)
        Diagnostics(node, self._counters, self.loop.report, description=parameters.stage.identity)

    def activate(self) -> None:
        """Start with the samples that arrive from now on."""
        self._samples.fetch()
        self._references.fetch()
        self._gaps.interrupt()
        self._pairing = self._new_pairing()

    def prepare(self, parameters: ControllerNodeParameters) -> Callable[[], None]:
        """Prepare another law or other gains; the servo fades from the old command to the new one."""
        if self._learning is not None and parameters.control.law != self._parameters.control.law:
            raise ParameterError(
                f"parameter 'control.law': {parameters.control.law!r} is not the law that the learning started with; "
                f"allowed while 'learning.learn' is true: {self._parameters.control.law}"
            )
        former = self._parameters
        same_law = (parameters.control, parameters.stage) == (former.control, former.stage)
        # Eigenvalues take several cycles.
        law = self._law if same_law else awaited(lambda: self._made(parameters), self._node.go_on)

        def take_over() -> None:
            self._parameters, self._law = parameters, law
            self._error_watch.limit = parameters.error_limit
            if not same_law:
                self._servo.change(law, round(FADE_TIME * parameters.stage.rate))

        return take_over

    def _made_injection(self) -> Injection:
        """The excitation of the parameters; its table of currents takes many cycles."""
        parameters = self._parameters

        def make() -> Injection:
            # A law of its own: the one that runs must not be stepped from two threads.
            law = make_law(parameters.control, parameters.stage)
            return made_injection(parameters.excitation, law, parameters.stage)

        return awaited(make, self._node.go_on)

    def _left_travel(self, reason: str) -> None:
        # Under a law the excitation fades out and the platform is held. In open loop nothing holds it.
        if self._parameters.control.law == OPEN_LOOP:
            self._trip(Fault.FOLLOWING_ERROR, f"excitation in open loop: {reason}")

    def _made(self, parameters: ControllerNodeParameters) -> Law:
        """The law of these parameters; ParameterError if it lacks a margin that they require, or cannot be made."""
        if missing := missing_margin(parameters.control, parameters.stage):
            if parameters.control.margins == "require":
                raise ParameterError(f"{missing}; 'control.margins' set to 'warn' uses these")
            self._node.get_logger().warning(missing)
        try:
            return make_law(parameters.control, parameters.stage).prepare()
        except NotLinear as error:
            raise ParameterError(str(error)) from error

    def deactivate(self) -> None:
        """Stop publishing commands, so that the driver switches off. Save what was learned."""
        self._publish_command.finish()
        self._publish_state.finish()
        if self._learning is not None:
            self._worker.wait()
            try:
                self._learning.save()
            except OSError as error:
                # It has stopped all the same; a failed transition would release what was learned.
                again = "it stays in memory, and is written again at the next deactivate, at cleanup or at the end"
                self._node.get_logger().error(f"{error}: {again}")

    def _wait(self, timeout_ns: int) -> None:
        """Wait for a sample. Before, while no sample waits for its command, fetch references for later samples."""
        self._fetch_references()
        self._samples.wait(timeout_ns)

    def _wait_in_lockstep(self, timeout_ns: int) -> None:
        """Wait for a sample, or for the reference without which the last one has no command."""
        (self._references if self._pairing.waits else self._samples).wait(timeout_ns)
        self._fetch_references()

    def _cycle(self) -> tuple[int, int]:
        self._fetch_references()
        arrived = self._read()
        answers = self._update()
        self._write(answers)
        return arrived

    def _read(self) -> tuple[int, int]:
        """Take the samples that arrived; return in how many separate sends they came and the newest one's age in ns."""
        samples, fetched_ns = self._samples.fetch(), time.time_ns()
        if not samples:
            return 0, 0
        self._samples_seen += len(samples)
        for stamp_ns, numbers, _ in samples:
            self._gaps.see(stamp_ns)
            self._pairing.add_sample(stamp_ns, numbers)
        return sendings(self._samples.sent_ns, self._apart_ns), max(0, fetched_ns - samples[-1][2])

    def _fetch_references(self) -> None:
        if self._pairing.short(self._spare_ns):
            for stamp_ns, numbers, _ in self._references.fetch():
                self._pairing.add_reference(stamp_ns, numbers)

    def _update(self) -> list[Answer]:
        """Step the law through the samples that have their references."""
        answers = []
        for stamp_ns, sample, reference, age_ns in self._pairing.take():
            command = self._servo.step(stamp_ns, sample[1], sample[3], reference, sample[0])
            if command is None:
                self._refused += 1
            else:
                answers.append((stamp_ns, command, age_ns * 1e-9))
                if finding := self._error_watch.check(command.error, amplifier_on=self._servo.running):
                    self._trip(*finding)
        self._excitation.look()
        return answers

    def _write(self, answers: list[Answer]) -> None:
        """Publish the commands first, then the states, which are only watched and recorded."""
        for stamp_ns, command, _ in answers:
            self._publish_command(stamp_ns, command.current)
        for stamp_ns, command, age in answers:
            self._publish_command.publish_batch()
            self._publish_state(stamp_ns, *command[1:], age)
        self._commands += len(answers)

    def _look_for_silence(self) -> None:
        # Count calls, not seconds: a process that was suspended must not mistake its own pause for missing samples.
        silent = self._samples_seen == self._seen and self._seen > 0 and self._node.active
        self._seen = self._samples_seen
        self._silent = self._silent + 1 if silent else 0
        if self._silent == self._silence_looks:
            # The servo ends it with the next sample, which a new driver may not send before it is activated.
            self._excitation.stop("samples were missing")
            self._trip(
                Fault.SAMPLE_TIMEOUT, f"the controller has had no sample for {self._parameters.sample_timeout:g} s"
            )

    def _counters(self) -> dict[str, object]:
        return {
            SAMPLES: self._samples_seen,
            LOST: self._gaps.lost,
            "commands": self._commands,
            "refused_samples": self._refused,
            "unmatched_samples": self._pairing.unmatched,
            EXCITATION: self._excitation.state,
            **(self._learning.counters() if self._learning is not None else {}),
        }

    def close(self) -> None:
        """Wait for the running learning job, then save what was learned."""
        self._worker.close()
        if self._learning is not None:
            self._learning.save()


class ExcitationService:
    """The service ``~/excite``: starts the excitation that the parameters ``excitation.*`` describe, and stops it.

    ``make`` makes the injection; ValueError if the parameters do not fit. ``left_travel`` is called with the reason
    when the platform left the allowed travel; for ``state`` see `node_timing.EXCITATION`.
    """

    def __init__(
        self, node: ManagedNode, servo: Servo, make: Callable[[], Injection], left_travel: Callable[[str], None]
    ) -> None:
        self._node, self._servo, self._make, self._left_travel = node, servo, make, left_travel
        self._injection: Injection | None = None
        self.state = ""
        node.offer(SetBool, "~/excite", self._on_excite, ValueError)

    def look(self) -> None:
        """Follow the excitation; call it after each cycle."""
        injection = self._injection
        if injection is None or not (injection.stopped or injection.finished):
            return
        self._injection = None
        self.state = injection.stopped or FINISHED
        if injection.stopped:
            self._node.get_logger().warning(f"the excitation ended early: {injection.stopped}")
            if self._servo.running:
                self._left_travel(injection.stopped)

    def stop(self, reason: str) -> None:
        """End the excitation early, if there is one."""
        if self._injection is not None:
            self._injection.stop(reason)

    def _on_excite(self, on: bool) -> str:
        """Inject what the parameters `excitation.*` describe into the commands (refused while the amplifier is off), or
        end that early."""
        if not on:
            self.stop("it was stopped by request")
            return "stops"
        if not self._servo.running:
            raise Refused("the amplifier is off; switch it on first")
        if self._injection is not None:
            raise Refused("an excitation is running; stop it first")
        injection = self._make()
        self._servo.inject(injection)
        self._injection, self.state = injection, EXCITING
        return "excites"


CONTROLLER = "controller", ControllerNodeParameters, ControllerComponent
main = partial(run_managed, [CONTROLLER])
"""Entry point of `ros2 run straightcomp_ros controller_node`."""

"""driver: publishes the machine's samples, writes the commands to it, switches its amplifier."""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.contract import (
    COMMAND,
    DRIVER_STATE,
    ENCODER,
    POSITION,
    POSITION_EVERY,
    STAGE_STATE,
    STAGE_TRAJECTORY,
    TRUTH,
)
from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.interface import SILENT_SAMPLES, Hardware, HardwareError, Sample, State, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware, switched_on_at
from straightcomp_ros.model.motion import StageLimits, Trajectory
from straightcomp_ros.model.paced_motion import Pace, StageState
from straightcomp_ros.model.trajectory_goal import Tolerances, TrajectoryGoal
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters
from straightcomp_ros.runtime.commands import CommandIntake, Lockstep
from straightcomp_ros.runtime.guarded_node import TICK_S, ThrottledWarning
from straightcomp_ros.runtime.loops import Loop, MessageLoop, PeriodicLoop, from_monotonic, now_ns
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.runner import run_managed
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyPanel
from straightcomp_ros.runtime.stage_state import stage_status
from straightcomp_ros.runtime.streams import LOOK_AHEAD_S
from straightcomp_ros.runtime.trajectory_action import TrajectoryAction, read_by_stamp
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.state_machine import SafetyMachine
from straightcomp_ros.safety.watch import ClockWatch, SampleWatch, StageWatch, ZeroWatch
from straightcomp_ros.timing.node_timing import AMPLIFIER, LOST, SAMPLES, UNREFERENCED

_ANSWER_LOOK_NS = 100_000
"""Polling interval while the command for the newest sample is outstanding."""
_ANSWER_SAMPLES = 4
"""The driver stops polling after so many samples without a command: no controller is running."""
_SLOW_WATCH_S = 0.05
_ANOTHER_PUBLISHES = "another node publishes commands"
_MOVES = "the stage is moving; hold it, end its motion or wait for its end; or set the parameter 'blend'"
_FORGOTTEN_S = 20
"""Lease of Fast DDS's participants, that of Cyclone DDS is shorter: so long a killed node stays known."""


class DriverComponent:
    """Polls the hardware at its sampling rate, or runs it in lockstep with the controller. ``hardware`` is by default
    what the parameters name; ``system_ns`` is the system clock, ns since the epoch."""

    def __init__(
        self,
        node: ManagedNode,
        parameters: DriverNodeParameters,
        hardware: Hardware | None = None,
        system_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._node, self._system_ns = node, system_ns
        self._command_timeout_ns = round(parameters.machine.command_timeout * 1e9)
        self._hardware = hardware or make_hardware(parameters)
        for remark in self._hardware.remarks():
            node.get_logger().warning(remark)
        self._period_ns = period_ns = parameters.stage.period_ns
        rate = parameters.stage.rate
        streams = node.streams
        self._publish_sample = streams.publisher(
            ENCODER, None if parameters.lockstep else rate, LOOK_AHEAD_S, at_once=True
        )
        self._publish_position = streams.publisher(POSITION, None, at_once=True)
        self._publish_truth = streams.publisher(TRUTH, rate)
        self._publish_state = streams.publisher(DRIVER_STATE, rate)
        self._samples = 0
        self._started = False
        self._safety, self._unreferenced = SafetyMachine(self._hardware), self._hardware.unreferenced
        limit = parameters.stage.actuator.current_limit
        self._commands = CommandIntake(self._hardware, self._command_timeout_ns, period_ns, limit, self._trip)
        self._fresh_ns = max(self._command_timeout_ns, SILENT_SAMPLES * period_ns)
        self._sample_watch = SampleWatch(parameters.watch, parameters.stage)
        self._zero_watch = ZeroWatch(parameters.stage)
        self._panel = SafetyPanel(
            node, self._safety, self._enable_refusal, self._begin_anew, lambda: not self._unreferenced
        )
        self._stage_watch = StageWatch(parameters.watch)
        self._clock_watch = ClockWatch(parameters.watch, now_ns, system_ns)
        self._newest: Sample | None = None
        self._lockstep: Lockstep | None = None
        self._stage_limits = stage_limits(parameters)
        self._refused = ThrottledWarning(node, "a motion of the stage is refused")
        self._unreachable, self._link_problem = ThrottledWarning(node, "the machine cannot be reached"), ""
        node.create_subscription(JointTrajectory, STAGE_TRAJECTORY, self._on_stage_trajectory, 10, raw=True)
        node.offer(SetBool, "~/hold", self._on_hold, HardwareError)
        node.offer(Trigger, "~/end_motion", self._on_end_motion, HardwareError)
        node.offer(Trigger, "~/home", self._on_home, HardwareError, ValueError)
        self._action = TrajectoryAction(node, self._begin_goal, partial(self._ask_pace, end=True))
        self._blend = parameters.blend
        self._stage_state = node.create_publisher(DiagnosticStatus, STAGE_STATE, LATCHED)
        self._reported_stage: StageState | None = None
        node.create_timer(_SLOW_WATCH_S, self._watch_slowly)
        self._others_command = streams.look_for_others(COMMAND)
        node.create_timer(TICK_S, self._look_for_others)
        self._answer_within_ns = _ANSWER_SAMPLES * period_ns
        self._queue = streams.queue(COMMAND)
        self.loop: Loop
        if parameters.lockstep:
            self._lockstep = Lockstep(node, self._hardware, period_ns, parameters.stage.drive.delay, self._publish)
            self.loop = MessageLoop(period_ns, self._queue.wait, partial(self._answer, self._lockstep))
        elif self._hardware.newest_arrival_ns is None:
            self.loop = PeriodicLoop(period_ns, self._cycle, punctual=True)
        else:
            self.loop = MessageLoop(period_ns, self._wait, self._follow)
        machine = parameters.hardware
        if machine == "can":
            machine = f"can {parameters.can.interface} {parameters.can.channel} node {parameters.can.node}"
        Diagnostics(
            node,
            self._counters,
            self.loop.report,
            self._commands.counters,
            self._hardware.counters,
            hardware_id=machine,
            description=parameters.stage.identity,
        )
        if parameters.override != 1.0:
            self._hardware.pace(Pace(parameters.override))

    def activate(self) -> None:
        """Start sampling, with the amplifier off."""
        self._started = False
        self._clock_watch.restart()
        self._sample_watch.restart()
        self._commands.restart()
        self._queue.fetch()

    def deactivate(self) -> None:
        """Switch the amplifier off and stop sampling. A fault stays latched."""
        on = self._safety.condition is State.ON
        self._safety.disable()
        if on:
            self._node.get_logger().warning("deactivated with the amplifier on: it has been switched off")
        self._panel.report()
        self._action.abandon("the driver is not active any more")
        self._publish_sample.finish()
        self._publish_truth.finish()
        self._publish_state.finish()

    def prepare(self, parameters: DriverNodeParameters) -> Callable[[], None]:
        """Prepare another limit of the control current, of the travel, or of the stage's motions."""
        if parameters.override != self._hardware.motion.pace.override:
            self._ask_pace(override=parameters.override)

        def take_over() -> None:
            self._sample_watch.travel, self._blend = parameters.watch.travel, parameters.blend
            self._commands.current_limit = parameters.stage.actuator.current_limit

        return take_over

    def _wait(self, timeout_ns: int) -> None:
        """Wait for a message of the machine, but only briefly while the command for its last sample is outstanding."""
        newest_ns = self._newest.stamp_ns if self._newest else 0
        if 0 < newest_ns - self._commands.stamp_ns < self._answer_within_ns:
            timeout_ns = _ANSWER_LOOK_NS
        self._hardware.wait(timeout_ns)

    def _follow(self) -> tuple[int, int]:
        """Run a cycle started by the machine's samples; return their number and how long the newest waited, in ns."""
        begin_ns = now_ns()
        samples = self._cycle(time.monotonic_ns())
        return samples, begin_ns - (self._hardware.newest_arrival_ns or begin_ns)

    def _cycle(self, wake_ns: int) -> int:
        if not self._started:
            # The machine samples at this loop's wake-up times, so that a sample is never a period old when it is read.
            self._hardware.start(from_monotonic(wake_ns))
            self._started = True
        now, system_now = now_ns(), self._system_ns()
        if finding := self._clock_watch.check(now, system_now):
            self._trip(*finding)
        # A simulated machine is integrated up to ``now``, with each command acting from its arrival.
        self._fetch_commands(now, system_now)
        samples = self._hardware.read(now)
        if self._unreferenced or self._hardware.unreferenced:
            self._look_at_reference([sample for sample, _ in samples])
        latenesses = [self._hand_out(sample) for sample, _ in samples]
        # The controller's answer comes before the records, and a board must not wait for it until the next cycle.
        if samples and self._node.streams.let_readers_run():
            self._fetch_commands(now_ns(), self._system_ns())
        self._publish_sample.publish_batch()
        for (sample, truth), lateness in zip(samples, latenesses, strict=True):
            self._record(sample, truth, lateness)
        self._node.streams.publish_records()
        if self._hardware.fault:
            self._safety.follow(now_ns())
            self._sample_watch.switched(on=False)
            self._panel.report()
        return len(samples)

    def _look_at_reference(self, samples: list[Sample]) -> None:
        unreferenced = self._hardware.unreferenced
        if not samples:
            return  # what another reference makes of x is seen in the next one; a board that restarts says so itself
        if unreferenced and self._safety.condition is State.ON:
            self._trip(Fault.NOT_REFERENCED, f"x is not referenced: {unreferenced}")
        if not self._unreferenced and self._newest is not None:
            self._zero_watch.look([self._newest], referenced=True)
        self._zero_watch.look(samples, referenced=not unreferenced)
        if bool(unreferenced) != bool(self._unreferenced):
            # x has another zero from now on.
            self._sample_watch.restart()
        self._unreferenced = unreferenced

    def _on_home(self) -> str:
        """Reference x: a simulated stage goes to its index mark and to the start of its strokes; amplifier off."""
        if self._lockstep:
            raise HardwareError("in lockstep no time passes for homing")
        self._hardware.home(now_ns())
        return "x is being referenced"

    def _fetch_commands(self, now: int, system_now: int) -> None:
        if self._newest is not None and self._commands.stamp_ns == self._newest.stamp_ns:
            return  # the newest sample has its command
        for stamp_ns, numbers, received_ns in self._queue.fetch():
            self._commands.accept(stamp_ns, numbers[0], now - max(0, system_now - received_ns))

    def _publish(self, sample: Sample, truth: Truth | None) -> None:
        self._hand_out(sample)
        self._publish_sample.publish_batch()
        self._record(sample, truth, 0.0)

    def _hand_out(self, sample: Sample) -> float:
        """Publish the sample for the controller; return the time since it was taken, in s."""
        if finding := self._sample_watch.check(sample, self._hardware.applied_current):
            self._trip(*finding)
        self._commands.hand_out(sample.stamp_ns)
        self._publish_sample(*sample[:3], math.nan, sample.current)
        self._newest = sample
        return (now_ns() - sample.stamp_ns) * 1e-9

    def _record(self, sample: Sample, truth: Truth | None, lateness: float) -> None:
        """Publish what is only watched and recorded."""
        if self._samples % POSITION_EVERY == 0:
            self._publish_position(*sample[:3])
        if truth is not None:
            self._publish_truth(sample.stamp_ns, *truth)
        on = 1.0 if self._hardware.state is State.ON else 0.0
        latency = self._commands.take_latency()
        self._publish_state(sample.stamp_ns, latency, lateness, self._hardware.applied_current, on)
        self._samples += 1

    def _answer(self, lockstep: Lockstep) -> tuple[int, int]:
        """A cycle in lockstep, started by a command; returns as :meth:`_follow`."""
        commands = self._queue.fetch()
        for stamp_ns, (current,), _ in commands:
            if lockstep.awaits(stamp_ns) and self._commands.is_good(current):
                self._commands.count(lockstep.delay_ns)
                lockstep.answer(stamp_ns, current)
        return min(1, len(commands)), 0

    def _trip(self, fault: Fault, reason: str) -> None:
        self._safety.trip(fault, reason, now_ns())
        self._sample_watch.switched(on=False)
        self._panel.report()

    def _watch_slowly(self) -> None:
        """Check what need not be checked in each cycle."""
        self._clock_watch.follow()
        problem = self._hardware.link_problem if self._node.active else ""
        if problem and problem != self._link_problem:
            self._unreachable.log(problem)
        self._link_problem = problem
        if self._safety.condition is State.ON:
            self._sample_watch.hold()
        if self._lockstep and self._newest is not None:
            # Its samples end with the motion, and who follows the stage must see the end.
            self._publish_position(*self._newest[:3])
        if self._newest is not None and self._node.active:
            finding = self._stage_watch.check(self._newest.stamp_ns, self._newest.x, self._hardware.motion)
            if finding is not None:
                self._trip(*finding)
        self._report_stage()
        if self._action.goal and self._newest is not None:
            self._follow_goal(self._action.goal, self._newest)

    def _look_for_others(self) -> None:
        if self._others_command() and self._safety.condition is State.ON:
            self._trip(Fault.TWO_CONTROLLERS, _ANOTHER_PUBLISHES)

    def _report_stage(self) -> None:
        """Publish the state of the stage's motion if it has changed."""
        state = self._hardware.motion.state(self._period_ns if self._lockstep else 0)
        if state != self._reported_stage:
            self._reported_stage = state
            self._stage_state.publish(stage_status(state, self._node.get_fully_qualified_name()))

    def _ask_pace(self, **changes: Any) -> None:
        """Ask for another pace of the stage; HardwareError if it takes no commands."""
        self._hardware.pace(self._hardware.motion.pace._replace(**changes))
        self._report_stage()

    def _on_hold(self, on: bool) -> str:
        """Let the stage come to rest within its limits and stand, with the amplifier on; or let it go on."""
        return self._paced("the stage is held" if on else "the stage goes on", hold=on)

    def _on_end_motion(self) -> str:
        """Let the stage come to rest within its limits, and end its motion there."""
        return self._paced("the motion ends", end=True)

    def _paced(self, done: str, **changes: bool) -> str:
        before = self._hardware.motion.condition
        self._ask_pace(**changes)
        if self._hardware.motion.condition != before:
            self._node.get_logger().info(done)
        return done

    def _begin_anew(self) -> None:
        """The amplifier has been switched, or a fault is about to be cleared."""
        self._sample_watch.switched(self._safety.condition is State.ON)
        if self._safety.fault:
            self._commands.restart()

    def _enable_refusal(self) -> str:
        """Why the amplifier may not be switched on now, apart from faults; empty if it may."""
        if not self._node.active:
            return "the driver is not active"
        newest_ns = self._newest.stamp_ns if self._newest else 0
        if now_ns() - newest_ns > self._fresh_ns and not self._lockstep:
            # No command for it could be fresh, and what the machine says of its reference is old.
            return "; ".join(filter(None, ("no samples come from the machine", self._hardware.link_problem)))
        if unreferenced := self._hardware.unreferenced or self._zero_watch.finding:
            return f"x is not referenced: {unreferenced}"
        if self._lockstep:
            return ""
        if self._others_command():
            return f"{_ANOTHER_PUBLISHES}; end it; one that was killed is forgotten after {_FORGOTTEN_S} s"
        age_ns = now_ns() - self._commands.stamp_ns
        if age_ns > self._fresh_ns:
            return "no fresh command from the controller; is it running, and is its map loaded?"
        return ""

    def _on_stage_trajectory(self, message: bytes) -> None:
        if not self._node.active:
            return
        try:
            self._begin(read_by_stamp(message))
        except (ValueError, HardwareError) as error:
            self._refused.log(error)

    def _begin(self, trajectory: Trajectory) -> None:
        """Begin a motion of the stage now; ValueError or HardwareError if it is refused."""
        if refusal := self._hardware.stage_refusal:
            # Before the trajectory is joined, which may take longer than a board waits for a command.
            raise HardwareError(refusal)
        motion, start_ns = self._hardware.motion, now_ns()
        next_ns = self._newest.stamp_ns + self._period_ns if self._newest is not None else start_ns
        if self._lockstep:
            self._lockstep.check_free()
            # The time of its samples may be ahead of the clock, and does not go back.
            start_ns = max(start_ns, next_ns)
        elif self._started:
            # As a simulated machine does; looking farther ahead would move the stage before that sample.
            start_ns = min(start_ns, next_ns)
        motion.position(start_ns)
        if motion.moving and not self._blend:
            raise ValueError(_MOVES)
        self._stage_limits.check(motion.joined(trajectory, start_ns, self._hardware.zero))
        if self._lockstep:
            self._lockstep.start(trajectory, start_ns)
        else:
            self._hardware.move(trajectory, start_ns)
        self._report_stage()

    def _begin_goal(self, trajectory: Trajectory, tolerances: Tolerances) -> TrajectoryGoal:
        if not self._node.active:
            raise HardwareError("the driver is not active")
        self._begin(trajectory)
        return TrajectoryGoal(trajectory, tolerances, self._hardware.motion, self._safety.reason)

    def _follow_goal(self, goal: TrajectoryGoal, sample: Sample) -> None:
        """Report to the action's client, and whether its goal has ended."""
        motion = self._hardware.motion
        desired = motion.position(sample.stamp_ns) - self._hardware.zero
        over = not motion.lasts(self._period_ns if self._lockstep else 0)
        outcome = goal.look(now_ns(), sample.x, desired, motion, over, self._safety.reason)
        self._action.report(outcome, sample.x, desired)

    def _counters(self) -> dict[str, object]:
        counters: dict[str, object] = {
            SAMPLES: self._samples,
            LOST: self._hardware.lost_samples,
            "trips": self._safety.trips,
            AMPLIFIER: self._hardware.state.value,
            UNREFERENCED: self._hardware.unreferenced or self._zero_watch.finding,
        }
        if self._safety.fault is not None:
            counters["error"] = self._safety.reason
        return counters

    def close(self) -> None:
        """Switch the amplifier off and release the machine."""
        self._action.close()
        self._hardware.close()


def make_hardware(parameters: DriverNodeParameters) -> Hardware:
    """The machine that the parameters name; SurveyError if the simulated machine's guide cannot be used, ParameterError
    if python-can knows no such interface."""
    if parameters.hardware == "can":
        x = switched_on_at(parameters.stage, parameters.guide()) if parameters.can.simulated_stage else 0.0
        return CanHardware(parameters.can, parameters.stage, now_ns, x=x)
    # In lockstep there is no sample before the motion, by which a client would see that the stage stands elsewhere.
    x = parameters.stage.motion.start if parameters.lockstep else None
    return SimulatedHardware(parameters.simulated, parameters.stage, parameters.guide(), x)


def stage_limits(parameters: DriverNodeParameters) -> StageLimits:
    """What a trajectory of the simulated stage may ask for; a real one has a controller of its own."""
    motion, guide = parameters.stage.motion, parameters.stage.guide
    if parameters.hardware == "can" and not parameters.can.simulated_stage:
        return StageLimits.of(motion, motion.start, motion.start)
    first, last = parameters.guide().span
    return StageLimits.of(motion, first - guide.runout, last + guide.runout)


DRIVER = "driver", DriverNodeParameters, DriverComponent
main = partial(run_managed, [DRIVER])
"""Entry point of `ros2 run straightcomp_ros driver_node`."""

"""driver: publishes the machine's samples, hands it the commands, switches its amplifier."""

from __future__ import annotations

import math
import sys
import time

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.configuration import DriverNodeParameters
from straightcomp_ros.contract import (
    COMMAND,
    DRIVER_STATE,
    ENCODER,
    POSITION,
    POSITION_EVERY,
    STAGE_TRAJECTORY,
    TRUTH,
)
from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.interface import Hardware, HardwareError, Sample, State, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.nodes.clock import from_monotonic, now_ns
from straightcomp_ros.nodes.declare import declare
from straightcomp_ros.nodes.diagnostics import Diagnostics
from straightcomp_ros.nodes.lockstep import Lockstep
from straightcomp_ros.nodes.periodic import PeriodicLoop
from straightcomp_ros.nodes.phase_lock import PhaseLock
from straightcomp_ros.nodes.runner import run
from straightcomp_ros.nodes.stage_trajectory import trajectory_from_message
from straightcomp_ros.nodes.streams import BurstPublisher, Inbox, publisher, subscribe, unspun_node
from straightcomp_ros.straightness.map import load_map
from straightcomp_ros.timing.histogram import Histogram
from straightcomp_ros.timing.report import AMPLIFIER, LATENCY, LOST, OVERRUNS, SAMPLES, written

_SAMPLE_WAIT_NS = 100_000
"""How long a sample that came by itself is to wait for the loop: the receiving thread needs some of it."""


class DriverNode:
    """Polls the hardware at its sampling rate, or runs it in lockstep with the controller."""

    def __init__(self, node: Node) -> None:
        parameters = declare(node, DriverNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        self._current_limit = parameters.current_limit
        self._command_timeout_ns = round(parameters.machine.command_timeout * 1e9)
        self._hardware = _make_hardware(parameters)
        period_ns = round(1e9 / parameters.machine.rate)
        self._phase = PhaseLock(period_ns, _SAMPLE_WAIT_NS)
        self._publish_sample = publisher(node, ENCODER)
        self._publish_position = publisher(node, POSITION)
        self._publish_truth = BurstPublisher(node, TRUTH)
        self._publish_state = BurstPublisher(node, DRIVER_STATE)
        self._samples = self._commands = self._stale_commands = 0
        self._command_stamp_ns = 0
        self._latency = math.nan
        self._latencies = Histogram()
        self._started = False
        self._fault = ""
        self._reported_fault = ""
        self._lockstep: Lockstep | None = None
        node.create_service(SetBool, "~/enable", self._on_enable)
        node.create_service(Trigger, "~/reset_fault", self._on_reset_fault)
        node.create_subscription(JointTrajectory, STAGE_TRAJECTORY, self._on_stage_trajectory, 10)
        self.loop: PeriodicLoop | None = None
        if parameters.lockstep:
            subscribe(node, COMMAND, self._on_lockstep_command)
            self._lockstep = Lockstep(node, self._hardware, period_ns, parameters.lockstep_delay, self._publish)
        else:
            self._inbox = Inbox(node, unspun_node(node), COMMAND)
            self.loop = PeriodicLoop(period_ns, self._cycle)
        Diagnostics(node, self._counters)

    def _cycle(self, wake_ns: int) -> None:
        if not self._started:
            # The machine samples when this loop is to wake: a sample is then never a period old when fetched.
            self._hardware.start(from_monotonic(wake_ns))
            self._started = True
        now, system_now = now_ns(), time.time_ns()
        for stamp_ns, numbers, received_ns in self._inbox.fetch():
            # The machine has not been integrated past its last sample yet: the command acts from when it came in.
            self._accept(stamp_ns, numbers[0], now - max(0, system_now - received_ns))
        samples = self._hardware.read(now)
        for sample, truth in samples:
            self._publish(sample, truth)
        self._report_fault()
        arrival_ns = self._hardware.newest_arrival_ns
        if samples and arrival_ns is not None and self.loop:
            self.loop.shift(self._phase.shift_ns(now - arrival_ns))

    def _publish(self, sample: Sample, truth: Truth | None) -> None:
        lateness = 0.0 if self._lockstep else (now_ns() - sample.stamp_ns) * 1e-9
        self._publish_sample(*sample[:3], math.nan, sample.current)
        if self._samples % POSITION_EVERY == 0:
            self._publish_position(*sample[:3])
        if truth is not None:
            self._publish_truth(sample.stamp_ns, *truth)
        on = 1.0 if self._hardware.state is State.ON else 0.0
        self._publish_state(sample.stamp_ns, self._latency, lateness, self._hardware.applied_current, on)
        self._latency = math.nan
        self._samples += 1

    def _on_lockstep_command(self, stamp_ns: int, numbers: list[float]) -> None:
        if self._lockstep and self._lockstep.awaits(stamp_ns) and self._check(numbers[0]):
            self._commands += 1
            self._latency = self._lockstep.delay_ns * 1e-9
            self._lockstep.answer(numbers[0])

    def _accept(self, stamp_ns: int, current: float, arrival_ns: int) -> None:
        age_ns = arrival_ns - stamp_ns
        if stamp_ns <= self._command_stamp_ns or age_ns > self._command_timeout_ns:
            self._stale_commands += 1
        elif self._check(current):
            self._hardware.write(current, arrival_ns, stamp_ns)
            self._command_stamp_ns = stamp_ns
            self._latency = age_ns * 1e-9
            self._latencies.record(age_ns)
            self._commands += 1

    def _check(self, current: float) -> bool:
        if math.isfinite(current) and abs(current) <= self._current_limit:
            return True
        self._hardware.disable()
        self._fault = f"command of {current} A is outside ±{self._current_limit:g} A; amplifier switched off"
        self._report_fault()
        return False

    @property
    def _present_fault(self) -> str:
        return self._fault or self._hardware.fault

    def _report_fault(self) -> None:
        fault = self._present_fault
        if fault != self._reported_fault:
            self._reported_fault = fault
            if fault:
                self.node.get_logger().error(f"fault, amplifier off: {fault}")

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Switch the amplifier on (refused while a fault is latched or no fresh command comes in), or off."""
        if not request.data:
            self._hardware.disable()
            response.success, response.message = True, "amplifier off"
            return response
        refusal = self._enable_refusal()
        if not refusal:
            try:
                self._hardware.enable()
            except HardwareError as error:
                refusal = str(error)
        response.success, response.message = not refusal, refusal or "amplifier on"
        self.node.get_logger().info(f"enable: {response.message}")
        return response

    def _enable_refusal(self) -> str:
        if self._present_fault:
            return f"a fault is latched: {self._present_fault}; call reset_fault"
        if self._lockstep:
            return ""
        age_ns = now_ns() - self._command_stamp_ns
        if age_ns > self._command_timeout_ns:
            return "no fresh command from the controller; is it running, and is its map loaded?"
        return ""

    def _on_reset_fault(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Clear the latched fault; the amplifier stays off."""
        response.message = f"cleared: {self._present_fault}" if self._present_fault else "there was no fault"
        self._hardware.reset_fault()
        self._fault = self._reported_fault = ""
        response.success = True
        return response

    def _on_stage_trajectory(self, message: JointTrajectory) -> None:
        try:
            trajectory = trajectory_from_message(message)
            if self._lockstep:
                self._lockstep.start(trajectory, now_ns())
            else:
                self._hardware.move(trajectory, now_ns())
        except (ValueError, HardwareError) as error:
            self.node.get_logger().error(f"stage trajectory refused: {error}")

    def _counters(self) -> dict[str, object]:
        counters: dict[str, object] = {
            SAMPLES: self._samples,
            LOST: self._hardware.lost_samples,
            "commands": self._commands,
            "stale_commands": self._stale_commands,
            AMPLIFIER: self._hardware.state.value,
            **(self.loop.report() if self.loop else {OVERRUNS: 0}),
            **written(LATENCY, self._latencies.take()),
            **self._hardware.counters(),
        }
        if self._present_fault:
            counters["error"] = self._present_fault
        return counters

    def close(self) -> None:
        """Amplifier off."""
        self._hardware.close()
        self._publish_truth.flush()
        self._publish_state.flush()


def _make_hardware(parameters: DriverNodeParameters) -> Hardware:
    if parameters.hardware == "can":
        return CanHardware(parameters.can, now_ns)
    return SimulatedHardware(parameters.simulated, load_map(parameters.guide))


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros driver_node`."""
    return run("driver", DriverNode)


if __name__ == "__main__":
    sys.exit(main())

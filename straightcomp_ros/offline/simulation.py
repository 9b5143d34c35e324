"""The graph without ROS: driver, feedforward and controller in one loop, in simulated time.

It calls what the nodes call, in the order of `lockstep`, so that both give the same numbers to the last bit.
"""

from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.learning import Learning
from straightcomp_ros.control.pairing import Pairing
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.straightness.feedforward import Feedforward
from straightcomp_ros.straightness.guide_map import load_map

_PROGRESS_EVERY = 2000
_COLUMNS = ("x", "y", "r", "current", "true_x", "true_y", "guide")


class Simulation:
    """Cycles of the stage, one after the other, under the parameters of the nodes, once the machine has been homed.

    Args:
        law: replaces the law that the parameters name.
        motion: of the stage, and its start in ns; the cell's cycle from 0 if None.
        wiring: puts something between the machine and its driver.

    Raises:
        ParameterError: a parameter is refused, or controller and machine disagree about the rate.
        SurveyError: the map or the guide is refused.

    Attributes:
        map: the feedforward's map.
        delay: command delay from the sample, in sampling periods.
    """

    def __init__(
        self,
        values: Values,
        law: Law | None = None,
        motion: tuple[Trajectory, int] | None = None,
        wiring: Callable[[SimulatedHardware], Hardware] | None = None,
    ) -> None:
        parameters = node_set(values)
        parameters.check_rates()
        driver, feedforward, controller, _ = parameters
        stage, control = controller.stage, controller.control
        self.map = load_map(feedforward.stage.guide)
        self.delay = driver.stage.drive.delay
        self.law = control.law
        self._trajectory, self._start_ns = motion or (parameters.trajectory, 0)
        first = self._trajectory.waypoints[0].position
        homed = replace(driver.simulated, referenced=True)
        hardware = SimulatedHardware(homed, driver.stage, driver.guide(), first)
        self._period_ns = hardware.period_ns
        self._hardware: Hardware = wiring(hardware) if wiring else hardware
        followed = feedforward.stage
        tracking = followed.tracking(feedforward.feedforward, self.map)
        limits = followed.motion.highest_speed, followed.encoder.x_noise
        self._feedforward = Feedforward(self.map, tracking, *limits)
        self._pairing = Pairing(controller.lead_ns, wait=True)
        learning = controller.learning
        self._learning = Learning(learning, control.law, stage.rate) if learning.learn else None
        self._servo = Servo(law or make_law(control, stage), learning=self._learning)
        self._begin_ns = 0

    def run(
        self,
        progress: Callable[[float], None] = lambda fraction: None,
        observe: Callable[[Sample, Truth, Sequence[float], Command, float], None] | None = None,
        paces: Mapping[int, Pace] = MappingProxyType({}),
    ) -> StrokeRecord:
        """Run the cycle once, from where the last one ended.

        Args:
            progress: called now and then with the fraction that is done.
            observe: called with each sample, its truth, its reference, the answer, and the age in s of the reference
                that the answer was computed from.
            paces: asked of the motion after the samples of these numbers; the run then ends with the motion, or where
                it is held for good.
        """
        hardware, pairing = self._hardware, self._pairing
        step, reference_at = self._servo.step, self._feedforward.step
        period_ns = self._period_ns
        delay_ns = round(self.delay * period_ns)
        count = -(-(self._trajectory.end_ns + self._start_ns) // period_ns)
        rows = array("d")
        begin_ns = self._begin_ns
        if begin_ns == 0:
            hardware.enable()
            hardware.start(0)
        hardware.move(self._trajectory, begin_ns + self._start_ns)
        index = -1
        # Held after its last pace, a motion lasts for ever.
        last = max(paces, default=-1)
        while (index := index + 1) < count or (
            paces and hardware.motion.lasts(period_ns) and (index <= last or hardware.motion.condition != "held")
        ):
            sample, truth = hardware.read(begin_ns + index * period_ns)[-1]
            reference = reference_at(sample.stamp_ns, sample.x)
            pairing.add_reference(sample.stamp_ns, reference)
            pairing.add_sample(sample.stamp_ns, (sample.x, sample.y, sample.current))
            ((stamp_ns, (x, y, coil_current), given, age_ns),) = pairing.take()
            command = step(stamp_ns, y, coil_current, given, x)
            assert command is not None  # a simulated sample is finite and newer than the last
            hardware.write(command.current, sample.stamp_ns + delay_ns)
            rows.extend((sample.x, sample.y, reference[0], command.current, truth.x, truth.y, truth.guide_deviation))
            if observe is not None:
                observe(sample, truth, reference, command, age_ns * 1e-9)
            if index in paces:
                hardware.pace(paces[index])
            if self._learning is not None:
                self._learning.cut = hardware.motion.cut
            if index % _PROGRESS_EVERY == 0:
                progress(min(index / count, 1.0))
        progress(1.0)
        count = index
        self._begin_ns += count * period_ns
        columns = dict(zip(_COLUMNS, np.frombuffer(rows).reshape(-1, len(_COLUMNS)).T.copy(), strict=True))
        return StrokeRecord(time=np.arange(count) * (period_ns * 1e-9), law=self.law, **columns)

    def inject(self, injection: Injection) -> None:
        """Add a test signal to the commands from the next sample on."""
        self._servo.inject(injection)

    def save_learning(self) -> None:
        """Write the learned correction to the file that the parameters name, if they do; OSError if that fails."""
        if self._learning is not None:
            self._learning.save()

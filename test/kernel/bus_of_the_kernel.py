"""What the tests in the guest are made of: network interfaces, boards as processes, and the driver's side in a loop."""

import contextlib
import gc
import multiprocessing
import subprocess
import time

import numpy as np

from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.nodes.dsp_emulator import emulate
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.straightness.feedforward import Feedforward, FeedforwardParameters
from straightcomp_ros.straightness.guide_map import load_map
from straightcomp_ros.tuning.design.gains import closed_form

RATE = 100
"""Hz: what the guest's processor carries on a busy computer. No law holds the shipped platform then, friction does."""


def in_slow_motion(times):
    """The shipped stage, in which all takes ``times`` as long under the same forces: commands that come late by a part
    of a second cost it what the shipped one is cost by that part over ``times``. The strokes are slower still."""
    powers = {
        "rate": -1,
        "platform.mass": 2,
        "friction.stribeck_velocity": -1,
        "friction.bristle_damping": 1,
        "friction.viscous": 1,
        "drive.bandwidth": -1,
    }
    stage = shipped_parameters()["stage"]
    slow = {name: type(stage[name])(stage[name] * times**power) for name, power in powers.items()}
    return {**slow, "motion.speed": 0.03, "motion.acceleration": 0.03}


LAW_STAGE = in_slow_motion(20)
"""For strokes under the control law, whose commands must come in time."""
PATIENCE_S = 60.0
HOST, BOARD = "vxcan0", "vxcan1"
"""The two ends of a cable, of which each can be spoiled by itself."""


def link(*words):
    subprocess.run(["ip", "link", *map(str, words)], check=True, timeout=PATIENCE_S)


def lay_cable():
    """A CAN bus of two interfaces; every one of them may vanish and come again."""
    link("add", "dev", HOST, "type", "vxcan", "peer", "name", BOARD)
    for end in (HOST, BOARD):
        link("set", end, "mtu", 72, "up")


def remove_cable():
    # Both ends go together.
    link("del", HOST)


def parameters(fd, channel, file=None, **changed):
    """Of the driver node: patient with a slow processor, on this channel; ``file`` has a board's own frames."""
    return node_parameters("driver", node_values(fd, channel, file, **changed))


def node_values(fd, channel, file=None, stage=None, **changed):
    """Parameters of all nodes by node and dotted name, see :func:`parameters`; ``stage`` changes the description."""
    values = shipped_parameters(stage=file)
    values["stage"].update(
        {"rate": RATE, "motion.stroke": 0.1, "motion.settle": 0.5, "motion.pause": 0.1, **(stage or {})}
    )
    values["driver"].update(
        {
            "hardware": "can",
            "can.interface": "socketcan",
            "can.channel": channel,
            "can.fd": fd,
            "can.simulated_stage": True,
            "can.command_timeout": 1.0,
            "can.sample_timeout": 1.0,
            "can.heartbeat_timeout": 2.0,
            "can.answer_timeout": 5.0,
            "simulated.command_timeout": 1.0,
            "simulated.sample_memory": 10.0,
            "realtime.priority": 0,
            "realtime.exclusive": False,
            **changed,
        }
    )
    return values


class EmulatedBoard:
    """`straightcomp dsp` on the board's end of the cable, forked from this process to be there at once."""

    def __init__(self, fd, program="", file=None, **changed):
        own = parameters(fd, BOARD, file, **{"can.firmware": str(program), **changed})
        self._process = multiprocessing.get_context("fork").Process(target=emulate, args=(own,))
        self._process.start()

    def kill(self):
        self._process.kill()
        self._process.join()

    def close(self):
        self._process.terminate()
        self._process.join(PATIENCE_S)


class Driver:
    """The driver's side: what the node does in its loop, without ROS, with commands of no current."""

    def __init__(self, fd, file=None, **changed):
        own = parameters(fd, HOST, file, **changed)
        self.stage = own.stage
        self.samples = []
        # As a node does before its loop: what was made by now takes a second to look through here, as long as a board
        # waits for a command.
        gc.collect()
        gc.freeze()
        self.hardware = CanHardware(own.can, own.stage, time.time_ns)
        self.hardware.start(time.time_ns())

    def until(self, condition, at_most_s=PATIENCE_S):
        """Run the loop until ``condition()``; returns how long that took in s."""
        begin_s = time.monotonic()
        while not condition():
            passed_s = time.monotonic() - begin_s
            assert passed_s < at_most_s, (self.hardware.fault, self.hardware.state, dict(self.hardware.counters()))
            self._cycle()
        return time.monotonic() - begin_s

    def run(self, seconds):
        end_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() >= end_s)

    def read_on(self, samples):
        """Until so many more samples have been read."""
        enough = len(self.samples) + samples
        self.until(lambda: len(self.samples) >= enough)

    def stroke(self):
        """Move the stage forward and back; the samples meanwhile, and how many were lost."""
        begin, lost, motion = len(self.samples), self.hardware.lost_samples, self.stage.motion
        waypoints = forward_and_back(motion)
        self.hardware.move(Trajectory(waypoints), time.time_ns())
        self.run(waypoints[-1].time_ns * 1e-9)
        self.until(lambda: abs(self.samples[-1][0].x - motion.start) < 0.01 * motion.stroke)
        return self.samples[begin:], self.hardware.lost_samples - lost

    def in_parallel(self, *words):
        """Run a program to its end while the loop goes on."""
        program = subprocess.Popen([str(word) for word in words])
        self.until(lambda: program.poll() is not None)
        assert program.returncode == 0, words

    def _cycle(self):
        hardware = self.hardware
        hardware.wait(20_000_000)
        fresh = hardware.read(time.time_ns())
        self.samples += fresh
        for sample, _ in fresh:
            if hardware.state is not State.FAULT:
                hardware.write(self.current(sample), time.time_ns(), sample.stamp_ns)

    def current(self, sample):
        """The control current that answers a sample."""
        return 0.0

    def switch_on(self):
        def enabled():
            with contextlib.suppress(HardwareError):
                self.hardware.enable()
                return True
            return False

        self.until(enabled)
        self.until(lambda: self.hardware.state is State.ON)

    def switch_on_after_a_fault(self):
        """Without a new driver, and when samples come again: the board may have a fault of its own."""
        self.read_on(10)
        self.hardware.reset_fault()
        self.switch_on()

    def faulty(self):
        return self.hardware.state is State.FAULT

    def count(self, name):
        return self.hardware.counters()[f"can_{name}"]

    def close(self):
        self.hardware.close()


class ServoDriver(Driver):
    """The driver's side with feedforward and law in its loop: the law of the controller, with the gains that the closed
    form has for this stage.

    The machine's reference is that of the map at each sample's own x, since there is no feedforward node here.
    """

    def __init__(self, fd, file, stage):
        values = node_values(fd, HOST, file, stage)
        law = node_parameters("controller", values).control.law
        values["controller"].update(closed_form(make_scenario(values, [law]), law))
        controller = node_parameters("controller", values)
        own = controller.stage
        self._servo = Servo(make_law(controller.control, own).prepare())
        self.map = load_map(own.guide)
        limits = own.motion.highest_speed, own.encoder.x_noise
        self._feedforward = Feedforward(self.map, FeedforwardParameters(), *limits)
        # Last, for it begins to receive, and what was not read for a second is a fault.
        super().__init__(fd, file, stage=stage)

    def current(self, sample):
        reference = self._feedforward.step(sample.stamp_ns, sample.x)
        command = self._servo.step(sample.stamp_ns, sample.y, sample.current, reference)
        return command.current if command else 0.0

    def true_errors(self, samples):
        """r(x) − y of the machine itself, in m, for those of the samples that came with the truth."""
        found = [truth for _, truth in samples if truth is not None]
        return np.array([self.map.reference(truth.x)[0] - truth.y for truth in found])

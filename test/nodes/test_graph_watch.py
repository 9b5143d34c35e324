"""What the gateway and the view see of the graph, from a driver that is played by the test."""

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from straightcomp_ros.contract import DIAGNOSTICS, DRIVER_STATE, SAFETY_STATE
from straightcomp_ros.runtime.graph_watch import GraphWatch
from straightcomp_ros.runtime.safety_panel import LATCHED, LONGEST_REASON, safety_status
from straightcomp_ros.runtime.streams import publisher
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.state_machine import Condition, Latched

pytestmark = pytest.mark.live

STATES = {"driver": "active", "controller": "active"}


class Driver:
    """Sends samples that say the contrary of its safety state."""

    def __init__(self):
        self.node = Node("driver")
        self.condition = Condition.OFF
        self._state = publisher(self.node, DRIVER_STATE)
        self._safety = self.node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
        self._diagnostics = self.node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)

    def say(self, condition, fault=None):
        self.condition = condition
        self._safety.publish(safety_status(condition, fault, "driver"))

    def sample(self):
        self._state(time.time_ns(), 0.0, 0.0, 0.0, float(self.condition is not Condition.ON))

    def report(self, name, error, **values):
        level = DiagnosticStatus.ERROR if error else DiagnosticStatus.OK
        values = [KeyValue(key=key, value=value) for key, value in values.items()]
        status = DiagnosticStatus(level=level, name=name, message=error, values=values)
        self._diagnostics.publish(DiagnosticArray(status=[status]))


@pytest.fixture
def seen():
    """A driver, and a function that gives the observation as soon as it is as wanted."""
    rclpy.init()
    driver = Driver()
    # Latched: the watch comes later.
    driver.say(Condition.ON)
    node = Node("watch")
    watch = GraphWatch(node)

    def until(wanted, states=STATES):
        end = time.monotonic() + 60.0
        while True:
            driver.sample()
            rclpy.spin_once(node, timeout_sec=0.02)
            watch.fetch()
            observation = watch.observation(states)
            if wanted(observation):
                return observation
            assert time.monotonic() < end, f"it never came true: {observation}"

    yield driver, until
    node.destroy_node()
    driver.node.destroy_node()
    rclpy.shutdown()


def test_the_amplifier_is_what_the_safety_state_says_and_not_what_a_sample_says(seen):
    driver, until = seen
    until(lambda seen: seen.fresh and seen.amplifier_on)
    driver.say(Condition.OFF)
    until(lambda seen: seen.fresh and not seen.amplifier_on)


def test_without_samples_nobody_says_that_the_amplifier_is_on(seen):
    driver, until = seen
    until(lambda seen: seen.fresh and seen.amplifier_on)
    driver.sample = lambda: None
    assert not until(lambda seen: not seen.fresh).amplifier_on


def test_a_fault_of_the_driver_is_seen_from_its_safety_state_alone_and_others_from_their_diagnostics(seen):
    driver, until = seen
    driver.say(Condition.FAULT, Latched(Fault.TRIPPED, "somebody is in there", 1))
    observation = until(lambda seen: seen.faults)
    assert observation.faults == {"driver": "tripped: somebody is in there"} and not observation.amplifier_on
    assert observation.fault_code == Fault.TRIPPED.code
    driver.report("driver", "an older one")
    driver.report("controller", "no samples")
    until(lambda seen: seen.faults == {"driver": "tripped: somebody is in there", "controller": "no samples"})
    driver.report("controller", "")
    driver.say(Condition.OFF)
    assert until(lambda seen: not seen.faults).fault_code == 0


def test_diagnostics_of_another_namespace_are_no_fault_of_this_graph(seen):
    driver, until = seen
    driver.say(Condition.OFF)
    for name in ("line_4/controller", "line_4/camera: frames"):
        driver.report(name, "no samples")
    driver.report("logger", "disk full")
    assert until(lambda seen: seen.faults).faults == {"logger": "disk full"}


@pytest.mark.parametrize("value", ["n/a", "", "-1", "1e400", "9" * 5000, "²"])
def test_a_counter_of_a_status_that_is_no_number_counts_as_absent(seen, value):
    driver, until = seen
    driver.report("controller", "no samples", samples=value, lost_samples="7")
    observation = until(lambda seen: seen.faults)
    assert (observation.samples, observation.lost_samples) == (0, 7)


def test_statuses_of_other_programs_are_neither_faults_of_this_graph_nor_kept(seen):
    driver, until = seen
    driver.say(Condition.OFF)
    for number in range(5):
        driver.report(f"camera_{number}", "no picture")
    driver.report("logger", "disk full" * 1000)
    faults = until(lambda seen: seen.faults).faults
    assert set(faults) == {"logger"} and len(faults["logger"]) <= LONGEST_REASON


@pytest.mark.parametrize("state", ["absent", "silent"])
def test_a_driver_that_is_gone_has_no_fault_any_more(seen, state):
    driver, until = seen
    driver.say(Condition.FAULT, Latched(Fault.TRIPPED, "somebody is in there", 1))
    until(lambda seen: seen.faults)
    gone = until(lambda seen: True, {**STATES, "driver": state})
    assert not gone.faults and gone.fault_code == 0

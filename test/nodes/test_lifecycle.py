"""The nodes as managed nodes: their transitions over the standard services, and what each state does and does not."""

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import ChangeState, GetState
from participant import PATIENCE_S, Participant
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.contract import CONTROLLER_STATE, ENCODER, SAFETY_STATE, TRIP
from straightcomp_ros.runtime.safety_panel import LATCHED
from straightcomp_ros.runtime.streams import subscribe

_SWITCHING = CONTROLLER_STATE.layout.columns.index("switching_current")
_SWITCHING = CONTROLLER_STATE.layout.columns.index("switching_current")
FORGIVING = {
    "driver": {"simulated.command_timeout": 1.0, "simulated.sample_memory": 1.0},
    "controller": {"sample_timeout": 30.0},
}


class Manager(Participant):
    """Stands for a lifecycle manager and a cell controller."""

    def __init__(self):
        super().__init__("manager")
        self.safety = None
        self.node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety, LATCHED)
        self.trip = self.node.create_publisher(DiagnosticStatus, TRIP, 10)

    def _on_safety(self, message):
        self.safety = (message.name, {value.key: value.value for value in message.values}["condition"])

    def change(self, node, label):
        request = ChangeState.Request()
        request.transition.label = label
        return self.call(ChangeState, f"{node}/change_state", request).success

    def state(self, node):
        return self.call(GetState, f"{node}/get_state", GetState.Request()).current_state.label

    def set(self, node, **values):
        parameters = [
            Parameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        return self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", request).result

    def enable(self, on=True):
        return self.call(SetBool, "driver/enable", SetBool.Request(data=on))

    def trigger(self, name):
        return self.call(Trigger, name, Trigger.Request())

    def amplifier_on(self):
        rclpy.spin_once(self.node, timeout_sec=0.0)
        return self.safety == ("", "on")

    def switching(self):
        """Whether the law switches, by some of its answers: nobody here hears all 2000 a second for long."""
        found = self.heard(CONTROLLER_STATE)
        return any(numbers[_SWITCHING] for numbers in found)

    def heard(self, stream, count=20):
        found = []
        node = Node("listener")
        subscribe(node, stream, lambda _, numbers: found.append(numbers))
        end = time.monotonic() + PATIENCE_S
        while len(found) < count:
            assert time.monotonic() < end, f"nothing comes on {stream.topic}"
            rclpy.spin_once(node, timeout_sec=0.05)
        node.destroy_node()
        return found


@pytest.fixture
def manager():
    with Manager() as manager:
        yield manager


@pytest.fixture
def loop(graph, manager, forgiving):
    """Driver, feedforward and controller, amplifier on."""
    parameters = {"driver": forgiving, "controller": {"sample_timeout": 30.0}}
    for node in ("driver", "feedforward", "controller"):
        graph.start(node, parameters.get(node, {}))
    manager.until(lambda: manager.enable().success)
    manager.until(manager.amplifier_on)
    return manager


def test_a_driver_goes_through_all_states_and_back_and_wrong_transitions_are_refused(graph, manager):
    process = graph.start("driver", {"stage.rate": 200, "autostart": False})
    assert manager.state("driver") == "unconfigured"
    assert not manager.change("driver", "activate")
    assert manager.state("driver") == "unconfigured"
    # What cannot be configured stays as it is; the next attempt takes what was mended.
    assert manager.set("driver", simulated__truth__guide="nowhere.csv").successful
    assert not manager.change("driver", "configure")
    assert manager.state("driver") == "unconfigured"
    assert manager.set("driver", simulated__truth__guide="config/guide_synthetic.csv").successful
    for _ in range(2):
        assert manager.change("driver", "configure") and manager.state("driver") == "inactive"
        assert not manager.enable().success
        assert manager.change("driver", "activate") and manager.state("driver") == "active"
        manager.heard(ENCODER)
        assert manager.change("driver", "deactivate") and manager.state("driver") == "inactive"
        assert manager.change("driver", "cleanup") and manager.state("driver") == "unconfigured"
    assert manager.change("driver", "shutdown") and manager.state("driver") == "finalized"
    assert process.poll() is None
    assert graph.stop(["driver"])["driver"] == 0


def test_a_deactivated_driver_leaves_the_amplifier_off_and_its_fault_latched(loop):
    loop.trip.publish(DiagnosticStatus(name="whatever", message="somebody is in there"))
    loop.until(lambda: loop.safety == ("tripped", "fault"))
    assert loop.change("driver", "deactivate") and loop.change("driver", "activate")
    loop.heard(ENCODER)
    refusal = loop.enable()
    assert not refusal.success and "somebody is in there" in refusal.message
    assert loop.trigger("driver/reset_fault").success
    loop.until(lambda: loop.enable().success)
    loop.until(loop.amplifier_on)
    assert loop.change("driver", "deactivate")
    loop.until(lambda: loop.safety == ("", "off"))


def test_parameters_change_as_a_whole_or_not_at_all_while_the_loop_runs(loop):
    refused = loop.set("controller", control__law="linear", control__smc__rho=-1.0)
    assert not refused.successful and "control.smc.rho" in refused.reason
    refused = loop.set("controller", control__law="linear", stage__rate=100)
    assert not refused.successful and "'stage.rate' is fixed while the node is configured" in refused.reason
    refused = loop.set("controller", control__law="smc", control__smc__boundary_layer=5e-4)
    assert not refused.successful and "the law 'smc' is unstable" in refused.reason
    assert loop.switching()  # the law is 'smc' as before
    assert loop.set("controller", control__law="linear", stage__actuator__current_limit=0.5).successful
    loop.until(lambda: not loop.switching())
    refused = loop.set("feedforward", stage__guide__file="nowhere.csv")
    assert not refused.successful and "nowhere.csv" in refused.reason
    assert loop.trigger("feedforward/reload_map").success
    assert loop.set("driver", stage__actuator__current_limit=0.95).successful
    loop.heard(ENCODER)
    assert loop.amplifier_on()


def test_a_logger_that_is_managed_records_while_it_is_active_and_ends_its_bag_when_cleaned_up(graph, manager, tmp_path):
    bag = tmp_path / "bag"
    graph.start("logger", {"autostart": False, "output": str(bag), "nodes": "logger"})
    assert manager.change("logger", "configure") and manager.change("logger", "activate")
    assert manager.change("logger", "deactivate") and manager.change("logger", "cleanup")
    assert (bag / "metadata.yaml").exists() and "parameters.yaml" in read_attachments(bag)
    # The folder holds something now: the logger says so, and takes another.
    assert not manager.change("logger", "configure")
    assert manager.set("logger", output=str(tmp_path / "other")).successful
    assert manager.change("logger", "configure") and manager.state("logger") == "inactive"


def test_a_managed_node_that_fails_at_work_is_unconfigured_and_works_again_when_it_is_configured_anew(
    graph, manager, tmp_path
):
    process = graph.start("logger", {"autostart": False, "output": str(tmp_path / "bag"), "nodes": "logger"})
    assert manager.change("logger", "configure") and manager.change("logger", "activate")
    assert manager.set("logger", min_free_bytes=10**18).successful
    manager.until(lambda: manager.state("logger") == "unconfigured")
    assert (tmp_path / "bag" / "metadata.yaml").exists() and process.poll() is None
    assert manager.set("logger", min_free_bytes=0, output=str(tmp_path / "other")).successful
    assert manager.change("logger", "configure") and manager.change("logger", "activate")
    assert manager.state("logger") == "active"

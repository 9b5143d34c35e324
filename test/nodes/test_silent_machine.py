"""Why a driver does not switch on: its machine sends no samples, or no controller answers them."""

import math

import pytest
from participant import spun

from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.nodes.driver_node import DriverComponent
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters
from straightcomp_ros.runtime.loops import now_ns
from straightcomp_ros.runtime.managed import ManagedNode


@pytest.fixture
def driver(participant, tmp_path):
    """The component of an active driver, whose cycles the test plays, with a board on a hub that does not run."""
    given = {"hardware": "can", "can.interface": "straightcomp_hub", "can.channel": str(tmp_path / "bus")}
    parameters = from_mapping(DriverNodeParameters, {**given, "can.command_timeout": 1.0})
    node = ManagedNode("driver", DriverNodeParameters, DriverComponent)
    component = DriverComponent(node, parameters)
    node.active = True
    with spun(node):
        yield component
        component.close()
        node.streams.close()


def test_a_driver_without_samples_names_the_machine_and_its_link_and_with_samples_the_controller(participant, driver):
    def refusal():
        answer = participant.enable()
        assert not answer.success
        return answer.message

    no_samples = "no samples come from the machine; CAN straightcomp_hub"
    assert refusal().startswith(no_samples) and refusal().endswith("is not open yet")
    # Such a board has not said either whether x has a reference.
    driver._newest = Sample(now_ns(), 0.0, 0.0, math.nan)
    assert "no reference" not in refusal() and "is not open yet" in refusal()
    driver._hardware._receiver.referenced = False
    assert refusal() == "x is not referenced: the board reports no reference"
    driver._hardware._receiver.referenced = True
    driver._newest = Sample(now_ns(), 0.0, 0.0, math.nan)
    assert "no fresh command from the controller" in refusal()
    driver._newest = Sample(now_ns() - 1_100_000_000, 0.0, 0.0, math.nan)
    driver._hardware._link.problem = ""
    assert refusal() == "no samples come from the machine"


def test_a_driver_that_does_not_reach_its_machine_says_why_once(driver, monkeypatch):
    logged = []
    monkeypatch.setattr(driver._unreachable, "log", logged.append)
    for problem in ("no such device", "no such device", "", "", "bus-off"):
        driver._hardware._link.problem = problem
        driver._watch_slowly()
    assert logged == ["no such device", "bus-off"]

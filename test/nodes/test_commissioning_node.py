"""What the node `commissioning` reports of the verbs that it starts; other programs play the verbs."""

import sys

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from participant import spun
from rclpy.parameter import Parameter

from straightcomp_ros.contract import COMMISSIONING_STATE, SAFETY_STATE
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.runtime.guarded_node import GuardedNode
from straightcomp_ros.runtime.safety_panel import LATCHED, safety_status
from straightcomp_ros.tuning.graph import commissioning_node

ENDLESS = "import time; time.sleep(600)"


@pytest.fixture
def commissioning(participant, monkeypatch, tmp_path):
    """The node, in this process, and its reports, oldest first."""
    found = []
    participant.node.create_subscription(DiagnosticStatus, COMMISSIONING_STATE, found.append, LATCHED)
    play(monkeypatch, ENDLESS)
    node = GuardedNode(
        "commissioning",
        automatically_declare_parameters_from_overrides=True,
        parameter_overrides=[Parameter("output", value=str(tmp_path / "found"))],
    )
    component = commissioning_node.CommissioningNode(node)
    with spun(node):
        participant.until(lambda: found)
        yield component, found
        component.close()


def play(monkeypatch, program):
    """Have the ``program`` run in place of each verb."""
    monkeypatch.setattr(commissioning_node, "verb_command", lambda *words: [sys.executable, "-c", program])


@pytest.mark.parametrize("condition", [State.ON, State.OFF, None])
def test_a_verb_that_is_stopped_before_it_has_the_machine_leaves_the_amplifier_as_the_driver_reports_it(
    participant, commissioning, condition
):
    node, reports = commissioning
    if condition:
        publisher = participant.node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
        publisher.publish(safety_status(condition, None, "driver"))
        participant.until(lambda: node._amplifier)
    assert participant.trigger("commissioning/connection").success
    assert participant.trigger("commissioning/stop").success
    participant.until(lambda: reports[-1].message not in ("ready", "is going on"))
    reported = f"; the driver last reported the amplifier {condition.value}" if condition else ""
    assert reports[-1].message == f"interrupted{reported}"


def test_a_verb_that_cannot_be_started_is_refused_and_the_next_one_begins(participant, commissioning, tmp_path):
    (tmp_path / "found").rename(tmp_path / "moved")
    answer = participant.trigger("commissioning/connection")
    assert not answer.success and answer.message.startswith("connection cannot begin: ")
    assert "commissioning.log" in answer.message
    (tmp_path / "moved").rename(tmp_path / "found")
    assert participant.trigger("commissioning/run").success


def test_the_reason_of_a_verb_is_reported_though_the_output_folder_was_removed(
    participant, commissioning, monkeypatch, tmp_path
):
    _, reports = commissioning
    play(
        monkeypatch,
        "import shutil, sys\n"
        f"shutil.rmtree({str(tmp_path / 'found')!r})\n"
        "sys.stderr.buffer.write(b'straightcomp commission: the cable is off \\xff')\n"
        "sys.exit(1)",
    )
    assert participant.trigger("commissioning/connection").success
    participant.until(lambda: reports[-1].message not in ("ready", "is going on"))
    assert reports[-1].message == "the cable is off \N{REPLACEMENT CHARACTER}"

"""The nodes as managed nodes: transitions by a lifecycle manager, what each state does, what each node reports."""

import platform
import re

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from parameters_of_tests import loop_parameters
from tiers import nightly

from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.contract import CONTROLLER_STATE, DIAGNOSTICS, ENCODER
from straightcomp_ros.parameters.parameter_file import as_parameter_file

pytestmark = [pytest.mark.live, pytest.mark.keeps_time]

_SWITCHING = CONTROLLER_STATE.layout.columns.index("switching_current")
COUNT = re.compile(r"\d+")
UNITS = ("_us", "_cores", "_hz")


@pytest.fixture(scope="module", params=[pytest.param("separate", marks=pytest.mark.nightly), "composed"])
def nodes(request, shared_graph, tmp_path_factory):
    """Driver, feedforward and controller at work, each in its process or all in one, and a logger that is managed."""
    folder = tmp_path_factory.mktemp("bags")
    if request.param == "separate":
        for node, parameters in loop_parameters().items():
            shared_graph.start(node, parameters)
    else:
        (folder / "parameters.yaml").write_text(as_parameter_file(loop_parameters()))
        shared_graph.start("servo", {}, folder / "parameters.yaml")
    shared_graph.start("logger", {"autostart": False, "output": str(folder / "bag"), "nodes": "logger"})
    yield folder
    shared_graph.stop()


@pytest.fixture
def loop(nodes, participant):
    """A manager of the loop, whose amplifier is on."""
    participant.trigger("driver/reset_fault")
    participant.switch_on()
    return participant


def switching(participant):
    return any(numbers[_SWITCHING] for numbers in participant.received(CONTROLLER_STATE))


def test_each_node_names_its_hardware_and_each_number_is_a_count_or_says_its_unit(loop):
    assert loop.change("logger", "configure") and loop.change("logger", "activate")
    statuses, nodes = {}, set(RECORDED)
    loop.node.create_subscription(
        DiagnosticArray, DIAGNOSTICS, lambda message: statuses.update({one.name: one for one in message.status}), 100
    )
    loop.until(lambda: nodes <= statuses.keys())
    assert loop.change("logger", "deactivate") and loop.change("logger", "cleanup")
    for node in nodes:
        status = statuses[node]
        assert status.hardware_id == ("simulated" if node == "driver" else platform.node())
        assert status.message
        values = {value.key: value.value for value in status.values}
        assert {"samples", "rate_hz", "overruns", "lost_samples"} <= values.keys()
        for name, value in values.items():
            if re.fullmatch(r"-?[\d.]+(e-?\d+)?|nan|inf", value) and not name.endswith(UNITS):
                assert COUNT.fullmatch(value), f"{node}: {name} = {value} is no count and names no unit"


def test_a_deactivated_driver_leaves_the_amplifier_off_and_its_fault_latched(loop, shared_graph):
    logs = [shared_graph.log(name) for name in ("driver", "servo")]

    def warnings():
        printed = "".join(log.read_text() for log in logs if log.exists())
        return printed.count("deactivated with the amplifier on: it has been switched off")

    before = warnings()  # those of the graph with the other processes
    loop.trip()
    loop.until(lambda: loop.safety[-1].fault.startswith("tripped"))
    assert loop.change("driver", "deactivate") and loop.change("driver", "activate")
    loop.received(ENCODER)
    refusal = loop.enable()
    assert not refusal.success and "the door is open" in refusal.message
    assert loop.trigger("driver/reset_fault").success
    loop.switch_on()
    assert loop.change("driver", "deactivate")
    loop.until(lambda: not loop.safety[-1].amplifier_on and not loop.safety[-1].fault)
    # The state may be here before the line. Once: at the first deactivation a fault had switched it off.
    loop.until(lambda: warnings() > before)
    assert warnings() == before + 1
    assert loop.change("driver", "activate")


def test_parameters_change_as_a_whole_or_not_at_all_while_the_loop_runs(loop):
    for node, values, words in (
        ("controller", {"control.law": "linear", "control.smc.rho": -1.0}, "control.smc.rho"),
        ("controller", {"control.law": "linear", "stage.rate": 100}, "'stage.rate' is fixed"),
        ("controller", {"control.law": "smc", "control.smc.boundary_layer": 5e-4}, "the law 'smc' is unstable"),
        (
            "controller",
            {"control.law": "smc", "control.smc.boundary_layer": 0.0, "control.filters.mains.frequency": 50.0},
            "no linearisation at rest",
        ),
        ("feedforward", {"stage.guide.file": "nowhere.csv"}, "nowhere.csv"),
    ):
        refused = loop.set(node, values)
        assert not refused.successful and words in refused.reason
    assert switching(loop)  # the law is as before
    assert loop.set("controller", {"control.law": "linear", "stage.actuator.current_limit": 0.5}).successful
    loop.until(lambda: not switching(loop))
    assert loop.trigger("feedforward/reload_map").success
    assert loop.set("driver", {"stage.actuator.current_limit": 0.95}).successful
    loop.received(ENCODER)
    assert loop.amplifier_on()


def test_a_managed_logger_ends_its_bag_at_cleanup_and_is_unconfigured_when_it_fails(nodes, participant):
    bag, other = nodes / "managed", nodes / "other"
    assert participant.set("logger", {"output": str(bag)}).successful
    for label in ("configure", "activate", "deactivate", "cleanup"):
        assert participant.change("logger", label)
    assert (bag / "metadata.yaml").exists() and "parameters.yaml" in read_attachments(bag)
    # The folder is not empty now: the logger refuses it, and takes another.
    assert not participant.change("logger", "configure")
    assert participant.set("logger", {"output": str(other)}).successful
    assert participant.change("logger", "configure") and participant.change("logger", "activate")
    # It fails at work: it is unconfigured, and works again when it is configured anew.
    assert participant.set("logger", {"min_free_bytes": 10**18}).successful
    participant.until(lambda: participant.state("logger") == "unconfigured")
    assert (other / "metadata.yaml").exists()
    assert participant.set("logger", {"min_free_bytes": 0, "output": str(nodes / "third")}).successful
    assert participant.change("logger", "configure") and participant.change("logger", "activate")
    assert participant.state("logger") == "active"


@pytest.mark.parametrize("node", ["controller", *nightly(["feedforward"])])
def test_a_node_of_one_process_stops_and_starts_while_the_others_run(loop, node):
    assert loop.change(node, "deactivate")
    loop.until(lambda: loop.safety[-1].fault.startswith("command_timeout"))
    loop.received(ENCODER)  # the driver samples on
    assert loop.change(node, "cleanup") and loop.change(node, "configure") and loop.change(node, "activate")
    assert loop.trigger("driver/reset_fault").success
    loop.switch_on()
    loop.received(CONTROLLER_STATE)


def test_a_controller_that_was_shut_down_is_missing_and_no_other_node_is_said_to_publish(loop):
    assert loop.change("controller", "shutdown")
    loop.until(lambda: loop.safety[-1].fault)
    assert loop.safety[-1].fault.startswith("command_timeout")

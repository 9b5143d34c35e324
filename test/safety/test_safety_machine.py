"""The state machine that alone switches the amplifier, and the table of its faults."""

import random
import re
from unittest.mock import Mock

import pytest
from places import cells, line_of, page
from surveys import GUIDE

from straightcomp_ros.hardware.interface import State
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.parameters.node_parameters import CellNodeParameters, ControllerNodeParameters
from straightcomp_ros.safety.faults import LABELLED, LONGEST_REASON, Fault, explained, one_line
from straightcomp_ros.safety.state_machine import SafetyMachine
from straightcomp_ros.stage.description import StageParameters


@pytest.fixture
def hardware():
    hardware = SimulatedHardware(SimulatedParameters(), StageParameters(), GUIDE)
    hardware.start(0)
    return hardware


OFF, ON, FAULT = State
TRANSITIONS = {
    "enable": {OFF: ON, ON: ON, FAULT: FAULT},
    "disable": {OFF: OFF, ON: OFF, FAULT: FAULT},
    "trip": {OFF: FAULT, ON: FAULT, FAULT: FAULT},
    "reset": {OFF: OFF, ON: ON, FAULT: OFF},
}


def test_the_amplifier_is_on_exactly_in_the_condition_on_whatever_comes(hardware):
    safety = SafetyMachine(hardware)
    chance = random.Random(3)
    for _ in range(500):
        event = chance.choice(list(TRANSITIONS))
        before, fault = safety.condition, safety.fault
        if event == "enable":
            assert bool(safety.enable()) is (before is FAULT)
        elif event == "disable":
            safety.disable()
        elif event == "trip":
            safety.trip(chance.choice(list(Fault)), "a reason", 1)
            assert safety.fault is (fault or safety.fault)  # the first one stays
        else:
            safety.reset()
        assert safety.condition is TRANSITIONS[event][before]
        assert (hardware.state is State.ON) is (safety.condition is ON)
        assert (safety.fault is not None) is (safety.condition is FAULT)


def test_a_machine_that_refuses_to_switch_on_leaves_the_condition_as_it_was(hardware):
    safety = SafetyMachine(hardware)
    hardware.enable()
    hardware.read(10**9)  # no command: its own timeout
    assert "no command for" in safety.enable()
    assert safety.condition is OFF


def test_the_first_fault_is_the_reason_and_the_next_ones_only_count(hardware, monkeypatch):
    safety, requests = SafetyMachine(hardware), []
    monkeypatch.setattr(hardware, "disable", lambda: requests.append("off"))
    assert safety.reason == ""
    safety.trip(Fault.X_JUMP, "x went away", 5)
    for _ in range(5000):
        safety.trip(Fault.TWO_CONTROLLERS, "a reason", 6)
    assert safety.fault == (Fault.X_JUMP, "x went away", 5) and safety.reason == "x_jump: x went away"
    assert (requests, safety.trips) == (["off"], 5001)


def test_a_fault_of_the_hardware_gets_the_name_that_comes_later_and_another_one_keeps_its_own():
    hardware = Mock(fault=None)
    safety = SafetyMachine(hardware)
    for first in (None, "x went away"):
        hardware.fault = None
        safety.follow(4)
        if first:
            safety.trip(Fault.X_JUMP, first, 4)
        for time_ns, words in ((5, "a fault"), (6, "command timeout"), (7, "command timeout")):
            hardware.fault = Fault.BOARD, words
            safety.follow(time_ns)
            assert safety.fault == ((Fault.X_JUMP, first, 4) if first else (Fault.BOARD, words, 5))
        safety.reset()
    assert safety.trips == hardware.disable.call_count == 2


def test_each_fault_has_a_number_of_its_own_above_zero_and_its_row_in_the_documented_table():
    codes, documented = {fault.code for fault in Fault}, page("safety")
    assert len(codes) == len(Fault) == len(LABELLED) and min(codes) > 0 and LABELLED["x_jump"] is Fault.X_JUMP
    for fault in Fault:
        *_, within, reaction, reset = cells(line_of(documented, f"`{fault.label}` | {fault.code}"))
        assert (within, reaction, reset) == (f"{fault.value.within_ms:g}", fault.value.reaction, fault.value.reset)


@pytest.mark.parametrize("fault", Fault)
def test_a_fault_in_a_message_is_shown_with_what_it_means_and_how_it_ends_and_any_other_text_as_it_is(fault):
    for text in (f"fault {fault.label}: a reason: its cause", fault.label, f" {fault.label} : 5"):
        shown = explained(text)
        assert (shown["text"], shown["means"], shown["causes"]) == (text, fault.value.means, fault.value.causes)
        assert shown["remedy"].startswith(f"{fault.value.remedy}. Then: ") and all(shown.values())
        # Each is understood alone. A recording that stopped does not switch off.
        assert "others" not in shown["remedy"]
        assert ("`driver/enable`" in shown["remedy"]) is (fault is not Fault.RECORDING_STOPPED)
    for other in ("", "a reason", f"{fault.label}s: a reason", f"a fault {fault.label}"):
        assert explained(other) == {"text": other, "means": "", "causes": "", "remedy": ""}


def test_a_text_of_another_program_is_one_line_of_its_first_characters_and_steers_no_terminal():
    assert one_line("höher: 5 µm") == "höher: 5 µm"
    assert one_line("a\nb\x1b[2J\u2028c") == r"a\nb\x1b[2J\u2028c"
    assert one_line("12345", 4) == "1234" and one_line("\n\n\n", 4) == r"\n\n"
    assert len(one_line("x" * 10**6)) == LONGEST_REASON


@pytest.mark.parametrize(
    ("fault", "timeout_s"),
    [
        (Fault.COMMAND_TIMEOUT, SimulatedParameters.command_timeout),
        (Fault.SAMPLE_TIMEOUT, ControllerNodeParameters.sample_timeout),
        (Fault.HEARTBEAT_LOST, CellNodeParameters.heartbeat_timeout),
    ],
)
def test_a_fault_of_a_timeout_comes_after_its_default_and_at_most_200_ms_later(fault, timeout_s):
    assert 0.0 < fault.value.within_ms - 1e3 * timeout_s <= 200.0


@pytest.mark.parametrize("composed", [False, True])
def test_the_trials_inject_all_faults_but_those_that_the_page_names(composed):
    trials = pytest.importorskip("trials.faults")
    named = page("safety").partition("`python -m trials faults` injects")[2].partition(", nor the board's")[0]
    without = {LABELLED[label] for label in re.findall(r"`(\w+)`", named)}
    # Of one process all that is seen of its end is that its nodes are silent.
    without |= {Fault.SAMPLE_TIMEOUT} if composed else set()
    assert {trial.fault for trial in trials.trials_of(composed)} == set(Fault) - without

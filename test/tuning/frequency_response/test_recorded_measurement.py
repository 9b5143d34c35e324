"""A bag of the excited loop gives the response of the loop if the whole excitation is in it."""

import dataclasses

import numpy as np
import pytest

from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.control.excitation import MultisineParameters, multisine_injection
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.frequency_response import ExcitationEnded
from straightcomp_ros.tuning.frequency_response.measurement import measure_simulated, response_from_bag

EXCITATION = MultisineParameters(draws=8)


def recorded(bag, share=1.0):
    """A bag of the loop, in which the excitation was ended after ``share`` of it; its law and its stage."""
    values = shipped_parameters()
    nodes = node_set(values)
    stage, control = nodes.controller.stage, nodes.controller.control
    excitation, injection = multisine_injection(EXCITATION, make_law(control, stage), stage)
    end_ns = round(2e9 + excitation.currents.size / stage.rate * 1e9)
    simulation = Simulation(values, motion=(Trajectory([Waypoint(0, 0.5, 0.0), Waypoint(end_ns, 0.5, 0.0)]), 0))
    begin, stop, index = stage.rate, stage.rate + round(share * excitation.currents.size), 0
    with SimulatedRun(bag, by_node(values), simulation.delay) as run:

        def observe(*sample):
            nonlocal index
            index += 1
            if index == begin:
                simulation.inject(injection)
            elif index == stop:
                injection.stop("ended")
            run.add(*sample)

        simulation.run(observe=observe)
    return values, control, stage


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A bag of the whole excitation; its parameters, its law and its stage."""
    bag = tmp_path_factory.mktemp("whole") / "bag"
    return bag, *recorded(bag)


def test_a_whole_excitation_gives_what_is_measured_at_once_and_late_commands_are_reported(whole):
    bag, values, control, stage = whole
    found = response_from_bag(bag, EXCITATION, control, stage)
    at_once = measure_simulated(values, EXCITATION)
    ratio = found.measured.response.plant / at_once.measured.response.plant
    assert np.abs(ratio[found.measured.coherent] - 1.0).max() < 0.05 and found.explained
    assert found.late_share < 1e-3 and found.lateness == ""
    # Of a host whose commands are due sooner than they came.
    soon = dataclasses.replace(stage, drive=dataclasses.replace(stage.drive, delay=0.5 * stage.drive.delay))
    found = response_from_bag(bag, EXCITATION, control, soon)
    assert found.late_share == 1.0 and found.lateness.startswith("100% of the commands came late")


@pytest.mark.parametrize("share", [0.5, 0.85, 0.96])
def test_an_excitation_that_ended_early_is_said_to_have_ended(tmp_path, share):
    _, control, stage = recorded(tmp_path / "bag", share)
    with pytest.raises(ExcitationEnded, match="ended early"):
        response_from_bag(tmp_path / "bag", EXCITATION, control, stage)

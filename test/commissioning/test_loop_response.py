"""How far the excitation moves a machine is a guess: the step measures once more with half of it."""

import dataclasses
from pathlib import Path

from roughly_known import values_of, work_on

from straightcomp_ros.commissioning.loop_response import frequency_response
from straightcomp_ros.commissioning.simulated_machine import SimulatedMachine
from straightcomp_ros.configuration.node_parameters import Values
from straightcomp_ros.frequency_response import ExcitationEnded
from straightcomp_ros.frequency_response.excitation_parameters import MultisineParameters
from straightcomp_ros.frequency_response.simulated_measurement import ComparedResponse


class Lively(SimulatedMachine):
    """Leaves the travel as long as more than ``bears`` of it is aimed at."""

    bears = 0.0

    def response(self, values: Values, excitation: MultisineParameters) -> ComparedResponse:
        if excitation.motion > self.bears:
            raise ExcitationEnded(f"the excitation was ended early at {excitation.motion:.3f} of the travel")
        return super().response(values, dataclasses.replace(excitation, draws=8))


def test_a_machine_that_left_the_travel_is_measured_with_half_the_motion(tmp_path: Path) -> None:
    values = values_of()
    machine = Lively(values)
    machine.bears = 0.1
    outcome = frequency_response(dataclasses.replace(work_on(values, tmp_path), machine=machine))
    assert outcome.passed, outcome.sentence
    assert outcome.figures["coherent_lines"] > 20


def test_a_machine_that_leaves_it_again_ends_the_step_with_the_sentence(tmp_path: Path) -> None:
    values = values_of()
    outcome = frequency_response(dataclasses.replace(work_on(values, tmp_path), machine=Lively(values)))
    assert not outcome.passed and outcome.sentence == "the excitation was ended early at 0.083 of the travel"

"""The excitation stays within the travel: by the simulation first, and with half of the motion if that was wrong."""

import dataclasses
from pathlib import Path

import pytest
from roughly_known import values_of, work_on

from straightcomp_ros.control.excitation_parameters import MultisineParameters
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.tuning.commissioning import closed_loop
from straightcomp_ros.tuning.commissioning.closed_loop import frequency_response
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine
from straightcomp_ros.tuning.frequency_response import ExcitationEnded, response_plot
from straightcomp_ros.tuning.frequency_response.measured_response import (
    ComparedResponse,
    ResponseMargins,
    response_margins,
)
from straightcomp_ros.tuning.frequency_response.measurement import measure_simulated


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


@pytest.mark.parametrize(("needed", "share"), [(0.69, 1.0), (0.9, 0.7), (1.8, 0.5), (3.0, 0.35)])
def test_a_machine_that_would_need_most_of_the_travel_is_moved_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, needed: float, share: float
) -> None:
    usual = MultisineParameters().motion

    def simulated(values: Values, excitation: MultisineParameters) -> ComparedResponse:
        # More motion needs more travel than in proportion; the limit is that of the simulation.
        aimed = excitation.motion * excitation.travel / (usual * work.travel)
        if needed * aimed**2 * work.travel > excitation.travel:
            raise ExcitationEnded("the excitation was ended early: too far")
        return measure_simulated(values, dataclasses.replace(excitation, draws=8))

    class Noted(Lively):
        motion = 0.0

        def response(self, values: Values, excitation: MultisineParameters) -> ComparedResponse:
            self.motion = excitation.motion
            return super().response(values, excitation)

    values = values_of()
    machine = Noted(values)
    machine.bears = 1.0
    work = dataclasses.replace(work_on(values, tmp_path), machine=machine)
    monkeypatch.setattr(closed_loop, "measure_simulated", simulated)
    assert frequency_response(work).passed
    assert machine.motion == pytest.approx(share * usual)
    monkeypatch.setattr(closed_loop, "_MOTIONS", (1.0,))
    if share < 1.0:
        sentence = frequency_response(work).sentence
        assert (
            sentence
            == "the machine as identified needs too much of the travel: the excitation was ended early: too far"
        )


@pytest.fixture(scope="module")
def measured() -> ComparedResponse:
    return measure_simulated(values_of(), MultisineParameters(draws=4))


@pytest.mark.parametrize(
    ("margins", "words"),
    [
        ({}, ""),
        ({"gain_low": None, "gain_high": None}, ""),
        ({"gain_high": 1.2}, "phase margin 40°, gain down to 0.50 and up to 1.20 times (allowed: phase >= 10°, gain"),
        ({"gain_high": None, "phase": 5.0}, "phase margin 5°, gain down to 0.50 times"),
        ({"gain_low": 0.9, "gain_high": None}, "phase margin 40°, gain down to 0.90 times"),
        ({"gain_low": None, "gain_high": None, "phase": 9.0}, "phase margin 9°, gain beyond the lines"),
        ({"phase": None}, "no gain crossover is among the coherent lines"),
    ],
)
def test_margins_are_judged_to_both_sides_and_told_in_the_sentence(
    margins: dict[str, float | None],
    words: str,
    measured: ComparedResponse,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = ResponseMargins(0.5, 2.0, 40.0, 80.0, 1e-3, 1.8, 200.0)._replace(**margins)
    monkeypatch.setattr(closed_loop, "response_margins", lambda frequencies, loop: whole)
    monkeypatch.setattr(closed_loop, "_measured", lambda work: measured)
    monkeypatch.setattr(response_plot, "plot_response", lambda *_: None)
    outcome = frequency_response(work_on(values_of(), tmp_path))
    assert outcome.passed is not bool(words) and words in outcome.sentence


def test_margins_are_those_of_the_coherent_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used = []

    def noted(frequencies, loop):
        used.append(len(frequencies))
        return response_margins(frequencies, loop)

    monkeypatch.setattr(closed_loop, "response_margins", noted)
    values = values_of(friction__coulomb=6.0, friction__static=8.0)
    machine = Lively(values)
    machine.bears = 1.0
    outcome = frequency_response(dataclasses.replace(work_on(values, tmp_path), machine=machine))
    assert outcome.figures["coherent_lines"] < outcome.figures["lines"]
    assert used == [outcome.figures["coherent_lines"]] * 2

"""What is not as described is named at the identification; the excitation stays within the travel; margins count."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from roughly_known import values_of, work_on

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.current_path import SHORTEST, CurrentPath, read_recording
from straightcomp_ros.control.excitation import ExcitationEnded, MultisineParameters
from straightcomp_ros.model.motion import forward_and_back
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters, UncertaintyParameters
from straightcomp_ros.straightness.guide_map import load_map
from straightcomp_ros.tuning.commissioning import MADE, LeftTravel, closed_loop
from straightcomp_ros.tuning.commissioning.closed_loop import (
    facts_found,
    frequency_response,
    identification,
    margins_missed,
    modes_found,
    scaled_by,
    strangeness,
)
from straightcomp_ros.tuning.design.feasible_gains import DesignError
from straightcomp_ros.tuning.frequency_response import response_plot
from straightcomp_ros.tuning.frequency_response.found_modes import FoundMode, FoundPlant, Interval
from straightcomp_ros.tuning.frequency_response.measured_response import (
    ResponseMargins,
    measure_simulated,
    response_margins,
)
from straightcomp_ros.tuning.identification.estimate import DERIVED, UNITS, Estimate, Estimated

STAGE = StageParameters(uncertainty=UncertaintyParameters(mass=0.2, force=0.2, air_gap=0.1, friction=2.0))
USUAL = MultisineParameters().motion
NOTCH = "control.filters.first.frequency"
ONE = Interval(1.0, 0.99, 1.01)


@pytest.fixture(autouse=True)
def without_plots(monkeypatch):
    monkeypatch.setattr(response_plot, "plot_response", lambda *_: None)


@pytest.fixture
def work(tmp_path):
    return work_on(values_of(), tmp_path)


def found_mode(frequency):
    return FoundMode(Interval(frequency, frequency - 1.0, frequency + 1.0), *2 * (Interval(0.01, 0.008, 0.013),), "")


def swinging(growth, frequency):
    """y of 0.2 s of a swing that grows, in m."""
    time = np.arange(400) * STAGE.period
    return 1e-9 * np.exp(growth * time) * np.cos(2.0 * np.pi * frequency * time)


def looked_at(swing, **mechanics):
    """A response that shows this of the mechanics."""
    return SimpleNamespace(mechanics=FoundPlant(**mechanics), measured=SimpleNamespace(swing=swing))


def estimate(poor="", width=2.0, **factors):
    """An exact estimate of a machine that differs from the description by factors, by the last part of the name.

    The interval of ``poor`` goes to its value times and over ``width``; the amplifier is that of the description. What
    there is none of was held at that.
    """
    described = {**to_mapping(STAGE), **{name: getattr(STAGE.actuator, name.partition(".")[2]) for name in DERIVED}}
    found = {}
    for name in UNITS:
        value = described[name] * factors.get(name.partition(".")[2], 1.0)
        low, high = (1.0 / width, width) if name == poor else (0.99, 1.01)
        found[name] = Estimated(name, value, low * value, high * value, name == "platform.mass" or not value)
    path = CurrentPath(1.0, None, None, None, 1e-4, False, 0.0, (1e-4, 1e-4))
    return Estimate(found, None, path, SimpleNamespace(rms_error_m=1e-8))


@pytest.mark.parametrize(
    ("factors", "words", "poor"),
    [
        ({"air_gap": 0.5}, "the air gap seems 0.5 times the described one", ""),
        # Half as wide, or as described: the record leaves both open.
        ({"air_gap": 0.5}, "", "actuator.air_gap"),
        ({"coulomb": 10.0}, "friction is 10 times the described one", "friction.coulomb"),
        ({"turns": 1.9**0.5}, "accelerates the platform 1.9 times as much as described", ""),
        ({"turns": 0.4**0.5}, "accelerates the platform 0.4 times as much as described", ""),
        ({"coulomb": 10.0}, "friction is 10 times the described one", ""),
        ({"coulomb": 20.0, "air_gap": 12.0}, "and at the gap; friction is 20 times the described one", ""),
        ({"coulomb": 1.9}, "", ""),
        ({}, "", ""),
    ],
)
def test_what_certainly_lies_beyond_the_uncertainty_is_named_and_nothing_else(factors, words, poor):
    strange = strangeness(estimate(poor, **factors), STAGE)
    assert (words in strange) if words else strange == ""


FORCE = {"actuator.turns", "uncertainty.mass", "uncertainty.force"}
GAP = {"actuator.air_gap", "uncertainty.air_gap"}
FRICTION = {"friction.coulomb", "uncertainty.friction"}
WIDE = {"mass": 0.4, "force": 0.4, "air_gap": 0.4, "friction": 3.0}


@pytest.mark.parametrize(
    ("described", "found", "taken", "kept"),
    [
        # Described better than F_S is its ratio to F_C.
        ({}, estimate("friction.static", coulomb=2.5), {"friction.coulomb": 2.5, "friction.static": 2.5}, set()),
        ({}, estimate("actuator.turns", turns=1.1), {"uncertainty.air_gap": 0.2}, FORCE),
        # Turns go with their gap, also with one that is not poor.
        ({}, estimate("actuator.air_gap", 1.2, turns=1.05, air_gap=1.05), {"friction.coulomb": 1.0}, FORCE | GAP),
        # What is poor may be better than its description, and what is not may be worse.
        (
            WIDE,
            estimate("friction.coulomb", coulomb=1.5),
            {"friction.coulomb": 1.5, "uncertainty.friction": 2 / 3},
            set(),
        ),
        ({}, estimate("friction.coulomb", coulomb=1.5), {}, FRICTION),
        ({"friction": 1.1}, estimate("friction.coulomb", 1.25), {}, FRICTION),
        ({"friction": 1.1}, estimate("friction.coulomb", 1.05), dict.fromkeys(FRICTION, 1.0), set()),
        # Of friction that was held at none nothing is found.
        ({}, estimate(coulomb=0.0), {}, FRICTION),
    ],
)
def test_what_was_described_better_than_it_is_found_stays_as_it_was_and_as_uncertain(described, found, taken, kept):
    """What is ``taken`` is so many times as large as described."""
    stage = dataclasses.replace(STAGE, uncertainty=dataclasses.replace(STAGE.uncertainty, **described))
    facts, before = facts_found(found, stage), to_mapping(stage)
    assert {name: facts[name] / before[name] for name in taken} == pytest.approx(taken) and not kept & facts.keys()


def test_a_mode_that_nobody_described_is_described_as_found(tmp_path, monkeypatch):
    known = found_mode(350.0)._replace(described="stage.platform.modes.first")
    found = found_mode(180.0)._replace(residue=Interval(-1.0, -1.1, -0.9))
    work = work_on(values_of(platform__modes__first__frequency=350.0), tmp_path)
    monkeypatch.setattr(closed_loop, "_measured", lambda work, **excited: looked_at(0.0, modes=(found, known)))
    mechanics, words, gains = closed_loop._looked_at(work, {})
    assert gains == {}
    facts = modes_found(mechanics, work.stage)
    assert facts["platform.modes.second.frequency"] == 180.0 and facts["platform.modes.second.encoder"] == -1.0
    assert not any("first" in name for name in facts) and "180.0 Hz" in words and "350.0 Hz" in words
    assert work.given("stage", facts).stage.platform.modes.second.residue == -1.0


def test_what_the_response_shows_of_force_over_mass_moves_all_forces_of_the_record_alike():
    found = estimate(turns=1.2, coulomb=1.44, static=1.44)
    facts = facts_found(found, STAGE)
    # The record made all forces 1.44 times as large: the response shows them as described.
    scaled, scale = scaled_by(Interval(1.0 / 1.44, 0.98 / 1.44, 1.02 / 1.44), facts, found, STAGE)
    assert scale == pytest.approx(1.0 / 1.44)
    assert scaled["actuator.turns"] == pytest.approx(STAGE.actuator.turns)
    for name in ("coulomb", "static"):
        assert scaled[f"friction.{name}"] == pytest.approx(getattr(STAGE.friction, name), rel=1e-6)
    assert scaled["uncertainty.mass"] == 0.02 and scaled["uncertainty.force"] == 0.05
    # Of what the record did not identify, the description is what is scaled.
    poor = estimate("actuator.turns", turns=1.2)
    scaled, scale = scaled_by(Interval(1.1, 1.09, 1.11), facts_found(poor, STAGE), poor, STAGE)
    assert scaled["actuator.turns"] == pytest.approx(STAGE.actuator.turns * 1.1**0.5)
    assert scale == pytest.approx(1.1 / 1.44) and scaled["uncertainty.force"] == 0.05
    # Nor is a wide gap lacking force: the response has what the record hardly shows of it.
    wide = estimate("actuator.air_gap", air_gap=1.2)
    seen = 0.7 / 1.2**2
    scaled, scale = scaled_by(Interval(*(seen * one for one in ONE)), facts_found(wide, STAGE), wide, STAGE)
    assert scale == pytest.approx(0.7) and not strangeness(wide, STAGE, scale)
    assert scaled["actuator.turns"] == pytest.approx(STAGE.actuator.turns * seen**0.5)
    assert "2 times" in strangeness(estimate(turns=2.0**0.5), STAGE) and not strangeness(found, STAGE, 1.0 / 1.44)


def test_the_machine_of_the_first_look_is_the_model_of_the_second_which_may_see_more(work, monkeypatch):
    mode, seen = found_mode(180.0), []

    def looked(before, facts):
        assert before.stage == work.stage
        seen.append(facts["actuator.turns"])
        # Of the machine as described, but for a tenth of its force.
        force = 0.9 * (STAGE.actuator.turns / seen[-1]) ** 2
        gain = Interval(force, 0.98 * force, 1.02 * force)
        return FoundPlant(gain, (mode,) if len(seen) > 1 else ()), "", {}

    monkeypatch.setattr(closed_loop, "_excited", lambda *_: {})
    monkeypatch.setattr(closed_loop, "estimate_from_bag", lambda *_: estimate(turns=1.2))
    monkeypatch.setattr(closed_loop, "_looked_at", looked)
    outcome = identification(work)
    assert outcome.passed and outcome.stage["platform.modes.first.frequency"] == 180.0
    turns = STAGE.actuator.turns
    assert seen == pytest.approx([1.2 * turns, 0.9**0.5 * turns])
    assert outcome.stage["actuator.turns"] == pytest.approx(0.9**0.5 * turns)
    assert outcome.stage["friction.coulomb"] == pytest.approx(STAGE.friction.coulomb * 0.9 / 1.44)
    # Where the second look fails, the first one counts.
    looks = [(FoundPlant(Interval(0.625, 0.62, 0.63), (mode,)), "; one mode", {}), (FoundPlant(), "; none", {})]
    monkeypatch.setattr(closed_loop, "_looked_at", lambda *_: looks.pop(0))
    outcome = identification(work)
    assert outcome.stage["actuator.turns"] == pytest.approx(0.9**0.5 * turns) and not looks
    assert outcome.stage["platform.modes.first.frequency"] == 180.0 and "one mode" in outcome.sentence
    # One that does not show the force changes nothing of it, whatever the other one shows.
    narrow, wide = Interval(0.625, 0.62, 0.63), Interval(0.625, 0.4, 0.9)
    for first, second in ((wide, narrow), (narrow, Interval(1.0, 0.7, 1.4))):
        looks = [(FoundPlant(one, (mode,)), "", {}) for one in (first, second)]
        assert identification(work).stage["actuator.turns"] == pytest.approx(0.9**0.5 * turns) and not looks


@pytest.mark.parametrize(("bandwidth", "stays"), [(500.0, False), (1e4, True)])
def test_an_amplifier_too_fast_for_the_samples_stays_as_uncertain_as_it_was_described_and_the_delay_with_it(
    bandwidth, stays
):
    fast = dataclasses.replace(STAGE, drive=dataclasses.replace(STAGE.drive, bandwidth=bandwidth))
    found = dataclasses.replace(estimate(), path=SimpleNamespace(rate_found=True, rate=3e4, delay=1e-4))
    names = {"drive.bandwidth", "drive.delay", *(f"uncertainty.{one}" for one in ("amplifier", "longest_delay"))}
    assert names & facts_found(found, fast).keys() == (set() if stays else names)


@pytest.mark.parametrize(
    ("growth", "rings", "lawful", "ends", "words"),
    [
        # There is a law for a mode seen 0.28 times at coil and encoder, under which the platform stays.
        (20.0, 93.0, 0.28, "identified", "far enough"),
        (20.0, 93.0, 0.28, "left", r"; it swung at 9[345] Hz then, and left it again under a law for a mode there"),
        (20.0, 93.0, 0.0, "left", r"; it swung at 9[345] Hz then; no safe law can leave a mode there alone"),
        (12.0, 0.0, 0.28, "left", "left its reference$"),
    ],
)
def test_a_platform_that_swings_out_of_its_travel_is_tried_once_more_under_a_safe_law_for_a_mode_there(
    work, monkeypatch, growth, rings, lawful, ends, words
):
    strokes = []

    def stroke(values, bag, travel, count):
        strokes.append(values["controller"].get(NOTCH, 0.0))
        if len(strokes) == 1 or ends == "left":
            raise LeftTravel("the platform left its reference")

    def safe_law(scenario):
        mode = scenario.description.platform.modes.first
        if abs(mode.coil) > lawful:
            raise DesignError("none")
        assert mode.coil == -mode.encoder == 0.28
        return SimpleNamespace(values={NOTCH: mode.frequency})

    def identified(*_):
        raise IdentificationError("far enough")

    monkeypatch.setattr(closed_loop, "recorded_reading", lambda bag: swinging(growth, rings))
    monkeypatch.setattr(closed_loop, "safe_law", safe_law)
    monkeypatch.setattr(closed_loop, "estimate_from_bag", identified)
    found = identification(dataclasses.replace(work, machine=SimpleNamespace(stroke=stroke)))
    assert not found.passed and re.search(words, found.sentence)
    assert strokes[0] == 0.0 and strokes[1:] == ([pytest.approx(rings, rel=0.02)] if rings and lawful else [])


@pytest.mark.parametrize(
    ("leaves", "again", "seen"),
    [
        (None, False, True),
        (swinging(20.0, 72.0), False, True),
        (swinging(20.0, 72.0), True, False),
        # It does not swing.
        (np.zeros(400), False, False),
    ],
)
def test_a_platform_that_swings_while_modes_are_looked_for_is_looked_at_under_a_safe_law_for_one_and_none_ends_nothing(
    work, monkeypatch, leaves, again, seen
):
    mode = found_mode(72.3)

    def measured(work, **excited):
        safe = work.values["controller"].get(NOTCH)
        if leaves is not None and (again or not safe):
            raise ExcitationEnded("too far", leaves)
        return looked_at(0.0, modes=(mode,)) if safe else looked_at(72.0)

    def safe_law(scenario):
        return SimpleNamespace(values={NOTCH: scenario.description.platform.modes.first.frequency})

    monkeypatch.setattr(closed_loop, "_measured", measured)
    monkeypatch.setattr(closed_loop, "safe_law", safe_law)
    mechanics, words, gains = closed_loop._looked_at(work, {})
    assert mechanics == FoundPlant(modes=(mode,) * seen) and ("not looked for: too far" in words) is not seen
    assert gains == ({NOTCH: pytest.approx(72.0, rel=0.02)} if seen else {})


def test_a_platform_that_swings_under_a_wrong_force_over_mass_is_looked_at_under_the_description_before(
    work, monkeypatch
):
    mode = found_mode(72.3)

    def measured(one, **excited):
        # The machine is as described; twice its force over mass in the law halves the loop's gain.
        swings = one.stage.actuator.turns > STAGE.actuator.turns
        return looked_at(72.0, gain=ONE) if swings else looked_at(0.0, gain=ONE, modes=(mode,))

    monkeypatch.setattr(closed_loop, "_measured", measured)
    mechanics, _, gains = closed_loop._looked_at(work, {"actuator.turns": STAGE.actuator.turns * 2.0**0.5})
    assert mechanics.modes == (mode,) and not gains
    # Relative to the facts that were handed over.
    assert mechanics.gain == pytest.approx((0.5, 0.495, 0.505))


@pytest.mark.parametrize(("known", "passes"), [(3.0, True), (1.1, False)])
def test_a_plant_that_only_its_friction_explains_passes_if_the_friction_is_as_open_as_that(
    tmp_path, monkeypatch, measured, known, passes
):
    turned = dataclasses.replace(measured.measured.response, plant=measured.measured.response.plant * np.exp(0.5j))

    # A share of friction turns this plant by as much of its logarithm.
    def simulated(values, excitation):
        turn = 0.5 * np.log(values["driver"].get("simulated.truth.friction", 1.0)) / np.log(2.0)
        response = dataclasses.replace(measured.measured.response, plant=turned.plant * np.exp(1j * (turn - 0.5)))
        return dataclasses.replace(measured, measured=dataclasses.replace(measured.measured, response=response))

    shown = dataclasses.replace(measured, measured=dataclasses.replace(measured.measured, response=turned))
    monkeypatch.setattr(closed_loop, "measure_simulated", simulated)
    machine = SimpleNamespace(response=lambda values, excitation: shown)
    work = dataclasses.replace(work_on(values_of(uncertainty__friction=known), tmp_path), machine=machine)
    assert frequency_response(work).passed == passes


@pytest.mark.parametrize("step", ["safe_loop", "identification", "design"])
def test_the_notch_of_a_safe_law_is_not_the_designs(work, monkeypatch, step):
    work.values["controller"][NOTCH] = 94.0
    safe = {step: closed_loop.Outcome(True, "", gains={NOTCH: 94.0})}

    def designed(scenario, law, **_):
        assert next(iter(scenario.controls.values())).filters.first.frequency == 0.0
        raise DesignError("far enough")

    monkeypatch.setattr(closed_loop, "design_gains", designed)
    assert closed_loop.design(dataclasses.replace(work, outcomes=safe)).sentence == "far enough"


@pytest.mark.parametrize("motion", [{"stroke": 0.05}, {"stroke": 0.5}, {"stroke": 0.05, "steps": 20}])
def test_an_excitation_has_as_many_cycles_as_an_identification_needs_and_not_more(tmp_path, motion):
    """Of its own motion: one stroke without stops, of 0.5 m at most."""
    motion = {"acceleration": 2.0, "settle": 0.1, "pause": 0.1} | motion
    work = work_on(values_of(**{f"motion__{name}": value for name, value in motion.items()}), tmp_path)
    closed_loop._excited(work, tmp_path / "bag")
    samples = read_recording(tmp_path / "bag").y.size
    made = dataclasses.replace(work.stage.motion, steps=1)
    assert samples < SHORTEST + forward_and_back(made)[-1].time_ns / work.stage.period_ns


def test_the_map_of_the_excitation_stands_beside_its_bag_and_replaces_no_file_of_the_users(work):
    """Nor is it held to what is demanded of theirs; but it keeps to the platform's travel."""
    mine, moved_along = work.folder / "excitation.csv", []
    mine.write_text("a survey that took a day")

    def stroke(values, bag, travel, count):
        moved_along.append(values["stage"]["guide.file"])
        load_map(node_parameters("driver", values).stage.guide)
        raise LeftTravel("far enough")

    demands = {"guide.min_points": 1000, "guide.max_gap": 1e-4, "guide.travel": 4e-5}
    work = dataclasses.replace(work, machine=SimpleNamespace(stroke=stroke)).given("stage", demands)
    assert not identification(work).passed
    assert mine.read_text() == "a survey that took a day"
    assert moved_along == [str(work.folder / "bags" / "excitation.csv")] and "bags" in MADE


@pytest.fixture(scope="module")
def measured():
    """Made once: of a machine as described with much friction, against which slow motions are not coherent."""
    return measure_simulated(
        values_of(friction__coulomb=6.0, friction__static=8.0), MultisineParameters(draws=8, travel=2.8e-4)
    )


@pytest.fixture
def response(measured, monkeypatch, work):
    """The step on a machine that its simulation explains, and the motion that it was moved by at last.

    It leaves the travel where more than ``bears`` of it is aimed at.
    """
    monkeypatch.setattr(closed_loop, "measure_simulated", lambda values, excitation: measured)

    def run(bears=1.0, measured=measured):
        motions = [0.0]

        def respond(values, excitation):
            motions.append(excitation.motion)
            if excitation.motion > bears:
                raise ExcitationEnded(f"the excitation was ended early at {excitation.motion:.3f} of the travel")
            return measured

        return frequency_response(dataclasses.replace(work, machine=SimpleNamespace(response=respond))), motions[-1]

    return run


def test_other_turns_of_the_coils_change_no_margin(tmp_path):
    found = []
    for factor in (0.1, 1.0, 10.0):
        coils = {"actuator__turns": 400.0 / factor, "actuator__bias_current": factor}
        coils |= {"actuator__current_limit": 0.9 * factor, "drive__gain": 0.1 * factor}
        found.append(closed_loop._measured(work_on(values_of(**coils), tmp_path), draws=3))
    assert not any(one.clipped for one in found)
    assert [one.margins[0].phase_deg for one in found] == pytest.approx(3 * [found[1].margins[0].phase_deg], abs=1.0)


def test_a_machine_that_left_the_travel_is_measured_with_half_the_motion_once(response):
    outcome, motion = response(0.6 * USUAL)
    assert outcome.passed and motion == 0.5 * USUAL
    outcome, _ = response(0.0)
    assert not outcome.passed and outcome.sentence == "the excitation was ended early at 0.083 of the travel"


def test_a_mode_that_shows_under_the_designed_law_is_designed_for_and_measured_again(work, monkeypatch, measured):
    explained = dataclasses.replace(measured, model=measured.measured.response)
    shown, seen = dataclasses.replace(explained, mechanics=FoundPlant(modes=(found_mode(560.0),))), []
    notch, gains = "control.filters.second.frequency", {"control.law": "smc_observer", "control.smc.zeta": 0.8}

    def responds(work):
        seen.append(work.stage.platform.modes.first.frequency)
        return explained if seen[-1] else shown

    def designed(work):
        assert work.stage.platform.modes.first.frequency == 560.0
        return closed_loop.Outcome(True, "0.2 µm p-p predicted", {"budget": []}, gains=gains)

    monkeypatch.setattr(closed_loop, "_measured", responds)
    monkeypatch.setattr(closed_loop, "design", designed)
    work = dataclasses.replace(work, outcomes={"design": closed_loop.Outcome(True, "", gains={notch: 300.0})})
    outcome = frequency_response(work)
    assert outcome.passed and seen == [0.0, 560.0] and "560.0 Hz" in outcome.sentence
    assert outcome.stage["platform.modes.first.frequency"] == 560.0 and outcome.gains == gains
    assert outcome.figures["design"] == {"budget": []}
    monkeypatch.setattr(closed_loop, "design", lambda work: closed_loop.Outcome(False, "no gains have margins"))
    outcome = frequency_response(work)
    assert not outcome.passed and "560.0 Hz" in outcome.sentence and "no gains have margins" in outcome.sentence


@pytest.mark.parametrize(("needed", "share"), [(0.69, 1.0), (0.9, 0.7), (1.8, 0.5), (3.0, 0.35)])
def test_a_machine_that_would_need_most_of_the_travel_is_moved_less(
    work, monkeypatch, measured, response, needed, share
):
    def simulated(values, excitation):
        # More motion needs more travel than in proportion; the limit is that of the simulation.
        aimed = excitation.motion * excitation.travel / (USUAL * work.travel)
        if needed * aimed**2 * work.travel > excitation.travel:
            raise ExcitationEnded("the excitation was ended early: too far")
        return measured

    monkeypatch.setattr(closed_loop, "measure_simulated", simulated)
    outcome, motion = response()
    assert outcome.passed and motion == pytest.approx(share * USUAL)
    monkeypatch.setattr(closed_loop, "_MOTIONS", (1.0,))
    if share < 1.0:
        sentence = response()[0].sentence
        assert "needs too much of the travel: the excitation was ended early: too far" in sentence


@pytest.mark.parametrize(
    ("margins", "words"),
    [
        ({}, ""),
        ({"gain_low": None, "gain_high": None}, ""),
        ({"gain_high": 1.2}, "phase margin 40°, gain down to 0.50 and up to 1.20 times (allowed: phase >= 10°, gain"),
        ({"gain_high": None, "phase_deg": 5.0}, "phase margin 5°, gain down to 0.50 times"),
        ({"gain_low": 0.9, "gain_high": None}, "phase margin 40°, gain down to 0.90 times"),
        ({"gain_low": None, "gain_high": None, "phase_deg": 9.0}, "phase margin 9°, gain beyond the lines"),
        ({"phase_deg": None}, "no gain crossover is among the coherent lines"),
    ],
)
def test_margins_are_judged_to_both_sides_and_named_in_the_sentence(margins, words):
    missed = margins_missed(ResponseMargins(0.5, 2.0, 40.0, 80.0, 1e-3, 1.8, 200.0)._replace(**margins))
    assert (words in missed) if words else missed == ""


def test_margins_are_those_of_the_coherent_lines_and_end_the_step_where_they_are_too_small(
    measured, response, monkeypatch
):
    found = measured.measured
    frequencies, lines = found.frequencies, found.coherent
    # The others touch the critical point.
    loop = np.where(lines, found.response.open_loop, -1.001)
    found = dataclasses.replace(found, response=dataclasses.replace(found.response, open_loop=loop))
    figures = response(measured=dataclasses.replace(measured, measured=found))[0].figures
    assert 20 < figures["coherent_lines"] < figures["lines"]
    coherent = response_margins(frequencies[lines], loop[lines])
    assert coherent != response_margins(frequencies, loop)
    # The simulation, which is the model, is the measurement itself here.
    assert figures["margins"] == figures["model_margins"] == coherent._asdict()
    monkeypatch.setattr(closed_loop, "LEAST_PHASE", 90.0)
    outcome, _ = response()
    assert not outcome.passed and outcome.sentence.startswith("the measured margins are too small: phase margin")

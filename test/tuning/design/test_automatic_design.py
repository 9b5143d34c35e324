"""Automatic design from end to end, on short strokes with few candidates."""

import dataclasses
import math

import pytest
from motions import moving

from straightcomp_ros.control.laws import LAWS, make_law
from straightcomp_ros.control.margins import missing_margin
from straightcomp_ros.model.motion import MotionParameters
from straightcomp_ros.tuning.design.automatic_design import design_gains
from straightcomp_ros.tuning.design.error_budget import error_budget
from straightcomp_ros.tuning.design.gain_search import search
from straightcomp_ros.tuning.design.gains import SEARCHED, closed_form, scaled, with_gains
from straightcomp_ros.tuning.design.judged_gains import Judgement, extreme_machines, judge_of
from straightcomp_ros.tuning.design.prepared_stroke import prepared_stroke, shortened
from straightcomp_ros.tuning.design.stability import StabilityCheck

FEW = {"evaluations": 18, "machines": 4, "jobs": 1}


@pytest.fixture(scope="module")
def reported():
    return []


@pytest.fixture(scope="module")
def design(shipped, reported):
    return design_gains(shipped, quiet=0.0, progress=lambda step, fraction: reported.append((step, fraction)), **FEW)


def test_a_designed_stage_keeps_its_margins_and_is_silent_at_rest(design, shipped):
    control = with_gains(shipped.controls["smc_observer"], "smc_observer", design.values)
    assert StabilityCheck(shipped.description, design.demands).missed(control) == []
    assert missing_margin(control, shipped.description) is None
    quiet, stiff, demands = design.limits["quiet"], design.limits["stiff"], design.demands
    assert quiet.gain_low < demands.gain_low and quiet.gain_high > demands.gain_high
    assert stiff.gain_low < demands.stiff_gain_low and stiff.gain_high > demands.stiff_gain_high
    assert min(quiet.phase, stiff.phase) > demands.phase
    assert quiet.mass_low < 1.0 < quiet.mass_high and quiet.longest_delay > stiff.longest_delay
    assert design.holds and design.verification.trials == 4
    assert design.figures.rest_work.max == 0.0
    assert design.figures.pp.median < 2.0 * design.start_figures.pp.median


def test_progress_passes_through_every_step(design, reported):
    steps = list(dict.fromkeys(step for step, _ in reported))
    assert steps[0] == "feasible" and set(steps) == {"feasible", "search", "verify", "budget"}
    assert all(0.0 <= fraction <= 1.0 for _, fraction in reported)
    assert reported[-1] == ("budget", 1.0)


def test_the_budget_begins_with_the_stage_and_knows_what_its_encoder_costs(design):
    left = {entry.cause: entry for entry in design.budget}
    assert design.budget[0].cause == "as described" and len(left) == len(design.budget) == 10
    stage = left["as described"]
    assert left["ideal encoder of y and D/A converter"].rms < stage.rms
    assert left["friction known from the start"] != stage and left["a hundredth of the friction"].pp != stage.pp
    assert all(math.isfinite(entry.pp) and entry.pp > 0.0 for entry in design.budget)


def test_the_budget_of_a_law_without_a_friction_model_has_the_same_causes(design, shipped):
    plain = error_budget(shipped, "linear", closed_form(shipped, "linear"))
    assert [entry.cause for entry in plain] == [entry.cause for entry in design.budget]


@pytest.fixture(scope="module")
def judge(shipped):
    return judge_of(shipped, "smc_observer", 0.0)


@pytest.fixture(scope="module")
def begin(shipped):
    return closed_form(shipped, "smc_observer")


@pytest.fixture(scope="module")
def law(judge, begin):
    return make_law(with_gains(judge.control, "smc_observer", begin), judge.stage)


def test_the_same_seed_gives_the_same_design_and_another_seed_another(judge, begin):
    one, same, other = (search(judge, [begin], evaluations=8, seed=seed, jobs=1) for seed in (3, 3, 4))
    assert one == same
    assert [found.gains for found in other] != [found.gains for found in one]


class TwoValleys:
    """A judge that simulates nothing: the deeper valley is not where the better start is."""

    law = "linear"

    def judge(self, gains, bar=math.inf):
        phi, frequency = (math.log(gains[f"control.smc.{name}"] / 100.0) for name in ("phi", "natural_frequency"))
        shallow = (phi - 1.0) ** 2 + frequency**2
        deep = 4.0 * ((phi + 1.0) ** 2 + frequency**2) - 1.0
        return Judgement(min(shallow, deep), 0.0, 0.0, 0.0, 0.0)


def test_a_search_finds_a_deeper_valley_than_that_of_its_best_start():
    def gains(phi, frequency):
        return {"control.smc.phi": 100.0 * math.exp(phi), "control.smc.natural_frequency": 100.0 * math.exp(frequency)}

    begins, judge = [gains(1.2, 0.3), gains(-0.6, 0.4)], TwoValleys()
    assert judge.judge(begins[0]).cost < judge.judge(begins[1]).cost
    assert search(judge, begins[:1], evaluations=300, jobs=1)[0].judgement.cost == pytest.approx(0.0, abs=0.01)
    assert search(judge, begins, evaluations=300, jobs=1)[0].judgement.cost == pytest.approx(-1.0, abs=0.01)


def test_of_gains_whose_first_stroke_is_hopeless_nothing_else_is_run(shipped, judge, begin, law):
    first = prepared_stroke(shipped).run(law, judge.delay)
    known = judge.judge(begin)
    assert judge.judge(begin, bar=known.cost - 10.0).pp == pytest.approx(first.pp) != known.pp
    assert judge.judge(begin, bar=known.cost + 10.0) == known


def test_an_oscillation_is_what_a_verdict_calls_one(shipped, law):
    # Commands later than the loop bears.
    for samples, oscillates in ((1.0, False), (5.0, True)):
        stroke = prepared_stroke(shipped).run(law, samples * shipped.description.period)
        assert (stroke.oscillation > 1.0) == oscillates


def test_quiet_trades_error_for_the_work_of_the_coils(shipped, judge, begin):
    quiet = judge_of(shipped, "smc_observer", 1.0)
    slow, fast = (scaled("smc_observer", begin, factor) for factor in (0.8, 1.05))
    assert judge.judge(slow).work < judge.judge(fast).work
    gained = [one.judge(slow).cost - one.judge(fast).cost for one in (judge, quiet)]
    assert gained[1] < gained[0]


@pytest.mark.parametrize("law", LAWS)
def test_every_law_is_searched_and_a_search_never_ends_behind_its_start(shipped, law):
    judge, begin = judge_of(shipped, law, 0.5), closed_form(shipped, law)
    found = search(judge, [begin], evaluations=8, jobs=1)
    costs = [one.judgement.cost for one in found]
    assert math.isfinite(found[0].judgement.pp) and costs == sorted(costs)
    assert begin in [one.gains for one in found] and {gain.name for gain in SEARCHED[law]} <= set(begin)


@pytest.mark.parametrize("wrong", [{"law": "pid"}, {"quiet": 1.5}, {"quiet": math.nan}])
def test_a_wrong_argument_is_refused_with_what_is_allowed(shipped, wrong):
    with pytest.raises(ValueError, match="allowed: "):
        design_gains(shipped, **wrong)


def test_a_shortened_motion_lies_inside_the_stroke_and_is_as_short_as_was_asked_for(shipped):
    long = moving(shipped, MotionParameters(stroke=1.76, speed=0.3, acceleration=0.2))
    part = shortened(long, 6.0)
    places = [part.position(time) for time in range(0, part.end_ns, 10_000_000)]
    assert min(places) >= 0.0 and max(places) <= 1.76
    assert 4.0e9 < part.end_ns <= 6.1e9
    assert shortened(long, 60.0) is long.trajectory


def test_a_run_depends_on_start_and_machine_and_on_nothing_else(shipped, judge, law):
    stroke = prepared_stroke(shipped)
    heavy = dataclasses.replace(stroke.plant, platform=dataclasses.replace(stroke.plant.platform, mass=4.0))
    found = stroke.run(law, judge.delay)
    assert found == prepared_stroke(shipped).run(law, judge.delay)
    assert found.pp not in (stroke.run(law, judge.delay, 1).pp, stroke.run(law, judge.delay, plant=heavy).pp)


def test_the_extreme_machines_lie_at_the_ends_of_the_uncertainty(shipped):
    machines = extreme_machines(shipped)
    plant, ranges = shipped.driver.plant, shipped.description.uncertainty
    gains = [one.plant.actuator.current_stiffness / one.plant.platform.mass for one in machines]
    nominal = plant.actuator.current_stiffness / plant.platform.mass
    most = (1 + ranges.force) / (1 - ranges.mass) / (1 - ranges.air_gap) ** 2
    assert max(gains) == pytest.approx(most * nominal) and min(gains) < nominal
    assert {one.delay for one in machines} == {ranges.shortest_delay, 1.0, ranges.longest_delay}
    frictions = {round(one.plant.friction.coulomb / plant.friction.coulomb, 9) for one in machines}
    assert frictions == {0.5, 2.0}


def test_gains_that_are_unstable_are_not_simulated_and_cost_more_than_any_that_are(judge, begin):
    good, bad, worse = (judge.judge(scaled("smc_observer", begin, factor)) for factor in (1.0, 2.0, 4.0))
    assert good.cost < bad.cost < worse.cost
    assert math.isinf(bad.pp) and math.isfinite(good.pp)

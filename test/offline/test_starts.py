"""Figures over several starts: which starts, and what is reported of them."""

import re

import pytest

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.offline.starts import (
    PITCH,
    Spread,
    first_cycle,
    offsets,
    runs_of_starts,
    spread,
    spreads,
    values_of_starts,
)

SHORT = {"driver": {}, "controller": {}, "stage": {"motion.stroke": 0.03, "motion.settle": 0.3, "motion.pause": 0.1}}


def test_the_first_start_is_the_one_of_the_parameters_and_the_others_lie_around_it():
    assert offsets(5) == pytest.approx((0.0, PITCH, -PITCH, 2 * PITCH, -2 * PITCH))
    assert sum(offsets()) == pytest.approx(0.0) and len(set(offsets())) == 9
    values = {**SHORT, "driver": {"simulated.initial_y": 1e-6}}
    places = [one["driver"]["simulated.initial_y"] for one in values_of_starts(values, 3)]
    assert places == pytest.approx([1e-6, 1e-6 + PITCH, 1e-6 - PITCH])
    assert values["driver"] == {"simulated.initial_y": 1e-6}


def test_a_figure_is_the_median_with_least_and_greatest():
    assert spread([3.0, 1.0, 2.0]) == Spread(2.0, 1.0, 3.0)
    assert spread([3.0, 1.0, 2.0]).scaled(2.0) == Spread(4.0, 2.0, 6.0)
    # What a start lacks is left out, and so is a range within the last digit.
    assert spreads([{"a": 1.0, "b": None}, {"a": 3.0, "b": 1.0}]) == {"a": Spread(2.0, 1.0, 3.0)}
    assert Spread(0.449, 0.441, 0.468).text(2) == "0.45 (0.44 to 0.47)"
    assert Spread(0.0240, 0.0239, 0.0241).text(3) == "0.024"


def test_starts_differ_in_the_error_and_the_first_is_the_single_run():
    found = [evaluate(*run) for run in runs_of_starts(SHORT, 3)]
    assert found[0] == evaluate(*first_cycle(SHORT))
    assert len({metrics.true_pp for metrics in found}) == 3


def test_simulate_prints_median_and_range_of_the_starts(verb):
    words = ["simulate", "--starts", "3", *(f"--set=stage.{name}={value}" for name, value in SHORT["stage"].items())]
    printed = verb(*words, "--json").json
    starts = printed["starts"]
    assert starts["count"] == 3
    assert starts["true_pp_um"]["min"] <= printed["true_pp_um"] <= starts["true_pp_um"]["max"]
    # The verdict is that of the start with the largest error.
    said = re.match(r"start (\d) of 3: error ([\d.]+) µm p-p", printed["reason"])
    assert said and float(said[2]) == pytest.approx(starts["true_pp_um"]["max"], rel=0.01)
    errors = [evaluate(*run).true_pp for run in runs_of_starts(SHORT, 3)]
    assert errors[int(said[1]) - 1] == max(errors)
    assert " to " in verb(*words).out

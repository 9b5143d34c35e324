import dataclasses
import re

import numpy as np
import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.control.laws import LAWS, ControlParameters, ObserverDesign, make_law, stiffened
from straightcomp_ros.control.margins import (
    LEAST_GAINS,
    closed_loop,
    linearised,
    loop_margins,
    missing_margin,
    sampled_plant,
)
from straightcomp_ros.control.sliding_mode import SlidingDesign
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()


def on(**facts):
    return from_mapping(StageParameters, facts)


def value(sentence, pattern):
    found = re.search(pattern, sentence)
    assert found is not None, sentence
    return float(found.group(1))


@pytest.mark.parametrize("law", LAWS)
def test_every_law_has_its_margins_on_the_shipped_stage(law):
    assert missing_margin(ControlParameters(law=law), STAGE) is None


def test_the_refusal_names_parameters_stage_value_limit_and_remedy():
    told = missing_margin(ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=2e-3)), STAGE)
    for words in ("'control.smc.*'", "stage 'synthetic'", "2000 Hz", "law 'smc'", ">= 1.25", "straightcomp design"):
        assert words in told
    assert "\n" not in told


def test_the_gain_that_is_told_is_the_border_of_stability():
    control = ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=2e-3))
    told = value(missing_margin(control, STAGE), r"stable up to (\S+) times")
    assert told == pytest.approx(loop_margins(make_law(control, STAGE), STAGE).gain_high, abs=0.01)


def test_the_delay_that_is_told_is_the_longest_one():
    stage = on(rate=1000)
    control = ControlParameters()
    told = value(missing_margin(control, stage), r"up to (\S+) samples late")
    assert told == pytest.approx(loop_margins(make_law(control, stage), stage).longest_delay / stage.period, abs=0.01)


def test_a_stage_whose_delay_is_known_better_takes_gains_that_another_refuses():
    assert missing_margin(ControlParameters(), on(rate=1000)) is not None
    assert missing_margin(ControlParameters(), on(**{"rate": 1000, "uncertainty.longest_delay": 1.2})) is None


def test_too_weak_a_loop_is_refused_as_too_strong_a_one():
    weak = ControlParameters(smc_observer=ObserverDesign(gain_allowance=2.7))
    assert value(missing_margin(weak, STAGE), r"stable down to (\S+) times its loop gain") > LEAST_GAINS[0]


def test_a_law_that_is_stable_while_quiet_must_be_stable_at_its_stiffest_too():
    control = ControlParameters(smc_observer=ObserverDesign(stiffening=4.0))
    assert ", at its stiffest," in missing_margin(control, STAGE)
    plant, law = sampled_plant(STAGE, STAGE.period), linearised(make_law(stiffened(control), STAGE))
    assert max(np.abs(np.linalg.eigvals(closed_loop(plant, law, gain))).max() for gain in (0.9, 1.1)) >= 1.0
    assert missing_margin(dataclasses.replace(control, smc_observer=ObserverDesign(stiffening=1.0)), STAGE) is None


def test_little_phase_is_refused_where_the_gain_margins_hold(monkeypatch):
    assert missing_margin(ControlParameters(), STAGE) is None
    monkeypatch.setattr("straightcomp_ros.control.margins.LEAST_PHASE", 40.0)
    told = missing_margin(ControlParameters(), STAGE)
    assert value(told, r"phase margin of (\S+)°") == pytest.approx(
        loop_margins(make_law(ControlParameters(), STAGE), STAGE).phase, abs=1.0
    )


def test_a_law_that_switches_at_rest_has_no_linear_margins_to_miss():
    assert missing_margin(ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=0.0)), on(rate=1000)) is None


def test_a_simulation_warns_of_gains_that_the_graph_would_refuse(capsys):
    short = [f"--set=stage.motion.{name}" for name in ("stroke=0.02", "settle=0.1", "pause=0.1")]
    main(["simulate", "--json", "--set", "stage.rate=1000", *short])
    told = capsys.readouterr()
    assert (
        "warning: parameters 'control.smc_observer.*'" in told.err and "unless 'control.margins' is 'warn'" in told.err
    )
    assert "1.41 samples late" in told.out
    main(["simulate", "--json", *short])
    told = capsys.readouterr()
    assert "warning" not in told.err and '"missing_margin": null' in told.out

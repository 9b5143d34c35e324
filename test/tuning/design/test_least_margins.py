import re

import numpy as np
import pytest

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


@pytest.mark.parametrize(
    ("control", "stage"),
    [
        *((ControlParameters(law=law), {}) for law in LAWS),
        # Its delay is known better than that of the stage that is refused below.
        (ControlParameters(), {"rate": 1000, "uncertainty.longest_delay": 1.2}),
        # A law that switches at rest has no linear margins to miss.
        (ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=0.0)), {"rate": 1000}),
        (ControlParameters(smc_observer=ObserverDesign(stiffening=1.0)), {}),
    ],
)
def test_a_law_that_has_its_margins_is_taken(control, stage):
    assert missing_margin(control, on(**stage)) is None


SHARP = ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=2e-3))


def test_a_refusal_names_what_is_missed_and_the_gain_the_delay_or_the_phase_at_the_border_of_stability(monkeypatch):
    def refused(pattern, control=ControlParameters(), stage=STAGE):  # noqa: B008
        found = re.search(pattern, missing_margin(control, stage))
        return float(found.group(1)), loop_margins(make_law(control, stage), stage)

    sentence = missing_margin(SHARP, STAGE)
    for words in ("'control.smc.*'", "stage 'synthetic'", "2000 Hz", "law 'smc'", ">= 1.25", "straightcomp design"):
        assert words in sentence
    gain, margins = refused(r"stable up to (\S+) times", SHARP)
    assert gain == pytest.approx(margins.gain_high, abs=0.01)
    # Too weak a loop is refused as too strong a one.
    weak = ControlParameters(smc_observer=ObserverDesign(gain_allowance=2.7))
    assert refused(r"stable down to (\S+) times its loop gain", weak)[0] > LEAST_GAINS[0]
    slow = on(rate=1000)
    delay, margins = refused(r"up to (\S+) samples late", stage=slow)
    assert delay == pytest.approx(margins.longest_delay / slow.period, abs=0.01)
    # The gain margins hold.
    monkeypatch.setattr("straightcomp_ros.control.margins.LEAST_PHASE", 40.0)
    phase, margins = refused(r"phase margin of (\S+)°")
    assert phase == pytest.approx(margins.phase, abs=1.0)


def test_a_law_with_a_friction_model_must_be_stable_at_its_stiffest_too():
    linear, usual = ControlParameters(law="linear"), ControlParameters()
    assert stiffened(linear) == linear
    assert stiffened(usual).smc_observer.bandwidth == pytest.approx(1.4 * usual.smc_observer.bandwidth)
    control = ControlParameters(smc_observer=ObserverDesign(stiffening=4.0))
    assert ", at its stiffest," in missing_margin(control, STAGE)
    plant, law = sampled_plant(STAGE, STAGE.period), linearised(make_law(stiffened(control), STAGE))
    assert max(np.abs(np.linalg.eigvals(closed_loop(plant, law, gain))).max() for gain in (0.9, 1.1)) >= 1.0

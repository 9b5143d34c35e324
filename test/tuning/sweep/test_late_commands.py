"""Single late commands: in the compiled cycle, and in the script that prints what they cost."""

import numpy as np
import pytest

from scripts import late_commands as script
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.commissioning.acceptance import stalled

PERIOD = 500_000


@pytest.fixture
def shipped():
    values = shipped_parameters()
    values["stage"]["motion.stroke"] = 0.1
    values["stage"]["drive.delay"] = 1.0
    return values


def test_irregular_commands_leave_more_than_regular_ones_and_a_fixed_time_of_action_takes_that_away(shipped):
    def rms(delays):
        return evaluate(*run_stroke(shipped, delays)).to_display()["true_rms_um"]

    irregular = np.random.default_rng(2).integers(0, PERIOD, 8000)
    assert rms(np.maximum(irregular, PERIOD)) == rms(np.full(8000, PERIOD))
    assert rms(irregular) > 1.02 * rms(np.full(8000, PERIOD))
    assert script.typical_delays(PERIOD).max() < PERIOD


def test_what_a_stalled_host_has_to_answer_comes_when_the_stall_is_over():
    delays = stalled(2000, PERIOD, PERIOD, 2.0, range(1000, 2000, 157))
    arrivals = (np.arange(delays.size) * PERIOD + delays)[1000:1006] // PERIOD
    assert arrivals.tolist() == [1004, 1004, 1004, 1004, 1005, 1006]


def test_a_bag_that_is_not_there_ends_the_script_with_a_sentence(tmp_path, capsys):
    assert script.main(["--bag", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err

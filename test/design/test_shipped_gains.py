"""The shipped gains of 'smc_observer' are those of the closed form (`test_searched_gains.py`).

Those of 'linear' and 'smc' are the paper's, whose figures they are to repeat.
"""

import pytest

from straightcomp_ros.configuration.parameter_file import shipped_parameters
from straightcomp_ros.design.automatic_design import SHIPPED_QUIET, design_gains
from straightcomp_ros.offline.sweep.scenario import make_scenario
from straightcomp_ros.offline.sweep.starts import metrics_of_starts, spreads

LAW = "smc_observer"
BEHIND = 1.05
"""Part by which the shipped gains may be behind a design of the same quietness."""


@pytest.mark.soak
@pytest.mark.no_cover
def test_the_shipped_gains_leave_no_more_error_than_a_design_for_the_shipped_stage():
    shipped = shipped_parameters()
    design = design_gains(make_scenario(shipped, [LAW]), LAW, quiet=SHIPPED_QUIET, jobs=1)
    designed = {**shipped, "controller": {**shipped["controller"], **design.values}}
    ours, theirs = (spreads(one.to_display() for one in metrics_of_starts(values)) for values in (shipped, designed))
    for figure in ("true_pp_um", "true_rms_um"):
        assert ours[figure].median <= BEHIND * theirs[figure].median, figure
    assert design.verification.holds

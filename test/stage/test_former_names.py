import pytest
from straightcomp_ros.control.former_names import FORMER_OBSERVER, present_names


def test_names_of_earlier_versions_become_the_present_ones():
    former = {
        "control.law": "smc",
        "control.design.rho": 5.0,
        "control.observer.amplifier_bandwidth": 400.0,
    }
    present = {"control.law": "smc", "control.smc.rho": 5.0, "control.nominal.amplifier_bandwidth": 400.0}
    assert present_names(former) == present


@pytest.mark.parametrize("group", ["control.observer", "control.smc_observer"])
def test_the_parameters_of_the_law_without_friction_never_reach_the_law_that_has_its_name_now(group):
    former = {"control.law": "smc_observer", f"{group}.bandwidth": 545.0, f"{group}.rho": 5.0, "rate": 2000.0}
    assert present_names(former) == {"control.law": FORMER_OBSERVER, "rate": 2000.0}
    assert present_names({**former, "control.law": "smc"}) == {"control.law": "smc", "rate": 2000.0}
    assert present_names({"control.smc_observer.bandwidth": 205.0}) == {"control.smc_observer.bandwidth": 205.0}


def test_parameters_of_a_law_that_is_gone_are_left_out():
    assert present_names({"control.law": "smc", "control.super_twisting.surface": 500.0}) == {"control.law": "smc"}

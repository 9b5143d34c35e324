import pytest

from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.stage.former_names import _FORMER, FORMER_OBSERVER, present_names


def test_names_of_earlier_versions_become_the_present_ones():
    former = {
        "control.law": "smc",
        "control.design.rho": 5.0,
        "control.observer.amplifier_bandwidth": 400.0,
    }
    present = {"control.law": "smc", "control.smc.rho": 5.0, "stage.drive.bandwidth": 400.0}
    assert present_names("controller", former) == present


@pytest.mark.parametrize("node", _FORMER)
def test_a_former_name_is_gone_and_leads_to_one_that_exists(node):
    names = [declaration.name for declaration in declarations(NODE_PARAMETERS[node])]
    for former, present in _FORMER[node].items():
        if former.endswith("."):
            assert any(name.startswith(present) for name in names), former
            assert not any(name.startswith(former) for name in names), former
        else:
            assert present in names and former not in names


@pytest.mark.parametrize(
    ("node", "former", "present"),
    [
        ("driver", {"simulated.plant.mass": 3.4, "simulated.hold_stiffness": 7000.0}, {"stage.platform.mass": 3.4}),
        (
            "driver",
            {"simulated.plant.encoder.resolution": 2e-7},
            {"stage.encoder.x_resolution": 2e-7, "stage.encoder.y_resolution": 2e-7},
        ),
        (
            "driver",
            {"simulated.plant.friction.step.factor": 2.0, "simulated.plant.friction.static": 0.5},
            {"simulated.truth.contact.step.factor": 2.0, "stage.friction.static": 0.5},
        ),
        (
            "driver",
            {"guide.file": "a.csv", "guide.travel": 5e-5},
            {"simulated.truth.guide": "a.csv", "stage.guide.travel": 5e-5},
        ),
        ("feedforward", {"map.file": "a.csv"}, {"stage.guide.file": "a.csv"}),
        ("cell", {"motion.stroke": 0.5}, {"stage.motion.stroke": 0.5}),
        ("logger", {"rate": 1}, {"rate": 1}),
    ],
)
def test_what_a_node_knew_of_the_machine_is_found_in_the_description(node, former, present):
    assert present_names(node, former) == present
    assert present_names(node, present) == present


@pytest.mark.parametrize(
    ("node", "former", "present"),
    [
        ("driver", {"simulated.rate": 1000, "can.rate": 2000}, {"stage.rate": 1000}),
        (
            "driver",
            {"hardware": "can", "simulated.rate": 1000, "can.rate": 2000},
            {"hardware": "can", "stage.rate": 2000},
        ),
        ("driver", {"lockstep_delay": 0.5, "simulated.actuation_delay": 1.0}, {"stage.drive.delay": 1.0}),
        (
            "driver",
            {"lockstep": True, "lockstep_delay": 0.5, "simulated.actuation_delay": 1.0},
            {"lockstep": True, "stage.drive.delay": 0.5},
        ),
        ("driver", {"can.x_speed": 3.0, "watch.max_speed": 2.0}, {"stage.motion.highest_speed": 2.0}),
        (
            "controller",
            {"control.nominal.friction": 0.7, "control.smc_observer.lugre.static": 0.6},
            {"stage.friction.static": 0.6},
        ),
        ("controller", {"control.nominal.friction": 0.1}, {}),
        ("cell", {"motion.speed": 1.5}, {"stage.motion.speed": 1.5, "stage.motion.highest_speed": 3.0}),
        (
            "feedforward",
            {"feedforward.max_speed": 0.2},
            {"stage.motion.speed": 0.1, "stage.motion.highest_speed": 0.2},
        ),
        ("controller", {"rate": 1000, "stage.rate": 2000}, {"stage.rate": 2000}),
    ],
)
def test_of_two_former_names_for_one_fact_the_one_that_counted_is_taken(node, former, present):
    assert present_names(node, former) == present
    assert present_names(node, dict(reversed(former.items()))) == present


@pytest.mark.parametrize("group", ["control.observer", "control.smc_observer"])
def test_the_parameters_of_the_law_without_friction_never_reach_the_law_that_has_its_name_now(group):
    former = {"control.law": "smc_observer", f"{group}.bandwidth": 545.0, f"{group}.rho": 5.0, "rate": 2000.0}
    assert present_names("controller", former) == {"control.law": FORMER_OBSERVER, "stage.rate": 2000.0}
    assert present_names("controller", {**former, "control.law": "smc"}) == {"control.law": "smc", "stage.rate": 2000.0}
    assert present_names("controller", {"control.smc_observer.bandwidth": 205.0}) == {
        "control.smc_observer.bandwidth": 205.0
    }


def test_parameters_of_a_law_that_is_gone_are_left_out():
    assert present_names("controller", {"control.law": "smc", "control.super_twisting.surface": 500.0}) == {
        "control.law": "smc"
    }


@pytest.mark.parametrize("former", [{"rate": 4000}, {"stage.rate": 4000}])
def test_what_was_a_number_of_samples_is_a_time(former):
    present = present_names("controller", {**former, "reference_lead": 12})
    assert present == {"stage.rate": 4000, "reference_lead": 0.003}
    assert present_names("controller", {"reference_lead": 0.002}) == {"reference_lead": 0.002}
    assert present_names("driver", {"simulated.sample_memory": 256}) == {"simulated.sample_memory": 0.128}

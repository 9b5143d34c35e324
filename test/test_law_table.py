"""The figures of laws in docs/accuracy.md and those of opensmc, which only the extra `test` installs: arithmetic, and
what their scripts refuse."""

import re

import pytest
from places import page

from benchmarks import peer_opensmc as peer
from scripts.law_table import figures_of, law_of
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.parameter_file import shipped_parameters

SHORT = {
    "driver": {"simulated.truth.guide": "config/guide_synthetic.csv"},
    "controller": {},
    "stage": {"motion.stroke": 0.03, "motion.settle": 0.1, "motion.pause": 0.1, "drive.delay": 0.5},
}


def test_the_law_with_sgn_works_the_coils_harder_and_a_law_that_is_handed_in_is_the_one_that_runs():
    smooth = with_values(SHORT, "controller", {"control.law": "smc"})
    sgn = with_values(smooth, "controller", {"control.smc.boundary_layer": 0.0})
    figures = figures_of(sgn, starts=2)
    assert figures["control_activity_A"]["min"] > 2.0 * figures_of(smooth, starts=1)["control_activity_A"]["max"]
    assert figures["step_us"] > 0.0
    handed_in = figures_of(smooth, law_of(sgn), starts=2)
    assert handed_in | {"step_us": 0.0} == figures | {"step_us": 0.0}
    assert SHORT["controller"] == {}


@pytest.mark.nightly
def test_every_machine_can_be_set_and_the_peer_holds_the_platform_on_the_reference():
    for node, changes in peer.MACHINES.values():
        figures_of(with_values(SHORT, node, changes), starts=1)
    settled = with_values(SHORT, "stage", {"motion.settle": 0.3})
    for name in ("opensmc, ESO", "opensmc, Levant"):
        found = figures_of(settled, peer.peer_law(name, peer.DESIGNS[name], settled), starts=2)
        assert 0.0 < found["pp_um"]["min"] < found["pp_um"]["max"] < 1.0


@pytest.mark.nightly
def test_the_published_figure_of_the_peer_is_what_the_benchmark_finds():
    """From one of the nine starts."""
    text = page("evidence/accuracy")
    published = re.search(r"gains searched: [\d.]+ \(([\d.]+) to ([\d.]+)\) µm with its extended state observer", text)
    shipped = with_values(shipped_parameters(), *peer.MACHINES["nominal"])
    name = "opensmc, ESO"
    found = figures_of(shipped, peer.peer_law(name, peer.DESIGNS[name], shipped), starts=1)["pp_um"]["median"]
    assert float(published[1]) - 0.03 < found < float(published[2]) + 0.03

"""The comparison with opensmc, which only the extra `test` installs."""

import re
import sys
from pathlib import Path

import pytest

from benchmarks import peer_opensmc as script
from scripts.law_figures import LawFigures, figures_of
from straightcomp_ros.offline.starts import spread, with_values
from straightcomp_ros.parameters.parameter_file import shipped_parameters

SHORT = {
    "driver": {"simulated.truth.guide": "config/guide_synthetic.csv"},
    "controller": {},
    "stage": {"motion.stroke": 0.03, "motion.settle": 0.3, "motion.pause": 0.1, "drive.delay": 0.5},
}


def test_without_the_peer_one_sentence_says_how_to_install_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "opensmc", None)
    assert script.main([]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert "pip install opensmc" in said.err


def test_rows_give_each_machine_in_micrometres():
    by_machine = {name: figures(k * 1e-6) for k, name in enumerate(script.MACHINES, 1)}
    (row,) = script.to_display({"smc": by_machine})
    assert [one["median"] for one in row["pp_um"].values()] == pytest.approx([1.0, 2.0, 3.0])
    assert (row["control_rms_step_mA"]["max"], row["step_us"]) == pytest.approx((5.0, 4.0))


def figures(pp: float) -> LawFigures:
    return LawFigures(spread([pp]), spread([1e-7]), spread([80.0]), spread([5e-3]), 4e-6)


def test_every_machine_is_one_that_can_be_set():
    for node, changes in script.MACHINES.values():
        figures_of(with_values(SHORT, node, changes), starts=1)


@pytest.mark.parametrize("name", ["opensmc, ESO", "opensmc, Levant"])
def test_the_peer_holds_the_platform_on_the_reference(name):
    found = figures_of(SHORT, script.peer_law(name, script.DESIGNS[name], SHORT), starts=2)
    assert 0.0 < found.pp.min < found.pp.max < 1e-6


def test_the_published_figure_of_the_peer_is_what_the_benchmark_finds():
    """From one of the nine starts."""
    page = (Path(__file__).resolve().parents[1] / "docs" / "accuracy.md").read_text(encoding="utf-8")
    published = re.search(r"gains searched: [\d.]+ \(([\d.]+) to ([\d.]+)\) µm with its extended state observer", page)
    shipped = with_values(shipped_parameters(), *script.MACHINES["nominal"])
    name = "opensmc, ESO"
    found = figures_of(shipped, script.peer_law(name, script.DESIGNS[name], shipped), starts=1).pp.median * 1e6
    assert float(published[1]) - 0.03 < found < float(published[2]) + 0.03

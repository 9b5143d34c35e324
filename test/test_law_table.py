"""The figures of laws in docs/accuracy.md and those of opensmc, which only the extra `test` installs: arithmetic, and
what their scripts refuse."""

import json
import re
import sys
from pathlib import Path

import pytest

from benchmarks import peer_opensmc as peer
from scripts import law_table as script
from scripts.law_figures import LawFigures, figures_of, law_of
from straightcomp_ros.offline.starts import Spread, spread, with_values
from straightcomp_ros.parameters.parameter_file import shipped_parameters

SHORT = {
    "driver": {"simulated.truth.guide": "config/guide_synthetic.csv"},
    "controller": {},
    "stage": {"motion.stroke": 0.03, "motion.settle": 0.1, "motion.pause": 0.1, "drive.delay": 0.5},
}


def figures(pp):
    around = Spread(pp, 0.9 * pp, 1.1 * pp)
    return LawFigures(around, Spread(5e-8, 4.99e-8, 5.01e-8), spread([50.0]), spread([0.004]), step_time=2e-6)


def test_rows_have_the_readers_units_and_markdown_shows_median_and_range_in_as_many_cells_in_every_line():
    row = script.row("smc", figures(0.5e-6))
    assert row["pp_um"] == pytest.approx({"median": 0.5, "min": 0.45, "max": 0.55})
    assert (row["control_rms_step_mA"]["median"], row["step_us"]) == pytest.approx((4.0, 2.0))
    margins = {"gain_low": 0.22, "gain_high": 3.0, "phase_deg": 15.2, "longest_delay_samples": 1.5}
    swept = {"robust_pp_um": {"p50": 0.4, "p95": 0.7, "max": 1.1}, "not_in_order": 3}
    laws = [{**row, **swept, **margins}, script.row("sgn", figures(0.5e-6))]
    table, below = script.markdown(laws).split("\n\n")
    head, rule, first, second = table.splitlines()
    assert len({line.count("|") for line in (head, rule, first, second)}) == 1
    assert "| 0.40 | 0.50 (0.45 to 0.55) | 0.050 | 4.0 | 0.40 / 0.70 / 1.10 | 3 | 2.0 |" in first
    assert second.endswith("|  |  | 2.0 |")
    assert below.splitlines()[-1].endswith("| 0.22 | 3.00 | 15 | 1.50 |")
    (row,) = peer.to_display({"smc": {name: figures(k * 1e-6) for k, name in enumerate(peer.MACHINES, 1)}})
    assert [one["median"] for one in row["pp_um"].values()] == pytest.approx([1.0, 2.0, 3.0])
    assert (row["control_rms_step_mA"]["max"], row["step_us"]) == pytest.approx((4.0, 2.0))


def test_figures_of_a_sweep_are_taken_from_its_file(tmp_path):
    spread = {"p50": 0.4, "p95": 0.7, "max": 1.1}
    sweep = {"laws": {"smc": {"pp_um": {"p5": 0.1, **spread}, "not_in_order": 3}}}
    (tmp_path / "sweep.json").write_text(json.dumps(sweep))
    taken = script.read_robustness(tmp_path / "sweep.json")
    assert taken == {"smc": {"robust_pp_um": spread, "not_in_order": 3}}


@pytest.mark.parametrize("text", ["", "[]", '{"laws": {"smc": {}}}', '{"laws": []}', None])
def test_another_file_is_refused_in_one_sentence_that_names_it(tmp_path, capsys, text):
    path = tmp_path / "other.json"
    if text is not None:
        path.write_text(text)
    assert script.main(["--robustness", str(path)]) == 2
    said = capsys.readouterr().err
    assert "other.json" in said and said.count("\n") == 1


def test_the_law_with_sgn_works_the_coils_harder_and_a_law_that_is_handed_in_is_the_one_that_runs():
    smooth = with_values(SHORT, "controller", {"control.law": "smc"})
    sgn = with_values(smooth, "controller", {"control.smc.boundary_layer": 0.0})
    figures = figures_of(sgn, starts=2)
    assert figures.control_activity.min > 2.0 * figures_of(smooth, starts=1).control_activity.max
    assert figures.step_time > 0.0
    handed_in = figures_of(smooth, law_of(sgn), starts=2)
    assert (handed_in.pp, handed_in.control_activity) == (figures.pp, figures.control_activity)
    assert SHORT["controller"] == {}


def test_margins_are_given_of_laws_that_have_them_only():
    margins = script.margins_of(with_values(SHORT, "controller", {"control.law": "linear"}))
    assert 0.0 < margins["gain_low"] < 1.0 < margins["gain_high"]
    assert margins["longest_delay_samples"] > 0.5
    none = script.margins_of(
        with_values(SHORT, "controller", {"control.law": "smc", "control.smc.boundary_layer": 0.0})
    )
    assert set(none) == set(margins) and not any(none.values())


def test_without_the_peer_one_sentence_says_how_to_install_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "opensmc", None)
    assert peer.main([]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and "pip install opensmc" in said.err


@pytest.mark.nightly
def test_every_machine_can_be_set_and_the_peer_holds_the_platform_on_the_reference():
    for node, changes in peer.MACHINES.values():
        figures_of(with_values(SHORT, node, changes), starts=1)
    settled = with_values(SHORT, "stage", {"motion.settle": 0.3})
    for name in ("opensmc, ESO", "opensmc, Levant"):
        found = figures_of(settled, peer.peer_law(name, peer.DESIGNS[name], settled), starts=2)
        assert 0.0 < found.pp.min < found.pp.max < 1e-6


@pytest.mark.nightly
def test_the_published_figure_of_the_peer_is_what_the_benchmark_finds():
    """From one of the nine starts."""
    page = (Path(__file__).resolve().parents[1] / "docs" / "evidence" / "accuracy.md").read_text(encoding="utf-8")
    published = re.search(r"gains searched: [\d.]+ \(([\d.]+) to ([\d.]+)\) µm with its extended state observer", page)
    shipped = with_values(shipped_parameters(), *peer.MACHINES["nominal"])
    name = "opensmc, ESO"
    found = figures_of(shipped, peer.peer_law(name, peer.DESIGNS[name], shipped), starts=1).pp.median * 1e6
    assert float(published[1]) - 0.03 < found < float(published[2]) + 0.03

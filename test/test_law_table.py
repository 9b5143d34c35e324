"""The README's table of laws: its arithmetic, and what it refuses."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

from straightcomp_ros.comparison import LawFigures, figures_of, law_of, with_values

SHORT = {"controller": {}, "cell": {"motion.stroke": 0.03, "motion.settle": 0.1, "motion.pause": 0.1}}
SGN = LawFigures(pp=1e-6, rms=4e-7, control_activity=200.0, control_rms_step=0.08, step_time=3e-6)
LAW = LawFigures(pp=0.5e-6, rms=5e-8, control_activity=50.0, control_rms_step=0.004, step_time=2e-6)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "scripts" / "law_table.py"
    spec = importlib.util.spec_from_file_location("law_table", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_row_has_the_readers_units_and_the_parts_of_the_law_with_sgn(script):
    row = script.row("smc", LAW, SGN)
    assert (row["pp_um"], row["rms_um"], row["control_rms_step_mA"]) == pytest.approx((0.5, 0.05, 4.0))
    assert (row["control_rms_step_relative"], row["control_activity_relative"]) == pytest.approx((0.05, 0.25))
    assert script.row("sgn", SGN, SGN)["control_activity_relative"] == pytest.approx(1.0)


def test_markdown_leaves_out_what_nobody_knows_and_has_as_many_cells_in_every_line(script):
    rows = [{**script.row("smc", LAW, SGN), "gain_low": 0.22, "phase_deg": None}, script.row("sgn", SGN, SGN)]
    head, rule, first, second = script.markdown(rows).replace("\\|", "").splitlines()
    assert "gain from" in head and "phase" not in head and "p95" not in head
    assert len({line.count("|") for line in (head, rule, first, second)}) == 1
    assert first.startswith("| smc | 0.50 | 0.050 | 4.0 | 0.05 |") and "| 0.22 |" in first
    assert second.endswith("|  |")


def test_figures_of_a_sweep_are_taken_from_its_file(script, tmp_path):
    told = {"laws": {"smc": {"pp_um": {"p95": 0.7, "max": 1.1}, "limit_cycles": 3}}}
    (tmp_path / "sweep.json").write_text(json.dumps(told))
    taken = script.read_robustness(tmp_path / "sweep.json")
    assert taken == {"smc": {"robust_pp_p95_um": 0.7, "robust_pp_worst_um": 1.1, "limit_cycles": 3}}


@pytest.mark.parametrize("text", ["", "[]", '{"laws": {"smc": {}}}', '{"laws": []}', None])
def test_another_file_is_refused_in_one_sentence_that_names_it(script, tmp_path, capsys, text):
    path = tmp_path / "other.json"
    if text is not None:
        path.write_text(text)
    assert script.main(["--robustness", str(path)]) == 2
    said = capsys.readouterr().err
    assert "other.json" in said and said.count("\n") == 1


def test_the_law_with_sgn_works_the_coils_harder_and_a_law_that_is_handed_in_is_the_one_that_runs():
    smooth = with_values(SHORT, "controller", {"control.law": "smc"})
    sgn = with_values(smooth, "controller", {"control.design.boundary_layer": 0.0})
    figures = figures_of(sgn)
    assert figures.control_activity > 2.0 * figures_of(smooth).control_activity
    assert figures.step_time > 0.0
    handed_in = figures_of(smooth, law_of(sgn))
    assert (handed_in.pp, handed_in.control_activity) == (figures.pp, figures.control_activity)
    assert SHORT["controller"] == {}


def test_margins_are_told_of_laws_that_have_them_only(script):
    margins = script.margins_of(with_values(SHORT, "controller", {"control.law": "linear"}))
    assert 0.0 < margins["gain_low"] < 1.0 < margins["gain_high"]
    assert margins["longest_delay_samples"] > 0.5
    none = script.margins_of(with_values(SHORT, "controller", {"control.law": "super_twisting"}))
    assert set(none) == set(margins) and not any(none.values())

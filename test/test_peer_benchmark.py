"""The comparison with opensmc, which is no dependency: it says how to get it, and runs where it is there."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from straightcomp_ros.comparison import LawFigures, figures_of, with_values

SHORT = {"driver": {}, "controller": {}, "cell": {"motion.stroke": 0.03, "motion.settle": 0.3, "motion.pause": 0.1}}


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "peer_opensmc.py"
    spec = importlib.util.spec_from_file_location("peer_opensmc", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_without_the_peer_one_sentence_says_how_to_install_it(script, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "opensmc", None)
    assert script.main([]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert "pip install opensmc" in said.err


def test_rows_tell_each_machine_in_micrometres(script):
    found = {"smc": {name: LawFigures(k * 1e-6, 1e-7, 80.0, 5e-3, 4e-6) for k, name in enumerate(script.MACHINES, 1)}}
    (row,) = script.to_display(found)
    assert (row["pp_um"], row["control_rms_step_mA"], row["step_us"]) == pytest.approx((1.0, 5.0, 4.0))
    assert list(row["pp_um_elsewhere"].values()) == pytest.approx([2.0, 3.0])


def test_every_machine_is_one_that_can_be_set(script):
    for node, changes in script.MACHINES.values():
        figures_of(with_values(SHORT, node, changes))


@pytest.mark.parametrize("name", ["opensmc, ESO", "opensmc, Levant"])
def test_the_peer_holds_the_platform_on_the_reference(script, name):
    pytest.importorskip("opensmc", reason="NOT TESTED: the peer's laws. Remedy: pip install -e '.[test]'")
    figures = figures_of(SHORT, script.peer_law(name, script.DESIGNS[name], SHORT))
    assert 0.0 < figures.pp < 1e-6

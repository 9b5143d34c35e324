"""The examples work as they stand, and are short."""

import importlib.util

import pytest
from places import BAGS, REPOSITORY

EXAMPLES = REPOSITORY / "examples"


def loaded(name):
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_the_example_of_a_bag_prints_its_verdict_and_says_by_its_exit_code_whether_the_run_is_in_order(capsys):
    assert loaded("evaluate_bag").main(str(BAGS / "smc")) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("verdict: in order") and "encoder_pp_um: 0.18" in printed
    with pytest.warns(UserWarning, match="was not finished"):
        assert loaded("evaluate_bag").main(str(BAGS / "cut_off")) == 1
    assert loaded("evaluate_bag").main("no_bag") == 2 and "no_bag" in capsys.readouterr().err


@pytest.mark.no_cover
def test_the_example_of_a_simulation_prints_a_line_for_each_mass(capsys):
    assert loaded("simulate_stage").main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["mass 1.0", "mass 1.2"]
    assert all("in_order" in line for line in lines)


def test_the_example_of_a_client_can_be_imported_and_no_example_is_longer_than_60_lines():
    assert issubclass(loaded("stroke_client").StrokeClient, pytest.importorskip("rclpy.node").Node)
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in EXAMPLES.glob("*.py")}
    assert len(lengths) == 3 and max(lengths.values()) <= 60, lengths

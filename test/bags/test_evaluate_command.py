"""`straightcomp evaluate` on finished, unfinished and damaged bags."""

import contextlib
import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from straightcomp_ros.analysis.evaluation import evaluate_bag, percentile_us
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.main import main
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node

CYCLE = {"motion.stroke": 0.05, "motion.settle": 0.1, "motion.pause": 0.1}
OPTIONS = [word for name, value in CYCLE.items() for word in ("--set", f"stage.{name}={value}")]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """The bag of a simulated run; its printed figures are in figures.json."""
    folder = tmp_path_factory.mktemp("bags")
    with (folder / "figures.json").open("w") as file, contextlib.redirect_stdout(file):
        assert main(["simulate", "--bag", str(folder / "run"), "--json", *OPTIONS]) == 0
    return folder / "run"


def figures(capsys, *arguments) -> dict:
    assert main(["evaluate", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_its_figures_are_those_of_the_simulation_which_writing_a_bag_does_not_change(bag, capsys):
    assert main(["simulate", "--json", *OPTIONS]) == 0
    simulated = json.loads(capsys.readouterr().out)
    assert json.loads(bag.with_name("figures.json").read_text()) == simulated
    evaluated = figures(capsys, bag)
    for name in simulated.keys() & evaluated.keys() - {"law", "samples"}:
        assert evaluated[name] == pytest.approx(simulated[name], abs=1e-6), name
    assert evaluated["law"] == simulated["law"] == ControlParameters().law
    assert [stroke["direction"] for stroke in evaluated["strokes"]] == ["forward", "backward"]


def test_a_limit_that_is_not_kept_fails_the_command_with_its_name(bag, tmp_path, capsys):
    limits = tmp_path / "limits.yaml"
    limits.write_text("lost_samples: 0\ntrue_pp_um: 1e-6\n")
    assert main(["evaluate", str(bag), "--limits", str(limits)]) == 1
    assert "true_pp_um is" in capsys.readouterr().err
    for text, code in (("lost_samples: 0\n", 0), ("lost_sample: 0\n", 2)):
        limits.write_text(text)
        assert main(["evaluate", str(bag), "--limits", str(limits)]) == code


def test_a_topic_under_another_name_is_found_by_remap(bag, capsys):
    assert figures(capsys, bag, "--remap", "encoder:=/encoder")["lost_samples"] == 0
    assert main(["evaluate", str(bag), "--remap", "encoder:=/machine/axes"]) == 1
    assert "has no topic '/machine/axes' for 'encoder'; it has /command" in capsys.readouterr().err
    assert main(["evaluate", str(bag), "--remap", "encoder=/axes"]) == 2


def test_two_bags_are_put_side_by_side(bag, capsys):
    found = figures(capsys, bag, "--compare", bag)
    assert found["compared_with"]["true_pp_um"] == found["true_pp_um"]


def test_a_comparison_with_an_uncompensated_run_says_which_figures_compare(capsys):
    bags = Path(__file__).resolve().parents[2] / "bags"
    assert main(["evaluate", str(bags / "smc"), "--compare", str(bags / "uncompensated")]) == 0
    assert "uncompensated is uncompensated: its error is that of a platform at rest" in capsys.readouterr().err


def test_nothing_heavy_is_imported():
    program = (
        "import sys; from straightcomp_ros.cli.main import main\n"
        "try: main(['evaluate', '/nowhere'])\n"
        "finally: print(sorted({'scipy', 'numba', 'matplotlib', 'plotly', 'rosbags'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]" and "does not exist" in done.stderr


def test_no_file_however_bad_ends_in_a_traceback(bag, tmp_path, capsys):
    content = (bag / "run_0.mcap").read_bytes()
    source = random.Random(2)
    path = tmp_path / "bad.mcap"
    noise = [source.randbytes(3000), b"", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + source.randbytes(3000)]
    for _ in range(25):
        changed = bytearray(content[: source.choice([len(content), source.randrange(len(content))])])
        for _ in range(source.randrange(1, 20)):
            changed[source.randrange(len(changed))] = source.randrange(256)
        noise.append(bytes(changed))
    for bad in noise:
        path.write_bytes(bad)
        code = main(["evaluate", str(path), "--json"])
        found = capsys.readouterr()
        if code:
            assert code in (1, 2) and "evaluate: " in found.err
            assert not found.out or json.loads(found.out)["verdict"] in ("interrupted", "clock_jumped")
        else:
            assert found.err.count("was not finished") == 1 or json.loads(found.out)["lost_samples"] == 0


VALUES = {"controller": {"control.law": "linear"}, "stage": {**CYCLE, "drive.delay": 0.5}}


def test_the_bag_of_a_simulated_run_evaluates_to_the_same_record(tmp_path: Path) -> None:
    simulation = Simulation(VALUES)
    with SimulatedRun(tmp_path / "bag", by_node(VALUES), simulation.delay) as run:
        record = simulation.run(observe=run.add)
    evaluation = evaluate_bag(tmp_path / "bag")
    assert evaluation.record.law == "linear"
    for name, column in record.columns().items():
        np.testing.assert_allclose(evaluation.record.columns()[name], column, rtol=0, atol=1e-12, err_msg=name)
    assert (evaluation.lost_samples, evaluation.lost_commands) == (0, 0)
    assert percentile_us(evaluation.latency, 50) == pytest.approx(250.0)

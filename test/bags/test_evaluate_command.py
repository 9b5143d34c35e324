"""`straightcomp evaluate` on finished, unfinished and damaged bags."""

import contextlib
import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.control.laws import ControlParameters

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
    assert (evaluated["lost_samples"], evaluated["lost_commands"]) == (0, 0)
    assert evaluated["latency_p50_us"] == pytest.approx(5e5 * simulated["delay_samples"] / 1e3)


def test_a_topic_under_another_name_is_found_by_remap(bag, capsys):
    assert figures(capsys, bag, "--remap", "encoder:=/encoder")["lost_samples"] == 0
    assert main(["evaluate", str(bag), "--remap", "encoder:=/machine/axes"]) == 1
    assert "has no topic '/machine/axes' for 'encoder'; it has /command" in capsys.readouterr().err
    assert main(["evaluate", str(bag), "--remap", "encoder=/axes"]) == 2


def test_two_bags_are_put_side_by_side_and_it_is_said_if_one_of_them_is_uncompensated(bag, capsys):
    found = figures(capsys, bag, "--compare", bag)
    assert found["compared_with"]["true_pp_um"] == found["true_pp_um"]
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

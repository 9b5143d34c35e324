"""Runs of the graph replace nothing but what the tool made, and reach no machine."""

import json
import shutil
from pathlib import Path

import pytest

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.main import main
from straightcomp_ros.contract import COMMAND
from straightcomp_ros.offline.graph_replay import replay_through_graph
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS

SMC = Path(__file__).resolve().parents[2] / "bags" / "smc"
SHORT = ["--set", "stage.motion.stroke=0.02", "--lockstep", "--json"]
TEXTS = {"stage.name", "stage.guide.file", "realtime.cpus", "learning.file"}
"""Parameters of the played nodes that are free texts: of them only learning.file names a file that a node writes."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SMC, "out/bag")
    return tmp_path


def content():
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "line",
    [
        "replay out/bag --graph -o out --force",
        "replay out/bag/smc_0.mcap --graph -o out --force",
        "replay out/bag --graph -o out",
        "demo -o out",
        "demo -o out --params-file out/parameters.yaml --force",
        "demo -o out/..",
    ],
)
def test_a_run_removes_neither_its_input_nor_what_the_tool_did_not_make(folder, line):
    Path("out/parameters.yaml").write_text("/**/cell:\n  ros__parameters:\n    strokes: 1\n")
    Path("run.png").write_text("mine")
    before = content()
    assert main(line.split()) == 2
    assert content() == before


def test_a_node_of_a_replay_has_no_other_parameter_that_names_a_file():
    for node in ("feedforward", "controller"):
        found = {one.name for one in declarations(NODE_PARAMETERS[node]) if one.kind is str and not one.choices}
        assert found <= TEXTS, node


@pytest.mark.nightly
@pytest.mark.live
def test_a_replay_leaves_the_table_that_the_machine_has_learned(tmp_path, short_cycle, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short_cycle["controller"].update({"learning.learn": True, "learning.file": str(tmp_path / "learned.csv")})
    simulation = Simulation(short_cycle)
    with SimulatedRun(tmp_path / "run", short_cycle, simulation.delay) as run:
        simulation.run(observe=run.add)
    simulation.save_learning()
    before = content()
    assert "learned.csv" in before
    found = replay_through_graph(tmp_path / "run", tmp_path / "replay")
    assert found.commands > 0 and {name: data for name, data in content().items() if name in before} == before
    assert {Path(name).parts[0] for name in content().keys() - before.keys()} == {"replay"}
    # Not where a driver listens.
    assert read_streams(found.bag, {"/replay/command": COMMAND.layout})
    assert not read_streams(found.bag, {"/command": COMMAND.layout})


@pytest.mark.nightly
@pytest.mark.live
def test_a_demonstration_is_run_twice_without_an_option(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["demo", *SHORT]) in (0, 1)
        assert json.loads(capsys.readouterr().out)["bag"] == "demo_output/bag"
    made = {path.name for path in Path("demo_output").glob("[!.]*")}
    assert made == {"bag", "logs", "parameters.yaml", "run.png"}

"""Bags of simulated runs, on plants that differ from the one at which the search starts."""

import contextlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from plants import FAR, SAFE, SHORT, SOFT, STIFF

from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.main import main
from straightcomp_ros.configuration.node_parameters import by_node
from straightcomp_ros.contract import STROKE
from straightcomp_ros.identification.excitation import excitation_survey
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.straightness.survey import write_survey


def values(plant: Mapping[str, float], law: str = "linear", **stage: str) -> dict[str, dict[str, Any]]:
    """Parameters for a short run on a machine with this plant, of which the law knows nothing."""
    return {
        "driver": {f"stage.{name}": value for name, value in plant.items()},
        "feedforward": {},
        "controller": {"control.law": law},
        "cell": {},
        "stage": {"drive.delay": 0.5, **SHORT, **{name.replace("_", "."): value for name, value in stage.items()}},
    }


def record(bag: Path, parameters: Mapping[str, Mapping[str, Any]]) -> Path:
    """Simulate, and write the bag."""
    simulation = Simulation(parameters)
    with SimulatedRun(bag, by_node(parameters), simulation.delay) as run:
        simulation.run(observe=run.add)
    return bag


@pytest.fixture(scope="session")
def excitation(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("excitation") / "excitation.csv"
    write_survey(path, excitation_survey(STROKE))
    return str(path)


@pytest.fixture(scope="session")
def stiff_bag(tmp_path_factory: pytest.TempPathFactory, excitation: str) -> Path:
    return record(tmp_path_factory.mktemp("stiff") / "bag", values(STIFF, guide_file=excitation))


@pytest.fixture(scope="session")
def soft_bag(tmp_path_factory: pytest.TempPathFactory, excitation: str) -> Path:
    return record(tmp_path_factory.mktemp("soft") / "bag", values(SOFT, law="smc", guide_file=excitation))


@pytest.fixture(scope="session")
def far_bag(tmp_path_factory: pytest.TempPathFactory, excitation: str) -> Path:
    """A machine that the description does not fit, under a law that is slow enough for both."""
    parameters = values({**FAR, "platform.stop": 8e-4}, guide_file=excitation)
    parameters["controller"].update(SAFE)
    return record(tmp_path_factory.mktemp("far") / "bag", parameters)


@pytest.fixture(scope="session")
def stiff_answer(stiff_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """What `straightcomp friction BAG -o FILE --json` says of the stiff plant, and the file."""
    file, said = tmp_path_factory.mktemp("answer") / "plant.yaml", io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["friction", str(stiff_bag), "-o", str(file), "--json"]) == 0
    return json.loads(said.getvalue()), file


@pytest.fixture(scope="session")
def guide_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("guide") / "bag", values(STIFF))

"""Bags of simulated runs, on plants that differ from the one at which the search starts."""

import contextlib
import io
import json

import pytest
from plants import FAR, SAFE, SOFT, STIFF, record, values

from straightcomp_ros.cli.main import main
from straightcomp_ros.contract import STROKE
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.tuning.identification.estimate import excitation_survey


@pytest.fixture(scope="session")
def excitation(tmp_path_factory):
    path = tmp_path_factory.mktemp("excitation") / "excitation.csv"
    write_survey(path, excitation_survey(STROKE))
    return str(path)


@pytest.fixture(scope="session")
def stiff_bag(tmp_path_factory, excitation):
    return record(tmp_path_factory.mktemp("stiff") / "bag", values(STIFF, guide_file=excitation))


@pytest.fixture(scope="module")
def soft_bag(tmp_path_factory, excitation):
    return record(tmp_path_factory.mktemp("soft") / "bag", values(SOFT, law="smc", guide_file=excitation))


@pytest.fixture(scope="session")
def far_bag(tmp_path_factory, excitation):
    """A machine that the description does not fit, under a law that is slow enough for both."""
    parameters = values({**FAR, "platform.stop": 8e-4}, guide_file=excitation)
    parameters["controller"].update(SAFE)
    return record(tmp_path_factory.mktemp("far") / "bag", parameters)


@pytest.fixture(scope="session")
def stiff_answer(stiff_bag, tmp_path_factory):
    """What `straightcomp friction BAG -o FILE --json` says of the stiff plant, and the file."""
    file, said = tmp_path_factory.mktemp("answer") / "plant.yaml", io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["friction", str(stiff_bag), "-o", str(file), "--json"]) == 0
    return json.loads(said.getvalue()), file


@pytest.fixture(scope="session")
def guide_bag(tmp_path_factory):
    return record(tmp_path_factory.mktemp("guide") / "bag", values(STIFF))

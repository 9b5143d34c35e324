"""`straightcomp design`: gains from a stage file, into a stage file."""

import dataclasses
import json
import re

import pytest
import yaml

from scripts.stage_files import STAGES
from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import read_stage_file
from straightcomp_ros.tuning.design.feasible_gains import FeasibleGains
from straightcomp_ros.tuning.design.gains import closed_form

FEW = ["--evaluations", "12", "--machines", "2"]


@pytest.fixture
def stage(tmp_path):
    """The shipped stage with a stroke of a second, next to its survey."""
    tree = yaml.safe_load((STAGES / "shipped.yaml").read_text())
    tree["/**"]["ros__parameters"]["stage"]["motion"] = {
        "stroke": 0.06, "speed": 0.2, "acceleration": 1.0, "settle": 0.3, "pause": 0.5
    }  # fmt: skip
    path = tmp_path / "stage.yaml"
    path.write_text("# My stage.\n" + yaml.safe_dump(tree))
    return path


def test_a_design_tells_what_it_promises_and_its_gains_are_written_in_place_of_those_of_an_earlier_one(stage, capsys):
    before = stage.read_text()
    design = ["design", str(stage), "-o", str(stage), *FEW]
    assert main([*design, "--quiet", "0"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for words in ("true error p-p", "ideal encoder of y", "quiet: stable for gains", "2 uncertain machines"):
        assert words in printed
    assert main([*design, "--quiet", "1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    values = read_stage_file(stage)
    assert values["controller"]["control.law"] == "smc_observer"
    for name, value in answer["values"].items():
        assert values["controller"][name] == pytest.approx(value, rel=1e-5)
    assert stage.read_text().count("/**/controller:") == 1 and stage.read_text().endswith(before)
    # To ROS the last value counts: what holds for all nodes, and with it a command line, comes after the gains.
    assert list(yaml.safe_load(stage.read_text())) == ["/**/controller", "/**"]
    assert main(["simulate", "--stage", str(stage), "--json"]) == 0
    promised = answer["predicted"]["true_pp_um"]
    found = json.loads(capsys.readouterr().out)["true_pp_um"]
    assert promised["min"] * 0.99 <= found <= promised["max"] * 1.01


@pytest.mark.nightly
def test_a_stage_on_which_no_gains_have_margins_is_refused_in_one_sentence(infeasible, capsys):
    assert main(["design", str(STAGES / "infeasible.yaml"), "--law", "linear"]) == 1
    said = capsys.readouterr().err
    assert "at 1000 Hz" in said and "amplifier of 150 Hz" in said and said.count("\n") == 1
    assert "no gains of 'linear' have margins" in said and "would do" in said
    # What would do does.
    rate = float(re.search(r"a rate of at least (\S+) Hz", said).group(1))
    faster = infeasible.on(dataclasses.replace(infeasible.description, rate=round(rate)))
    assert rate > 1000.0 and FeasibleGains(faster, "linear").near(closed_form(faster, "linear")) is not None


def test_what_is_wrong_or_would_lose_something_is_said_before_the_work(stage, capsys):
    for words, expected in (
        (["--quiet", "2"], "--quiet 2; allowed: 0 to 1"),
        (["--machines", "0"], "--machines 0; allowed: 1 to"),
        (["-o", "/tmp/gains.yaml"], "is in another folder than"),
    ):
        assert main(["design", str(stage), *words]) == 2
        assert expected in capsys.readouterr().err
    stage.write_text(stage.read_text() + "/**/controller: {ros__parameters: {trigger: timer}}\n")
    assert main(["design", str(stage), "-o", str(stage)]) == 2
    assert "has a section '/**/controller' of its own" in capsys.readouterr().err


@pytest.mark.nightly
def test_a_design_warns_of_stiction_as_the_check_does(stage, capsys):
    tree = yaml.safe_load(stage.read_text())
    tree["/**"]["ros__parameters"]["stage"]["friction"] = {"bristle_stiffness": 1e8}
    stage.write_text(yaml.safe_dump(tree))
    main(["design", str(stage), "--json", *FEW])
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    main(["stage", "check", str(stage), "--json"])
    (finding,) = (one for one in json.loads(capsys.readouterr().out)["checks"] if one["name"] == "stiction")
    assert finding["state"] == "warn"
    assert warning.startswith("stiction: ") and finding["remedy"] in warning

"""The answer as JSON and as a parameter file that simulate takes."""

import json

import pytest

from straightcomp_ros.analysis import current_path as recording
from straightcomp_ros.cli.main import main
from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import STAGE, node_parameters
from straightcomp_ros.parameters.parameter_file import read_parameter_file
from straightcomp_ros.tuning.identification.estimate import DERIVED, UNITS, Estimate, Estimated, parameter_file

FIGURES = (
    "samples samples_in_bag duration_s prediction_error_um prediction_error_ratio amplifier_bandwidth_Hz "
    "amplifier_bandwidth_deviation_Hz delay_us delay_spread_us centre_um parameters advice untold"
)
OF_A_PARAMETER = "value low high unit known poorly_determined hardly_told_apart_from"


def test_json_names_every_parameter_with_its_interval(stiff_answer):
    answer, _ = stiff_answer
    assert set(answer) == set(FIGURES.split())
    assert list(answer["parameters"]) == list(UNITS)
    for found in answer["parameters"].values():
        assert set(found) == set(OF_A_PARAMETER.split())
        assert found["low"] <= found["value"] <= found["high"]
    assert answer["parameters"]["actuator.turns"]["known"]
    assert answer["amplifier_bandwidth_Hz"] == pytest.approx(500.0, rel=1e-3)
    assert answer["delay_us"] == pytest.approx(250.0, abs=5.0)
    # An encoder of 0.1 µm that is predicted as well as it reads.
    assert answer["prediction_error_um"] == pytest.approx(0.1 / 12**0.5, rel=0.2)


def test_the_file_describes_the_plant_to_all_nodes_and_simulate_takes_it(stiff_answer, capsys):
    answer, file = stiff_answer
    values = read_parameter_file(file)
    assert {key for key, section in values.items() if section} == {STAGE}
    for node in ("driver", "controller"):
        described = to_mapping(node_parameters(node, values).stage)
        for name, found in answer["parameters"].items():
            if name not in DERIVED:
                assert described[name] == pytest.approx(found["value"], rel=1e-5), name
    short = [f"--set=stage.motion.{name}" for name in ("stroke=0.05", "settle=0.1", "pause=0.1")]
    for option in ("--stage", "--params-file"):
        assert main(["simulate", option, str(file), "--law", "linear", "--json", *short]) == 0
        assert json.loads(capsys.readouterr().out)["law"] == "linear"


def test_the_truth_is_never_read(stiff_bag, monkeypatch):
    asked = []
    read = recording.read_streams
    monkeypatch.setattr(recording, "read_streams", lambda bag, layouts: asked.extend(layouts) or read(bag, layouts))
    recording.read_recording(stiff_bag)
    assert asked == [ENCODER.topic, COMMAND.topic]


@pytest.mark.parametrize("coulomb_is_poor", [False, True])
def test_what_is_poorly_determined_is_left_out_and_marked(coulomb_is_poor):
    parameters = {name: Estimated(name, 1.0, 0.99, 1.01, False) for name in UNITS}
    poor = {"platform.mass", "friction.static"} | ({"friction.coulomb"} if coulomb_is_poor else set())
    for name in poor:
        parameters[name] = Estimated(name, 1.0, 0.1, 10.0, False)
    lines = parameter_file(Estimate(parameters, None, None, None)).splitlines()
    assert "    # stage.platform.mass: 1.0" in lines
    assert "    # 0.1 to 10 kg, poorly determined" in lines
    assert "    stage.friction.viscous: 1.0" in lines
    # F_S stays with F_C even so: its default may be below F_C, which is refused.
    assert ("    stage.friction.static: 1.0" in lines) is not coulomb_is_poor

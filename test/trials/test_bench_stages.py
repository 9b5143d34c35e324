"""Two stages in two namespaces move at once on this computer, as their users would start them."""

import json
from pathlib import Path

import pytest

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.cli.main import main

pytestmark = [pytest.mark.live, pytest.mark.keeps_time]

SHIPPED = Path(__file__).parents[2] / "config" / "stage_synthetic.yaml"


def short(folder, name):
    """The shipped stage with a stroke of 60 mm."""
    text = SHIPPED.read_text().replace("stage.motion.stroke: 1.76", "stage.motion.stroke: 0.06")
    file = folder / f"{name}.yaml"
    file.write_text(text.replace('stage.name: "synthetic"', f'stage.name: "{name}"'))
    return str(file)


def test_stages_at_once_record_their_own_strokes_and_are_compared_with_each_alone(capfd, tmp_path):
    stages = [short(tmp_path, "left"), short(tmp_path, "right")]
    words = [word for stage in stages for word in ("--stage", stage)]
    code = main(["bench", "stages", "--json", "--output", str(tmp_path / "out"), *words])
    figures = json.loads(capfd.readouterr().out)
    assert code == (0 if figures["in_order"] else 1)
    assert [figure["file"] for figure in figures["stages"].values()] == stages
    for name, stage in (("stage_1", "left"), ("stage_2", "right")):
        figure = figures["stages"][name]
        assert figure["ratio"] == pytest.approx(figure["at_once"]["pp_um"] / figure["alone"]["pp_um"])
        for folder in ("alone_0", "at_once_0"):
            record = evaluate_bag(tmp_path / "out" / folder / name / "bag").record
            assert 0.059 < record.x.max() - record.x.min() < 0.061
            assert f"stage.name: {stage}\n" in (tmp_path / "out" / folder / name / "parameters.yaml").read_text()

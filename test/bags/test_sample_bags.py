"""The sample bags in bags/: small, made by their script, and fit for what their README shows."""

import re
from pathlib import Path

import pytest
from places import BAGS, SMC

from scripts import make_sample_bags
from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.bags.reader import read_attachments, read_streams
from straightcomp_ros.contract import DISPLACEMENT, ENCODER
from straightcomp_ros.offline.audit import audit

NAMES = ("survey", "uncompensated", "smc", "cut_off")
AGAIN = "run scripts/make_sample_bags.py after a change of what the bags show"


def figures(name: str):
    record = evaluate_bag(BAGS / name).record
    return evaluate(record, record.reference)


def test_each_is_below_three_megabytes_and_in_the_readme_whose_commands_name_bags_that_are_there():
    readme = (BAGS / "README.md").read_text(encoding="utf-8")
    assert sorted(path.name for path in BAGS.iterdir() if path.is_dir()) == sorted(NAMES)
    for name in NAMES:
        size = sum(file.stat().st_size for file in (BAGS / name).iterdir())
        assert 100_000 < size < 3_000_000
        assert f"`{name}`" in readme
    commands = re.findall(r"^straightcomp .*$", readme, re.MULTILINE)
    assert len(commands) > 4
    for command in commands:
        assert all(Path(BAGS.parent, path).is_dir() for path in re.findall(r"bags/\w+", command)), command


def test_the_runs_show_what_compensation_does():
    before, after = figures("uncompensated"), figures("smc")
    assert before.residual_pp == pytest.approx(before.uncompensated_pp, rel=0.05)
    assert after.uncompensated_pp == pytest.approx(before.uncompensated_pp, rel=1e-6)
    assert after.residual_pp < 0.1 * before.residual_pp
    assert {"parameters.yaml", "map.csv"} <= set(read_attachments(SMC))


def test_the_compensated_run_is_verified_to_the_bit():
    found = audit(SMC)
    assert found.commands > 8000
    assert (found.different, found.unverified) == (0, 0), AGAIN


def test_the_survey_is_that_of_the_script(tmp_path):
    make_sample_bags.survey(tmp_path / "survey")
    layouts = {stream.topic: stream.layout for stream in (ENCODER, DISPLACEMENT)}
    ours, made = read_streams(BAGS / "survey", layouts), read_streams(tmp_path / "survey", layouts)
    for topic, stream in made.items():
        assert stream.stamp.tolist() == ours[topic].stamp.tolist(), AGAIN
        for name, column in stream.columns.items():
            assert column.tobytes() == ours[topic].columns[name].tobytes(), AGAIN

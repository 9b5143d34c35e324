"""A survey out and back in one column is split where x turns."""

import numpy as np
import pytest

from straightcomp_ros.straightness.survey import SurveyError, read_survey

OUT, BACK = list(range(0, 601, 20)), list(range(600, -1, -20))


def written(path, positions, header="x_mm,deviation_um"):
    path.write_text(header + "\n" + "\n".join(f"{x},{x * 1e-3 + 0.001 * n}" for n, x in enumerate(positions)) + "\n")
    return path


@pytest.mark.parametrize("back", [BACK, BACK[1:]], ids=["x stands at the turn", "x turns at once"])
def test_out_and_back_are_two_directions_of_one_run(tmp_path, back):
    runs = read_survey(written(tmp_path / "s.csv", [*OUT, *back])).runs
    assert [(run.name, run.direction) for run in runs] == [("1", "forward"), ("1", "backward")]
    assert [run.x.size for run in runs] == [len(OUT), len(back)]
    for run in runs:
        assert (np.diff(run.x) > 0.0).all()


def test_again_and_again_are_further_runs(tmp_path):
    runs = read_survey(written(tmp_path / "s.csv", [*BACK, *OUT, *BACK, *OUT[1:]])).runs
    assert [(run.name, run.direction) for run in runs] == [
        ("1", "backward"), ("1", "forward"), ("2", "backward"), ("2", "forward")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("positions", "words"),
    [
        ([*OUT[:15], 270, *OUT[15:]], "x turns back: 270 mm"),
        ([*OUT[:15], OUT[14], *OUT[15:]], "x repeats: 280 mm"),
        ([*OUT, *BACK[:5]], "x repeats: 600 mm"),
    ],
)
def test_an_x_that_is_wrong_is_no_turning_point(tmp_path, positions, words):
    with pytest.raises(SurveyError, match=words):
        read_survey(written(tmp_path / "s.csv", positions))


def test_where_runs_are_named_x_must_not_turn_within_one(tmp_path):
    path = tmp_path / "s.csv"
    rows = "\n".join(f"1,{x},{x * 1e-3}" for x in [*OUT, *BACK])
    path.write_text(f"run,x_mm,deviation_um\n{rows}\n")
    with pytest.raises(SurveyError, match="x repeats: 600 mm"):
        read_survey(path)

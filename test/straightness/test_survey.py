"""Reading a survey: what is accepted, how each fault is named, and where a file without names of runs is split."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from straightcomp_ros.straightness.survey import Run, Survey, SurveyError, orient, read_survey, write_survey

POSITIONS_MM = [10 * k for k in range(30)]


def _rows(positions: list[int] | None = None, prefix: str = "1,forward,") -> list[str]:
    return [f"{prefix}{x},{(x // 10) % 7}" for x in (POSITIONS_MM if positions is None else positions)]


def _write(tmp_path: Path, rows: list[str], header: str = "run,direction,x_mm,deviation_um") -> Path:
    path = tmp_path / "survey.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def _refusal(path: Path) -> str:
    with pytest.raises(SurveyError) as caught:
        read_survey(path)
    assert path.name in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("header", "x", "deviation"),
    [
        ("x_m,deviation_m", 1.0, 1.0),
        ("x_mm,deviation_mm", 1e3, 1e3),
        ("x_um,deviation_um", 1e6, 1e6),
        ("X_MM, Deviation_µm", 1e3, 1e6),
        ("x_mm,deviation_nm", 1e3, 1e9),
        ("Position (mm),Straightness [µm]", 1e3, 1e6),
        ("Target mm, Deviation nm", 1e3, 1e9),
    ],
)
def test_the_unit_in_the_column_name_counts(tmp_path: Path, header: str, x: float, deviation: float) -> None:
    rows = [f"{0.01 * k * x!r},{1e-6 * (k % 7) * deviation!r}" for k in range(30)]
    run = read_survey(_write(tmp_path, rows, header)).runs[0]
    np.testing.assert_allclose(run.x, 0.01 * np.arange(30), rtol=1e-15)
    np.testing.assert_allclose(run.deviation, 1e-6 * (np.arange(30) % 7), rtol=1e-15)


@pytest.mark.parametrize("delimiter", ["\t", ";"])
def test_a_spreadsheet_may_write_decimal_commas_between_other_delimiters(tmp_path: Path, delimiter: str) -> None:
    rows = [f"{x},5{delimiter}-0,{x // 10 % 7}" for x in POSITIONS_MM]
    run = read_survey(_write(tmp_path, rows, f"Position [mm]{delimiter}Straightness [um]")).runs[0]
    np.testing.assert_allclose(run.x, (np.array(POSITIONS_MM) + 0.5) * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(run.deviation, [-(x // 10 % 7) * 1e-7 for x in POSITIONS_MM], atol=1e-18)


def test_without_run_and_direction_the_trend_of_x_gives_the_direction(tmp_path: Path) -> None:
    survey = read_survey(_write(tmp_path, _rows(POSITIONS_MM[::-1], ""), "x_mm,deviation_um"))
    assert [run.direction for run in survey.runs] == ["backward"]
    assert (np.diff(survey.runs[0].x) > 0).all()


def test_two_points_are_enough_to_tell_a_direction() -> None:
    deviation = [1e-6, 2e-6]
    for x, direction in (([0.1, 0.2], "forward"), ([0.2, 0.1], "backward")):
        run = orient("survey made up", "1", None, list(zip([2, 3], x, deviation, strict=True)))
        assert run.direction == direction and run.x.tolist() == [0.1, 0.2]
        assert run.deviation.tolist() == (deviation if direction == "forward" else deviation[::-1])


def test_a_backward_run_may_be_listed_as_driven_or_sorted(tmp_path: Path) -> None:
    driven = read_survey(_write(tmp_path, _rows(POSITIONS_MM[::-1], "1,backward,"))).runs[0]
    in_order = read_survey(_write(tmp_path, _rows(POSITIONS_MM, "1,backward,"))).runs[0]
    np.testing.assert_array_equal(driven.x, in_order.x)
    np.testing.assert_array_equal(driven.deviation, in_order.deviation)


def test_a_cycle_may_count_forward_and_backward_as_one_run(tmp_path: Path) -> None:
    survey = read_survey(_write(tmp_path, _rows() + _rows(POSITIONS_MM[::-1], "1,backward,")))
    assert [(run.name, run.direction) for run in survey.runs] == [("1", "forward"), ("1", "backward")]
    assert len(survey.in_direction("backward")) == 1


def test_comments_blank_lines_byte_order_mark_and_other_columns_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    rows = [f"{x},{x % 70},21.5" for x in POSITIONS_MM]
    path.write_text("\ufeff# laser\n\nx_mm,deviation_um,temperature\n" + "\n".join(rows) + "\n# end\n", "utf-8")
    assert len(read_survey(path).runs[0].x) == len(POSITIONS_MM)


HEADER = "run,direction,x_mm,deviation_um"
UNITS = [f"1,forward,{x},{6 + 5 * (x % 20)}" for x in POSITIONS_MM]
THERE = [10.0 * number for number in range(15)]
TURNS = THERE + THERE[-2::-1]


@pytest.mark.parametrize(
    ("header", "rows", "words"),
    [
        ("", [], "is empty"),
        ("# only a comment", [""], "is empty"),
        (HEADER, [], "no rows"),
        ("position,deviation_um", ["0,1"], "line 1 position x_m,·x_mm,·x_um"),
        ("x_mm,deviation", ["0,1"], "column·'deviation'·carries·no·unit"),
        ("x_m,x_mm,deviation_um", ["0,0,1"], "given·twice,·as·x_m·(column·1)·and·x_mm"),
        (HEADER, ["1,forward,ten,1"], "line 2 x_mm·'ten' a·number"),
        (HEADER, ["1,forward,10,"], "line 2 deviation_um·'' a·number"),
        (HEADER, ["1,forward,10,nan"], "line 2 deviation_um·'nan' finite"),
        (HEADER, ["1,forward,inf,1"], "line 2 x_mm·'inf' finite"),
        (HEADER, ["1,up,10,1"], "line 2 'up' forward·or·backward"),
        (HEADER, ["1,forward,10,1,5"], "line 2 5·cells decimal·comma"),
        (HEADER, ["1,forward,10"], "line 2 3·cells"),
        (HEADER, _rows()[:5], "5·points >=·20"),
        (
            HEADER,
            _rows([*POSITIONS_MM[:12], 95, *POSITIONS_MM[12:]]),
            "line·14 turns·back:·95·mm·after·110·mm·(line·13)",
        ),
        (HEADER, _rows(TURNS), "line·17 turns·back:·130·mm·after·140·mm·(line·16)"),
        (HEADER, _rows([100.0 - x for x in TURNS]), "line·17 turns·back:·-30·mm·after·-40·mm·(line·16)"),
        (HEADER, _rows([*POSITIONS_MM[:12], 110, *POSITIONS_MM[12:]]), "line·14 repeats:·110·mm"),
        (HEADER, _rows(POSITIONS_MM[::-1]), "direction·is·'forward'·but·x·falls"),
        (HEADER, _rows([x for x in POSITIONS_MM if not 100 < x < 200]), "between·x·=·100·mm·and·200·mm <=·50·mm"),
        ("run,direction,x_m,deviation_um", UNITS, "is·the·unit·wrong?·It·would·fit·as·x_mm"),
        ("run,direction,x_mm,deviation_mm", UNITS, "is·the·unit·wrong?·It·would·fit·as·deviation_um"),
        ("run,direction,x_um,deviation_um", UNITS, "is·the·unit·wrong?·It·would·fit·as·x_mm"),
        (HEADER, [f"1,forward,{x},0" for x in POSITIONS_MM], "extends·over·0·m"),
    ],
)
def test_a_fault_is_refused_with_its_place_and_what_is_allowed(
    tmp_path: Path, header: str, rows: list[str], words: str
) -> None:
    message = _refusal(_write(tmp_path, rows, header))
    for word in words.split():
        assert word.replace("·", " ") in message


def test_a_file_that_is_missing_or_not_utf8_is_refused(tmp_path: Path) -> None:
    assert "No such file" in _refusal(tmp_path / "nothing.csv")
    path = tmp_path / "survey.csv"
    path.write_bytes("x_mm,deviation_µm\n".encode("latin-1"))
    assert "not UTF-8" in _refusal(path)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    deviations=st.lists(st.integers(-10_000, 10_000), min_size=20, max_size=40, unique=True),
    direction=st.sampled_from(["forward", "backward"]),
    start=st.integers(-1_000_000, 1_000_000),
)
def test_what_is_written_is_read_back(tmp_path: Path, deviations: list[int], direction: str, start: int) -> None:
    x = (start + 12_345.0 * np.arange(len(deviations))) * 1e-7 * 10
    values = (np.array(deviations) * 10.0 + np.arange(len(deviations))) * 1e-9
    run = Run("a", direction, x, values)  # type: ignore[arg-type]
    write_survey(tmp_path / "s.csv", Survey((run,)), ["comment"])
    again = read_survey(tmp_path / "s.csv").runs[0]
    assert (again.name, again.direction) == (run.name, run.direction)
    np.testing.assert_allclose(again.x, run.x, atol=0.51e-7)
    np.testing.assert_allclose(again.deviation, run.deviation, atol=0.51e-9)


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

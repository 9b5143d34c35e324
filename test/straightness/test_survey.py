"""Reading a survey: what is accepted, how each fault is named, where a file without names of runs is split; its runs
on one grid, and their repeatability by its definition."""

import re
import statistics

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.straightness.survey_runs import cubic_spline, on_common_grid, point_weights, repeatability

POSITIONS_MM = [10 * k for k in range(30)]


def _rows(positions=POSITIONS_MM, prefix="1,forward,"):
    return [f"{prefix}{x},{(x // 10) % 7}" for x in positions]


HEADER = "run,direction,x_mm,deviation_um"


@pytest.fixture
def read(tmp_path):
    """``read(header, *rows)`` reads the survey of a file with these lines."""

    def of(*lines, encoding="utf-8", **options):
        path = tmp_path / "survey.csv"
        path.write_bytes(("\n".join(lines) + "\n").encode(encoding))
        return read_survey(path, **options)

    return of


@pytest.mark.parametrize(
    ("header", "x", "deviation"),
    [
        ("x_m,deviation_m", 1.0, 1.0),
        ("x_mm,deviation_mm", 1e3, 1e3),
        ("x_um,deviation_um", 1e6, 1e6),
        ("X_MM, Deviation_µm", 1e3, 1e6),
        ("x_mm,deviation_nm", 1e3, 1e9),
        ("Position (mm),Straightness [µm]", 1e3, 1e6),
        ("Position (in),Deviation [µin]", 1.0 / 0.0254, 1e6 / 0.0254),
        ("Target inches,Straightness (microinch)", 1.0 / 0.0254, 1e6 / 0.0254),
        ("Position / mm,Straightness / µm", 1e3, 1e6),
        ("Target mm, Deviation nm", 1e3, 1e9),
        ('"Position, mm","Straightness, µm"', 1e3, 1e6),
    ],
)
def test_the_unit_in_the_column_name_counts(read, header, x, deviation):
    rows = [f"{0.01 * k * x!r},{1e-6 * (k % 7) * deviation!r}" for k in range(30)]
    run = read(header, *rows).runs[0]
    np.testing.assert_allclose(run.x, 0.01 * np.arange(30), rtol=1e-15)
    np.testing.assert_allclose(run.deviation, 1e-6 * (np.arange(30) % 7), rtol=1e-15)


def test_a_backward_run_may_be_listed_as_driven_or_sorted_and_count_with_the_one_before(read):
    for back, way in ((POSITIONS_MM[::-1], "backward"), (POSITIONS_MM, "Reverse")):
        survey = read(HEADER, *_rows(), *_rows(back, f"1,{way},"))
        assert [(run.name, run.direction) for run in survey.runs] == [("1", "forward"), ("1", "backward")]
        forward, (backward,) = survey.runs[0], survey.in_direction("backward")
        np.testing.assert_array_equal(backward.x, forward.x)
        np.testing.assert_array_equal(backward.deviation, forward.deviation)


OUT, BACK = list(range(0, 601, 20)), list(range(600, -1, -20))
FINE = list(range(0, 601, 5))
UNITS = [f"1,forward,{x},{6 + 5 * (x % 20)}" for x in POSITIONS_MM]
THREE = [f"{x},{x % 30},{x % 30}" for x in range(0, 240, 10)]
COLUMNS = "x_mm,Run 1 forward (µm),Run 2 forward (µm),Run 3 forward (µm)"
TURNS = POSITIONS_MM[:15] + POSITIONS_MM[13::-1]
HOLED = [x for x in POSITIONS_MM if not 100 < x < 200]


def with_another(x, at=12, positions=POSITIONS_MM):
    """The positions, and before the one of number ``at`` this one."""
    return [*positions[:at], x, *positions[at:]]


@pytest.mark.parametrize(
    ("header", "rows", "words"),
    [
        ("", [], "is empty"),
        (HEADER, [], "no rows"),
        ("position,deviation_um", ["0,1"], "line 1 position x_m,·x_mm,·x_um"),
        ("x_mm,deviation", ["0,1"], "column·'deviation'·carries·no·unit"),
        ("x_m,x_mm,deviation_um", ["0,0,1"], "given·twice,·as·x_m·(column·1)·and·x_mm"),
        *(
            (f"{name},x_mm,{name.title()},deviation_um", ["1,0,2,1"], f"line·1 {name}·is·given·twice")
            for name in ("run", "direction", "time_s")
        ),
        (HEADER, ["1,forward,ten,1"], "line 2 x_mm·'ten' a·number"),
        (HEADER, ["1,forward,10,"], "line 2 deviation_um·'' a·number"),
        (HEADER, ["1,forward,10,nan"], "line 2 deviation_um·'nan' finite"),
        (HEADER, ["1,up,10,1"], "line 2 'up' forward·or·backward"),
        (HEADER, ["1,forward,10,1,5"], "line 2 5·cells decimal·comma"),
        (HEADER, _rows()[:5], "5·points >=·20"),
        (HEADER, _rows(with_another(95)), "line·14 turns·back:·95·mm·after·110·mm·(line·13)"),
        (HEADER, _rows(TURNS), "line·17 turns·back:·130·mm·after·140·mm·(line·16)"),
        (HEADER, _rows(with_another(110)), "line·14 repeats:·110·mm"),
        (HEADER, _rows(with_another(100, 20, POSITIONS_MM[::-1]), "1,backward,"), "line·22 repeats:·100·mm"),
        (HEADER, _rows(POSITIONS_MM[::-1]), "direction·is·'forward'·but·x·falls"),
        (HEADER, _rows(HOLED), "between·x·=·100·mm·and·200·mm <=·50·mm"),
        (HEADER, [*_rows(), *_rows(HOLED, "2,forward,")], "'2' 100·mm·and·200·mm"),
        ("run,direction,x_m,deviation_um", UNITS, "is·the·unit·wrong?·It·would·fit·as·x_mm"),
        ("run,direction,x_mm,deviation_mm", UNITS, "is·the·unit·wrong?·It·would·fit·as·deviation_um"),
        (HEADER, [f"1,forward,{x},0" for x in POSITIONS_MM], "extends·over·0·m"),
        # An x that is wrong is no turning point, and a run that is named goes each way once.
        ("x_mm,deviation_um", _rows(with_another(270, 15, OUT), ""), "more·than·half·of·x x·turns·back:·270·mm"),
        ("x_mm,deviation_um", _rows(with_another(280, 15, OUT), ""), "x·repeats:·280·mm"),
        ("x_mm,deviation_um", _rows([*OUT, *BACK[:5]], ""), "x·repeats:·600·mm"),
        ("direction,x_mm,deviation_um", _rows(with_another(300, 70, FINE), "fwd,"), "x·turns·back:·300·mm"),
        ("run,x_mm,deviation_um", _rows([*OUT, *BACK, *OUT], "1,"), "x·repeats:·600·mm"),
        # Other words for directions, and cells that a spreadsheet merges.
        (
            "Richtung,x_mm,deviation_um",
            _rows(OUT, "hin,") + _rows(OUT, "zurück,"),
            "'richtung'·says·'hin'·and·'zurück'",
        ),
        (
            "Dir,x_mm,deviation_um",
            [row for way in "FR" for row in _rows([0], f"{way},") + _rows(OUT[1:], ",")],
            "'dir'·says·'f'·and·''",
        ),
        # Columns that need not be runs.
        *(
            (f"x_mm,{names}", THREE, "no·column·for·deviation")
            for names in (
                "run 1 [um],run 2 [nm]",  # one unit is wrong, most likely
                "run 1 [um],run 2 backward [um]",  # which way was the first?
                "straightness 1 [um],straightness 2 [um]",  # of two directions, perhaps
                "horizontal [um],vertical [um]",
                "deviation_um raw,deviation_um std",
                "run 1+ [um],run 1 - [um]",
                "temperature (run 1),temperature (run 2)",
                "deviation_um ( run 1),deviation_um (forwardrun 2)",
            )
        ),
        *(
            (f"x_mm,Run 1 (µm),{beside} (µm)", THREE, f"line·1 column·'{beside.lower().replace(' ', '·')} may·be·a·run")
            for beside in ("Run 2 back", "Run 1 \u2193", "Run 2 +", "fwd run again", "Return 1", "Back")
        ),
        ("x_mm,Run 1 (µm),Run 1 (µm) back", THREE, "line·1 column·'run·1·(um)·back'·may·be·a·run"),
        ("x_mm,Run 1 [µm],Run 2", THREE, "line·1 column·'run·2' may·be·a·run·and·has·no·unit"),
        ("x_mm,Forward [µm],Backward", THREE, "line·1 column·'backward' may·be·a·run·and·has·no·unit"),
        ("Position,1+,1-\nmm,µm,", THREE, "line·2 column·'1-' may·be·a·run·and·has·no·unit"),
        *(
            (f"x_mm,Run 1 [µm],{beside}", THREE, "line·1 may·be·a·run·and·has·no·unit")
            for beside in ("Run 2 back", "Run 2 []", "Run 2 [microns]")
        ),
        *(
            (names, ["0;1;1,5"], "'3'·may·be·a·run")
            for names in ("x_mm;Run 1 [µm];", "x_mm;Run 1 [µm];[µm]", "Position;Run 1;\nmm;µm;µm")
        ),
        *(
            (
                f"{names},x_mm",
                [f"forward,{x % 30},{x % 30},0,{x}" for x in range(0, 240, 10)],
                "deviation_um·stands·among·columns·of·runs",
            )
            for names in (
                *(
                    "Remark,Run 1+ (µm),Run 1- (µm),Straightness (µm)",
                    "Remark,Deviation (µm),Forward (µm),Backward (µm)",
                ),
                *("Direction,Run 1 (µm),Run 2 (µm),Deviation (µm)", "Run,Run 1 (µm),Run 2 (µm),Deviation (µm)"),
                *("Remark,Run,Deviation (µm),Deviation backward (µm)", "Remark,Run,Forward (µm),Straightness (µm)"),
                *("Remark,Run 1,Run 2,Deviation (µm)", "Remark,Run 1 back (µm),Run 1 forth (µm),Deviation (µm)"),
            )
        ),
        *(
            (f"Position,{names}", [f"{row},0" for row in THREE], "line·2 among·columns·of·runs")
            for names in ("Run 1,Run 2,Straightness\nmm,µm,,µm", "Straightness,,\nmm,µm,µm,µm")
        ),
        # No column of a run takes the place of another.
        (
            COLUMNS,
            [*(f"{x},{x % 30},{x % 30},{x % 30}" for x in range(0, 240, 10)), "50,,7,"],
            "line·26 turns·back:·50·mm",
        ),
        (COLUMNS, [f"{x},{x % 30},{'7' * (x == 50)},{x % 30}" for x in range(0, 240, 10)], "column·3 1·points"),
        ("x_mm;deviation_um;run", ["0;1"], "line·2 2·cells,·the·header·has·3"),
        ("x_mm;Run 1 [µm];Run 2 [µm]", THREE, "line·2 1·cells,·the·header·has·3"),
        *(
            (f"x_mm,{names}", [f"{row},0" for row in THREE], "line·1: 1 is·given·twice")
            for names in (
                "Run 1 (µm),run 1 [um],Run 2 (µm)",
                "1+ (µm),2+ (µm),1 fwd (µm)",
                "Run 1 (µm),Run 1 (µm).1,Run 2 (µm)",
            )
        ),
    ],
)
def test_a_fault_is_refused_with_its_place_and_what_is_allowed(read, header, rows, words):
    with pytest.raises(SurveyError) as caught:
        read(header, *rows)
    for word in ("survey.csv", *words.split()):
        assert word.replace("·", " ") in str(caught.value)


def test_a_file_that_is_missing_without_end_or_not_utf8_is_refused(tmp_path, read):
    with pytest.raises(SurveyError, match=r"survey\.csv.*No such file"):
        read_survey(tmp_path / "survey.csv")
    with (tmp_path / "survey.csv").open("wb") as file:
        file.truncate((256 << 20) + 1)
    with pytest.raises(SurveyError, match=r"survey\.csv.*larger than"):
        read_survey(tmp_path / "survey.csv")
    with pytest.raises(SurveyError, match=r"survey\.csv.*not UTF-8"):
        read("x_mm,deviation_\x81m", encoding="latin-1")


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    deviations=st.lists(st.integers(-10_000, 10_000), min_size=20, max_size=40, unique=True),
    direction=st.sampled_from(["forward", "backward"]),
    start=st.integers(-1_000_000, 1_000_000),
    name=st.sampled_from(["a", "#2", "Cycle 1, warm", 'the "good" one', "3"]),
)
def test_what_is_written_is_read_back_whatever_the_name_of_a_run(tmp_path, deviations, direction, start, name):
    x = (start + 12_345.0 * np.arange(len(deviations))) * 1e-7 * 10
    values = (np.array(deviations) * 10.0 + np.arange(len(deviations))) * 1e-9
    runs = [Run(one, direction, x, values) for one in (name, "other")]
    write_survey(tmp_path / "s.csv", Survey(tuple(runs)), ["comment"])
    for again, run in zip(read_survey(tmp_path / "s.csv").runs, runs, strict=True):
        assert (again.name, again.direction) == (run.name, run.direction)
        np.testing.assert_allclose(again.x, run.x, atol=0.51e-7)
        np.testing.assert_allclose(again.deviation, run.deviation, atol=0.51e-9)


WAYS = [("1", "forward"), ("1", "backward"), ("2", "forward"), ("2", "backward")]


@pytest.mark.parametrize(
    ("header", "passages", "expected"),
    [
        ("", [("", OUT), ("", BACK)], WAYS[:2]),  # x stands at the turn
        ("", [("", OUT), ("", BACK[1:])], WAYS[:2]),
        ("", [("", BACK)], WAYS[1:2]),
        ("", [("", BACK), ("", OUT), ("", BACK), ("", OUT[1:])], [WAYS[1], WAYS[0], WAYS[3], WAYS[2]]),
        ("", [("", OUT), ("", OUT)], WAYS[::2]),
        # A named cycle goes both ways.
        ("run,", [("7,", OUT), ("7,", BACK), ("3,", OUT), ("3,", BACK)], [(n, w) for n in "73" for _, w in WAYS[:2]]),
        ("direction,", [("fwd,", OUT), ("BWD,", BACK)] * 2, WAYS[::2] + WAYS[1::2]),
        ("direction,", [("+,", OUT), ("\u2212,", BACK)], WAYS[:2]),
        # Sorted by x, the column alone says the direction.
        *(
            (f"{one},", [("F,", OUT), ("R,", OUT)] * 2, WAYS[::2] + WAYS[1::2])
            for one in ("Dir", "Direction of x", "Travel direction", "Fahrtrichtung")
        ),
        (
            "run,",
            [("1+,", OUT), ("1-,", OUT), ("2+,", OUT)],
            [("1+", "forward"), ("1-", "backward"), ("2+", "forward")],
        ),
        ("Cycle,", [("1 fwd,", OUT), ("1 bwd,", OUT)], WAYS[:2]),
        *((f"{one},", [("1.0,", OUT), ("-1.0,", OUT)], WAYS[:2]) for one in ("dir", "direction")),
        ("dir,", [("1,", OUT), ("-1,", OUT)], WAYS[:2]),
        ("Approach,", [("forward,", OUT), ("reverse,", OUT)], WAYS[:2]),
        ("Passed,", [("+,", OUT), ("-,", BACK), ("+,", OUT)], [*WAYS[:2], WAYS[2]]),
        *(
            (f"{one},", [("1,", OUT), ("2,", OUT)], WAYS[::2])
            for one in ("Directory", "Direct", "Sens temp", "Vorrichtung")
        ),
        # Where x turns, its trend gives them, whatever an instrument calls forward.
        ("Dir,", [("F,", BACK), ("R,", OUT)] * 2, [WAYS[1], WAYS[0], WAYS[3], WAYS[2]]),
        ("run,Approach,", [("7,forward,", BACK), ("7,reverse,", OUT)], [("7", "backward"), ("7", "forward")]),
        ("Approach,", [("fwd,", OUT), ("bwd,", BACK[1:]), ("fwd,", OUT[1:]), ("bwd,", BACK[1:])], WAYS),
    ],
)
def test_where_runs_or_directions_are_not_named_the_trend_of_x_gives_them(read, header, passages, expected):
    rows = [row for prefix, passage in passages for row in _rows(passage, prefix)]
    runs = read(f"{header}x_mm,deviation_um", *rows).runs
    assert [(run.name, run.direction) for run in runs] == expected
    assert [run.x.size for run in runs] == [len(passage) for _, passage in passages]
    assert all((np.diff(run.x) > 0.0).all() for run in runs)


@pytest.mark.parametrize("name", ["run", "Run No.", "Cycle", "Cycle,Cycle"])
def test_runs_that_take_turns_in_a_file_sorted_by_x_are_known_by_their_column(read, name):
    cells = name.count(",") + 1
    rows = [f"{f'{number},' * cells}{way},{x + number / 1e3},{x % 7}" for x in OUT for number in (1, 2) for way in "FR"]
    runs = read(f"{name},Dir,x_mm,deviation_um", *rows).runs
    assert [(run.name, run.direction, run.x.size) for run in runs] == [(*way, len(OUT)) for way in WAYS]


@pytest.mark.parametrize(
    ("name", "cell"),
    [("Cycles", lambda x: 3 + x % 40), ("Probe", lambda x: "fwd" if x < 200 or x in (240, 320, 400) else "bwd")],
)
def test_a_number_that_changes_from_point_to_point_and_a_direction_of_a_part_of_x_are_none_of_the_runs(
    read, name, cell
):
    (run,) = read(f"{name},x_mm,deviation_um", *(row for x in OUT for row in _rows([x], f"{cell(x)},"))).runs
    assert run.x.size == len(OUT)


@pytest.mark.parametrize(
    ("header", "back", "expected"),
    [
        ("x_mm,run 1 [um],Run_2_um", False, [WAYS[0], WAYS[2]]),
        ("x_mm,cycle 1 [um],cycle 2 [um]", True, WAYS),
        ("x_mm,Run 1 fwd (\u00b5m),Run 1 backward (\u00b5m)", False, WAYS[:2]),
        ("Position,1 Forward,1 bwd\nmm,\u00b5m,\u00b5m", False, WAYS[:2]),
        ("x_mm,Run 1+ (\u00b5m),Run 1- (\u00b5m)", False, WAYS[:2]),
        ("x_mm,Fwd 1 (\u00b5m),Rev 1 (\u00b5m)", False, WAYS[:2]),
        ("x_mm,Forwards (\u00b5m),Backwards (\u00b5m)", False, WAYS[:2]),
        ("Position,1+,1\u2212\nmm,\u00b5m,\u00b5m", False, WAYS[:2]),
        ("x_mm,1 forward (\u00b5m),1 reverse (\u00b5m)", False, WAYS[:2]),
        ("x_mm,Straightness (\u00b5m) run 1,Straightness (\u00b5m) run 2", False, WAYS[::2]),
        ("x_mm,Run 1 forward (\u00b5m),Run 1 [\u00b5m] backward", False, WAYS[:2]),
        ("x_mm,Run 1 (\u00b5m)+,Run 1 (\u00b5m) \u2212", False, WAYS[:2]),
        ("x_mm,Forward (\u00b5m),Forward (\u00b5m).1", False, WAYS[::2]),  # as pandas writes equal names
    ],
)
def test_each_run_may_have_a_column_of_its_own(read, header, back, expected):
    ways = range(0, 210, 10), range(200, -1, -10)
    rows = [f"{x},{x % 30},{2 * (x % 30)}" for way in ways[: 1 + back] for x in way]
    runs = read(header, *rows).runs
    assert [(run.name, run.direction) for run in runs] == expected
    halves = len(runs) // 2
    for run, column in zip(runs, [1] * halves + [2] * halves, strict=True):
        np.testing.assert_allclose(run.deviation, column * (run.x * 1e3 % 30).round() * 1e-6, atol=1e-15)


def test_an_empty_cell_in_the_column_of_a_run_is_no_point_and_one_column_may_be_chosen(read):
    lines = "x_mm,run 1 [um],run 2 [um]", *(f"{x},{x % 30},{x if x != 50 else ''}" for x in range(0, 240, 10))
    assert [run.x.size for run in read(*lines).runs] == [24, 23]
    (run,) = read(*lines, names={"deviation": "Run 1 [um]"}).runs
    assert run.deviation.max() == pytest.approx(20e-6)
    lines = "x_mm;run 1 [um];run 2 [um];mean [um]", *(f"{x};{x % 30}{f';{x};0' * (x < 210)}" for x in range(0, 240, 10))
    assert [run.x.size for run in read(*lines).runs] == [24, 21]


@pytest.mark.parametrize(
    ("header", "names"),
    [
        ("x_mm,run 1 [um],deviation_um", {}),
        ("x_mm,run 1 [um],deviation_um,run 2 [um]", {"deviation": "deviation_um"}),
        ("x_mm,deviation_um,deviation_um.1", {"deviation": "deviation_um.1"}),
        ("direction,x_mm,run 1,deviation_um,mean of run [um]", {}),
        *(
            (f"Target (mm),{one} forward{unit},Straightness (µm),{one} backward{unit}", {})
            for unit in (" (µm)", "")
            for one in ("Repeatability", "s", "Uncertainty", "Mean")
        ),
        *(
            (f"Target (mm),{one}forward (mm),Straightness (µm),{one}backward (mm)", {})
            for one in ("", "Position ", "Actual position ", "Run 1 ")
        ),
        # Where each row says its run and direction, no column is one.
        *(
            (f"direction,x_mm,{one},deviation_um,{two},run", {})
            for one, two in (("Forward", "Backward"), ("Pass 1", "Pass 2"), ("Run 1 (µm)", "Run 2 (µm)"))
        ),
    ],
)
def test_the_deviation_beside_runs_is_read_where_it_is_chosen_or_no_other_column_is_another_run(read, header, names):
    first, after = "fwd," * header.startswith("direction"), ",7" * (header.count(",") - 2)
    after = after.removesuffix(",7" * bool(first))
    (run,) = read(header, *(f"{first}{x},{x % 40},{x % 30}{after}" for x in range(0, 240, 10)), names=names).runs
    assert run.deviation.max() == pytest.approx(20e-6)


@pytest.mark.parametrize(
    "beside",
    [
        *("Run 1 - Run 2 (µm)", "Run Ø (µm)", "Run 2σ (µm)", "mean of run (µm)", "s forward (µm)"),
        *("run 3 (0.1 µm)", "run 3 (µm/m)", "Temp run 1 (°C)", "Run 1 temperature", "Pass"),
        *("Run 1 (µm) smoothed", "Run 1 (µm) - Run 2", "Run 1 (µm) less Run 2 (µm)", "#"),
    ],
)
def test_a_column_that_is_computed_of_runs_or_has_another_unit_or_no_number_is_no_run(read, beside):
    rows = (f"{x},{x % 30},{x % 40},7" for x in range(0, 240, 10))
    assert len(read(f"x_mm,Run 1 (µm),Run 2 (µm),{beside}", *rows).runs) == 2


def test_runs_by_columns_have_one_x(read):
    def by_columns(name, of):
        rows = (f"{x};{x % 30};{of(x)};{x % 40}" for x in range(0, 240, 10))
        return [f"Position (mm);Forward (µm);{name};Backward (µm)", *rows]

    others = {"Position bwd (mm)": lambda x: 230 - x, "x_mm.1": lambda x: f"{x + 5.5}".replace(".", ",")}
    for name, of in others.items():
        with pytest.raises(SurveyError):
            read(*by_columns(name, of))
        assert len(read(*by_columns(name, of), names={"x": "Position (mm)"}).runs) == 2
    others = {
        "Position 2 (mm)": lambda x: f"{x + 0.013}",
        "X error (mm)": lambda x: x % 7 / 1e3,
        "Rest (mm)": lambda x: -x,
        "Position time (s)": lambda x: 0.8 * x,
    }
    for name, of in others.items():
        assert len(read(*by_columns(name, of)).runs) == 2
    # The machine's own x, or another axis, belongs to all runs; an x with a direction to its runs.
    rows = [f"{x};{312.5 + x};{x % 30};{x % 40};{312.5 - x}" for x in range(0, 240, 10)]
    assert len(read("x_mm;Machine position (mm);Forward (µm);Backward (µm);x 2 (mm)", *rows).runs) == 2
    with pytest.raises(SurveyError):
        read("x_mm;x bwd (mm);Forward (µm);Backward (µm);y_mm", *rows)


def test_a_total_in_a_column_without_a_name_is_no_run(read):
    rows = (f"{x};{x % 30};{x % 40};{'3,2' * (x == 230)}" for x in range(0, 240, 10))
    assert len(read("x_mm;Run 1 (µm);Run 2 (µm);", *rows).runs) == 2


ROWS = [f"{x};{x % 30}" for x in range(0, 240, 10)]


LONG = f"{'a' * 197} um, squared"


@pytest.mark.parametrize("name", ["Tilt (µm/m)", "Tilt µm/m", "Geradheit (0,1 µm)", "slope mm per m", "Pos", LONG])
def test_a_column_of_another_unit_than_a_length_cannot_be_chosen(read, name):
    with pytest.raises(SurveyError, match=r"--deviation-column .* does not end with a unit"):
        read(f"x_mm;{name}", *ROWS, names={"deviation": name})


@pytest.mark.parametrize("names", ["x_mm;-Straightness (µm)", "x_mm;- deviation [um]", "-X (mm);deviation_um"])
def test_a_sign_before_the_name_makes_another_quantity_of_a_column(read, names):
    with pytest.raises(SurveyError, match=r"no column for"):
        read(names, *ROWS)


def test_a_chosen_column_is_that_one_or_none(read):
    assert (
        read("x_mm;Y (µm);Y- (µm)", *(f"{row};7" for row in ROWS), names={"deviation": "Y (µm)"}).runs[0].x.size == 24
    )
    with pytest.raises(SurveyError, match="no column for deviation"):
        read("x_mm;Run 1 (µm);Run 2 (µm)", *(f"{row};7" for row in ROWS), names={"deviation": "Run 3 (µm)"})


@pytest.mark.parametrize("name", ["Geradheit in µm", "Y-Abweichung_µm", "error, um"])
def test_a_column_of_any_name_that_ends_with_a_unit_of_length_can_be_chosen(read, name):
    assert read(f"x_mm;{name}", *ROWS, names={"deviation": name}).runs[0].deviation.max() == 20e-6


@pytest.mark.parametrize(
    "line",
    [
        "# encoder reference: index 3;;;",
        '"# encoder reference: index 3",',
        "#encoder reference:index 3",
        "# Encoder Reference: index 3",
    ],
)
def test_the_encoders_reference_is_known_as_a_spreadsheet_or_a_hand_writes_it(read, line):
    found = read("# made at 12:30", line, "x_mm;deviation_um", *ROWS)
    assert found.mark == "index 3" and len(found.facts) == 1


@pytest.mark.parametrize("values", [2, 3])
def test_a_list_without_names_is_not_said_to_be_of_one_controller(read, values):
    with pytest.raises(SurveyError, match="x_mm") as caught:
        read(*(" ".join(f"{x} {x % 30 / 10:.3f} 0.100".split()[:values]) for x in range(0, 240, 10)))
    assert ("linuxcnc" in str(caught.value)) == (values == 3)


X = np.arange(24) * 10.0  # mm
UM = np.round(5.0 * np.sin(X / 36.0), 3)


def german(value, places=3):
    whole, _, fraction = f"{abs(value):,.{places}f}".partition(".")
    return ("-" if value < 0 else "") + whole.replace(",", ".") + ("," + fraction if fraction else "")


def csv(header, cell, delimiter=";", x=lambda value: f"{value:g}"):
    return "\n".join([header, *(f"{x(a)}{delimiter}{cell(b)}" for a, b in zip(X, UM, strict=True))]) + "\n"


MM_UM = csv("x_mm;deviation_um", lambda v: german(v))
READ = {
    "comments, a blank line and another column": "# laser\n\n"
    + csv("x_mm;deviation_um;temperature", lambda v: german(v) + ";21,5")
    + "# end\n",
    "Excel's first line": "sep=;\n" + MM_UM,
    "Excel's first line with a comma": "sep=,\n" + csv("x_mm,deviation_um", lambda v: f"{v}", ","),
    "lines before the header": "Operator;Müller, A.\r\nDate, 2026\r\n\r\nRun 3\r\n"
    + MM_UM.replace("deviation_um", "Straightness [µm]"),
    "units in a line of their own": MM_UM.replace("x_mm;deviation_um", "Position;Straightness\nmm;µm"),
    "units in brackets below": "Date;26.11.2026\n" + MM_UM.replace("x_mm;deviation_um", "X;Deviation\n[mm];[µm]"),
    "thousands in the deviation": csv("x_mm;deviation_nm", lambda v: german(v * 1e3, 0), x=lambda v: german(v, 1)),
    "decimal commas between tabs": csv(
        "Position [mm]\tStraightness [um]", lambda v: german(v), "\t", lambda v: german(v, 1)
    ),
    "decimal commas in quotes between commas": csv(
        "Position [mm],Straightness [um]", lambda v: f'"{german(v)}"', ",", lambda v: f'"{german(v, 1)}"'
    ),
    "thousands in x": csv("x_um;deviation_um", lambda v: german(v), x=lambda v: german(v * 1e3, 0)),
    "English thousands": csv("x_mm\tdeviation_nm", lambda v: f"{v * 1e3:,.0f}", "\t", lambda v: f"{v:.1f}"),
    "French thousands": csv(
        "x_um;deviation_um", lambda v: german(v), x=lambda v: f"{v * 1e3:,.1f}".replace(",", "\u202f").replace(".", ",")
    ),
    "Swiss thousands": csv(
        "x_um,deviation_nm", lambda v: f"{v * 1e3:,.0f}".replace(",", "'"), ",", lambda v: f"{v * 1e3}"
    ),
    "typographic minus": csv("x_mm,deviation_um", lambda v: f"{v}".replace("-", "\u2212"), ","),
    "a header in a comment": "# x_mm,deviation_um\n" + csv("# made by hand", lambda v: f"{v}", ","),
    "separators after some rows": MM_UM.replace("\n40;", ";\n40;") + ";;\n;\n",
    "rows that end before an empty cell": csv("x_mm;deviation_um;Remark", german).replace("\n40;", ";cold\n40;"),
    "separators after the header": MM_UM.replace("um\n", "um;;\n"),
    "a row of units without the last": csv("Position;Straightness;Remark\nmm;µm", lambda v: german(v) + ";"),
    **{
        f"a line of {len(line)} {line[-1]!r} before the header": f"{line}\n{MM_UM}"
        for line in ("_" * 100_000, "." * 100_000, "run 1" + " " * 90_000 + "-", "(" * 90_000 + ") um")
    },
    "both marks in a number": csv("x_um\tdeviation_um", lambda v: f"{v:.3f}", "\t", lambda v: f"{v * 1e3:,.1f}"),
}


@pytest.mark.parametrize(
    ("kind", "encoding"),
    [
        *((kind, "utf-8") for kind in READ),
        *(("lines before the header", of) for of in ("cp1252", "utf-8-sig", "utf-16")),
    ],
)
def test_a_spreadsheet_has_the_value_that_it_shows_in_every_encoding_of_spreadsheets(read, kind, encoding):
    (run,) = read(READ[kind], encoding=encoding).runs
    np.testing.assert_allclose(run.x, X * 1e-3, atol=1e-12)
    np.testing.assert_allclose(run.deviation, UM * 1e-6, atol=1e-12)


def test_a_mark_that_is_typed_twice_changes_no_other_number(read):
    rows = [f"{x}.5;{x % 30}.5" for x in range(0, 240, 10)]
    with pytest.raises(SurveyError, match=r"line 9: .*'1\.2\.3'"):
        read("x_mm;deviation_um", *rows[:7], "70.5;1.2.3", *rows[8:])


@pytest.mark.parametrize("written", [lambda v: german(v, 0), lambda v: f"{v:,.0f}"])
def test_a_mark_that_a_number_has_twice_separates_thousands(read, written):
    (run,) = read(csv("x_um;deviation_nm", lambda v: written(v * 1e3), x=lambda v: written(v * 1e3 + 9e5))).runs
    np.testing.assert_allclose(run.x, X * 1e-3 + 0.9, atol=1e-12)
    np.testing.assert_allclose(run.deviation, UM * 1e-6, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        csv("Position (mm);Straightness (µm)", lambda v: f"{v};{v}").replace("(µm)", "(µm);Straightness (µm)", 1),
        csv("x_mm;deviation_um", lambda v: f"{v};{v}").replace("deviation_um", "deviation_um;Straightness [nm]", 1),
        csv("x_mm;deviation_um;deviation_um.1", lambda v: f"{v};{v}"),
        csv("x_mm;Straightness (µm);Straightness (µm).1", lambda v: f"{v};{v}"),
        csv("Target (mm);deviation_um", lambda v: f"{v};{v}").replace("Target (mm)", "Target (mm);Position (mm)", 1),
        csv("x_mm;deviation_nm", lambda v: german(v * 1e3, 0)).replace("10;", "10,5;", 1).replace("20;", "20.5;", 1),
        csv("x_mm;deviation_nm", lambda v: german(abs(v) * 1e3, 0)),
        csv("x_mm\tdeviation_nm", lambda v: f"{abs(v) * 1e3:,.0f}", "\t"),
        csv("x_mm;deviation_nm", lambda v: german(-abs(v) * 1e3, 0)),
        csv("x_mm;deviation_nm", lambda v: f"{abs(v) * 1e3:+,.0f}"),
        csv("x_mm,deviation_nm", lambda v: f'"{abs(v) * 1e3 + 1000:,.0f}"', ","),
        csv("x_mm;Run 1 (nm);Run 2 (nm)", lambda v: f"{abs(v) * 1e2:.0f};" + german(abs(v) * 4e3 + 1000, 0)),
        csv("x_um;deviation_nm", lambda v: f"{abs(v) * 1e3 + 1000:,.0f}", x=lambda v: german(v * 1e3 + 1000, 0)),
        csv("x_mm,deviation_um,", german, ","),
    ],
)
def test_a_spreadsheet_that_may_mean_two_things_is_refused(read, text):
    with pytest.raises(SurveyError):
        read(text)


GRID = np.linspace(0.0, 1.0, 101)


def _bow(x):
    return 1e-5 * np.sin(3.0 * x)


def _run(direction, offset=0.0, x=GRID):
    return Run("1", direction, x, _bow(x) + offset)


def _grid(*runs):
    survey = Survey(runs)
    return *on_common_grid(survey, min_points=20, max_gap=0.05), survey


@pytest.mark.parametrize("points", [83, 1001])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_runs_on_the_same_x_are_taken_as_measured_and_another_brought_onto_it_whatever_their_order(place, points):
    runs = [_run("forward"), _run("backward", 1e-7)]
    runs.insert(place, _run("backward", x=np.linspace(0.0, 1.0, points)))
    x, values, _ = _grid(*runs)
    np.testing.assert_array_equal(x, GRID)
    np.testing.assert_array_equal(np.delete(values, place, axis=0), [_bow(GRID), _bow(GRID) + 1e-7])
    np.testing.assert_allclose(values[place], _bow(GRID), atol=1e-12)


@pytest.mark.parametrize(
    ("points", "place"),
    [((93, 101), 1), ((93, 101, 93, 101), 1), ((51, 401), 1), ((401, 51), 0), ((51, 51, 401, 401), 2)],
)
def test_of_two_halves_the_one_that_lost_points_gives_way_and_of_unlike_ones_the_coarse_one(points, place):
    runs = [_run("forward", x=np.linspace(0.0, 1.0, count)) for count in points]
    np.testing.assert_array_equal(_grid(*runs)[0], runs[place].x)


def test_a_run_is_written_as_the_stage_moved(tmp_path):
    write_survey(tmp_path / "s.csv", Survey((_run("forward"), _run("backward"))))
    x = [float(line.split(",")[2]) for line in (tmp_path / "s.csv").read_text().splitlines()[1:]]
    np.testing.assert_allclose(x, np.concatenate([GRID, GRID[::-1]]) * 1e3)


def test_weights_of_a_splines_values_are_those_of_its_points_beyond_its_ends_too_however_many_there_are():
    random = np.random.default_rng(7)
    at, weights = np.sort(random.uniform(-0.05, 1.05, 300)), random.normal(size=(5, 300))
    for count in (4, 5, 20, 60):
        x = np.sort(random.uniform(0.0, 1.0, count))
        dense = weights @ cubic_spline(x, np.eye(count))(at)
        assert point_weights(x, at, weights) == pytest.approx(dense, rel=1e-6, abs=1e-6 * np.abs(dense).max())
    # A constant is its own spline.
    of_points = point_weights(np.linspace(0.0, 1.0, 50_000), at.clip(0.0, 1.0), weights)
    assert of_points.sum(axis=1) == pytest.approx(weights.sum(axis=1))


def test_the_grid_keeps_to_what_all_runs_cover():
    x, values, _ = _grid(_run("forward"), _run("backward", x=np.linspace(0.0012, 0.9988, 101)))
    assert (x[0], x[-1]) == (0.0012, 0.9988)
    assert np.diff(x).min() > 0.005
    np.testing.assert_allclose(values[0], _bow(x), atol=1e-12)


def test_a_survey_with_the_widest_gap_is_read_wherever_its_rounded_x_begins(tmp_path):
    survey = Survey((_run("forward", x=0.01234565 + 0.05 * np.arange(24)),))
    write_survey(tmp_path / "s.csv", survey)
    assert read_survey(tmp_path / "s.csv").runs[0].x.size == 24


def test_a_run_that_ends_a_point_early_is_kept_whatever_the_last_bit_of_its_x_says():
    steps = np.arange(25) / 20.0
    assert steps[-1] - steps[-2] > 0.05
    x, _, _ = _grid(_run("forward", x=steps), _run("backward", x=steps[:-1]))
    np.testing.assert_array_equal(x, steps[:-1])


@pytest.mark.parametrize(
    ("runs", "words"),
    [
        ([_run("forward"), _run("backward", x=GRID[:51])], "between x = 500 mm and 1000 mm.*within 50 mm.*broken off"),
        ([_run("forward", x=np.linspace(0.0, 1.0, 11))], "11 points in the range that all runs cover; allowed: >= 20"),
        ([], "no run"),
    ],
)
def test_runs_without_a_common_grid_are_refused(runs, words):
    with pytest.raises(SurveyError, match=words):
        _grid(*runs)


NANOMETRES = st.lists(st.integers(-9999, 9999), min_size=4, max_size=4)
RUNS = st.integers(0, 6).flatmap(lambda count: st.lists(NANOMETRES, min_size=count, max_size=count))
"""Over four points, each number of them as often."""


@given(forward=RUNS, backward=RUNS)
def test_the_figures_are_those_of_the_standard_of_what_was_driven_often_enough_for_them(forward, backward):
    assume(forward or backward)
    x, driven = np.arange(4) * 0.01, {"forward": forward, "backward": backward}
    runs = [Run("1", way, x, np.array(run) * 1e-9) for way, runs in driven.items() for run in runs]
    found = repeatability(Survey(tuple(runs)), x, np.array([run.deviation for run in runs]))
    # By the definitions, from the values of each direction at each point.
    at_points = [list(zip(*runs, strict=True)) for runs in driven.values()]
    means = [[statistics.mean(values) for values in points] for points in at_points]
    s = [[statistics.stdev(values) for values in points if len(values) > 1] for points in at_points]
    one_way = [4.0 * max(each) if each else None for each in s]
    reversal = [there - back for there, back in zip(*means, strict=False)]
    both = [2.0 * (there + back) + abs(b) for there, back, b in zip(*s, reversal, strict=False)]
    expected = {
        "repeatability_forward_um": one_way[0],
        "repeatability_backward_um": one_way[1],
        "repeatability_bidirectional_um": max(*one_way, *both) if both else None,
        "reversal_max_um": max(map(abs, reversal)) if reversal else None,
        "reversal_mean_um": statistics.mean(reversal) if reversal else None,
    }
    for name, value in found.to_display().items():
        assert value == (None if expected[name] is None else pytest.approx(expected[name] * 1e-3, abs=1e-9)), name
    # Directions weigh the same, whatever the number of their runs.
    assert found.mean == pytest.approx(np.mean([mean for mean in means if mean], axis=0) * 1e-9, abs=1e-15)
    assert found.short_of_the_standard == (min(len(forward), len(backward)) < 5)
    for words, values in (
        ("standard deviation at most", [one for each in s for one in each]),
        ("hysteresis", [*map(abs, reversal)]),
    ):
        printed = [float(number) for number in re.findall(rf", {words} (\S+) µm", str(found))]
        assert printed == pytest.approx([max(values) * 1e-3] if values else [], abs=6e-4), words

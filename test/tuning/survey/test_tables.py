"""Files of instruments and controllers: their makers' values or a refusal; nothing is lost on the way."""

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import page

from straightcomp_ros.straightness.guide_map import MapParameters, find_survey, load_map
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.straightness.survey_table import OTHER_KINDS
from straightcomp_ros.tuning.survey.error_table import UNITS, Conventions
from straightcomp_ros.tuning.survey.formats import FORMATS, WRITTEN, written

MM = Conventions()
EXAMPLES = {
    "linuxcnc": "0 0 0\n10 10.004 10.006\n20 19.998 20\n",
    "crosscomp": """# Achskompensationsdaten
kopf.achs_nr                          2
kw.crosscomp.last_index               1  /*Last valid index of the table*/
kw.crosscomp.unit                     1  /*0:Incr. 1:Metric in 0.1 um*/
kw.crosscomp.table[0].setpoint        10735
kw.crosscomp.table[0].correction      3
kw.crosscomp.table[1].setpoint        10000000 /*at 1000 mm*/
kw.crosscomp.table[1].correction      1000
""",
    "etalon": """// position errors and tables
[C0B]
VALUE = 0.000022355737
[EYX]
Gridpoints = {
-280.0 -0.001358635132
-270.0 -0.000240680764   // a remark
}
[EZX]
Gridpoints = {
0 1
}
""",
    "aerotech": """'        RowAxis  ColumnAxis  OutputAxis1  OutputAxis2  SampDistRow  SampDistCol  NumCols
:START2D    3          1           1            2           5          10.5          3
:START2D POSUNIT=PRIMARY CORUNIT=PRIMARY/1000 OFFSETROW=0 OFFSETCOL = -100
0 1.5   0 2.5
0 -3
0 1.5   0 2.5   0 -3  ; the second row
:END
""",
}
"""In the words of the makers' documentation and of programs that write such files."""


def read(tmp_path, name, text, conventions=MM, encoding="utf-8"):
    """The runs that the format's reader makes of a file with this text."""
    path = tmp_path / f"table{FORMATS[name].ending}"
    path.write_bytes(text.encode(encoding))
    return FORMATS[name].read(path, conventions).runs


@pytest.mark.parametrize(
    ("name", "text", "unit", "x_mm", "forward_um", "backward_um"),
    [
        ("linuxcnc", EXAMPLES["linuxcnc"], "mm", [0, 10, 20], [0, 4, -2], [0, 6, 0]),
        ("linuxcnc", EXAMPLES["linuxcnc"], "inch", [0, 254, 508], [0, 101.6, -50.8], [0, 152.4, 0]),
        # LinuxCNC: trim = nominal - position, so both types of the file say the same.
        ("linuxcnc", "0 0 0\n10 -0.004 -0.006\n20 0.002 0\n", "mm", [0, 10, 20], [0, 4, -2], [0, 6, 0]),
        ("crosscomp", EXAMPLES["crosscomp"], "mm", [1.0735, 1000], [-0.3, -100], None),
        ("etalon", EXAMPLES["etalon"], "mm", [-280, -270], [-1.358635132, -0.240680764], None),
        ("aerotech", EXAMPLES["aerotech"], "mm", [100, 110.5, 121], [-1.5, -2.5, 3], None),
    ],
)
def test_an_example_is_read_in_metres_as_the_deviation(tmp_path, name, text, unit, x_mm, forward_um, backward_um):
    runs = read(tmp_path, name, text, Conventions(unit))
    assert [run.direction for run in runs] == ["forward", "backward"][: 1 if backward_um is None else 2]
    for run, deviation_um in zip(runs, (forward_um, backward_um), strict=False):
        np.testing.assert_allclose(run.x, np.array(x_mm) * 1e-3, rtol=1e-12)
        np.testing.assert_allclose(run.deviation, np.array(deviation_um) * 1e-6, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("name", WRITTEN)
@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    start_um=st.integers(-2_000_000, 2_000_000),
    step_um=st.integers(1000, 20_000),
    nanometres=st.lists(st.integers(-50_000, 50_000), min_size=2, max_size=60),
    unit=st.sampled_from(sorted(UNITS)),
    axes=st.permutations(range(1, 5)),
)
def test_what_is_written_is_read_again(tmp_path, name, start_um, step_um, nanometres, unit, axes):
    points = np.array([((start_um + step_um * at) * 1e-6, value * 1e-9) for at, value in enumerate(nanometres)])
    conventions = Conventions(unit, axes[0], axes[1])
    for run in read(tmp_path, name, written(name, points.tolist(), conventions), conventions):
        np.testing.assert_allclose(np.column_stack([run.x, run.deviation]), points, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("linuxcnc", "10.004", "ten", ["line 2", "'ten'", "a number"]),
        ("linuxcnc", " 10.004 10.006", "", ["line 2", "nominal, forward, reverse"]),
        ("linuxcnc", "20 19.998", "10 9.998", ["x = 10 mm", "twice"]),
        ("crosscomp", "unit                     1", "unit 0", ["0.1 µm"]),
        ("crosscomp", "kw.crosscomp.table[1].correction      1000", "", ["table[1].correction is missing"]),
        ("crosscomp", "last_index               1", "last_index 2", ["table[2].setpoint is missing"]),
        ("etalon", "[EYX]", "[EXX]", ["[EYX]", "EXX, EZX"]),
        ("etalon", "-270.0 -0.000240680764", "-270.0", ["line 7", "position"]),
        ("aerotech", "10.5 ", "-10.5", ["SampDistCol", "> 0"]),
        ("aerotech", "10.5 ", "0.0 ", ["SampDistCol 0;", "> 0"]),
        ("aerotech", "1            2 ", "1 4 ", ["axis 2", "1 over", "4 over"]),
        ("aerotech", "0 1.5   0 2.5   0 -3", "0 1.5   0 2.5   0 -4", ["row axis"]),
        ("aerotech", "0 -3\n", "\n", ["10 values", "3 × 2"]),
        ("aerotech", "PRIMARY/1000", "COUNTS", ["COUNTS", "METRIC"]),
        ("aerotech", ":START2D    3", ":START    3", [":START2D"]),
    ],
)
def test_a_fault_is_named(tmp_path, name, old, new, words):
    assert EXAMPLES[name].count(old) == 1
    with pytest.raises(SurveyError) as caught:
        read(tmp_path, name, EXAMPLES[name].replace(old, new))
    for word in (f"table{FORMATS[name].ending}", *words):
        assert word in str(caught.value)


X = np.arange(24) * 10.0  # mm
UM = np.round(5.0 * np.sin(X / 36.0), 3)
PP = float(np.ptp(UM))
COARSE = np.round(0.5 * UM[::2], 3)


def aerotech(head, rows, spacing="10 10", columns=24):
    text = "\n".join("  ".join(f"{value} 0" for value in row) for row in rows)
    return f":START2D {head} {spacing} {columns}\n:START2D POSUNIT=METRIC CORUNIT=METRIC/1000\n{text}\n:END\n"


FLAT = [0.0] * 8
INCHES = aerotech("2 1 2 1", [FLAT * 3] * 2, "10 0.1").replace("METRIC", "ENGLISH")
POINTS = list(zip((X * 1e-3).tolist(), (UM * 1e-6).tolist(), strict=True))
COLUMNS = aerotech("2 1 2 1", [UM, UM])


def crosscomp(platform, stage):
    return written("crosscomp", POINTS, Conventions(stage_axis=stage, platform_axis=platform))


def etalon(error="EYX"):
    return written("etalon", POINTS, MM).replace("EYX", error)


def rtl(runs, first="", count=24):
    targets = "\n".join("  ".join(f"{x:.4f}" for x in X[at : at + 5]) for at in range(0, 24, 5))
    rows = "\n".join(f"  {run}  {target}  {value}" for run, target, value in runs)
    return (
        f"HEADER::\nFile type: {first}\nTARGET DATA::\nTarget-count:{count}\nTargets :\n{targets}\nFlags: 1\n"
        f"USER-TEXT::\nMachine: Größe\nRUNS::\nRun-count:{len({run[0] for run in runs})}\n"
        f"DEVIATIONS::\nRun Target Data:\n{rows}\nEQUIPMENT::\nSerial No: 1\n"
    )


OUT_AND_BACK = [(1, at + 1, UM[at]) for at in range(24)] + [(2, at + 1, UM[at] + 0.2) for at in reversed(range(24))]


def pos(*blocks):
    return "API laser\n" + "\n".join(
        f"Position   \t{name} Avg Error\n"
        + "\n".join(f"{x:.4f}\t{y * 1e-3:.6f}" for x, y in zip(X, values, strict=True))
        for name, values in blocks
    )


@pytest.mark.parametrize(
    ("name", "text", "peak_to_peak"),
    [
        ("aerotech", COLUMNS, PP),
        ("aerotech", aerotech("1 2 2 1", [[v, v] for v in UM], columns=2), PP),
        ("aerotech", COLUMNS + aerotech("2 1 2 1", [0.5 * UM] * 2), 1.5 * PP),
        ("aerotech", COLUMNS + aerotech("2 1 2 1", [COARSE] * 2, "10 20", 12), 1.5 * PP),
        ("aerotech", COLUMNS + aerotech("2 3 2 3", [UM, UM]), PP),
        # The same x in both tables, but for the last bit.
        ("aerotech", aerotech("2 1 2 1", [UM] * 2, "10 1.1") + aerotech("2 1 2 1", [FLAT] * 2, "10 3.3", 8), PP),
        ("aerotech", aerotech("2 1 2 1", [UM] * 2, "10 2.54") + INCHES, PP),
        # Points may stand on the lines of the braces.
        ("etalon", etalon().replace("{\n", "{ ").replace("\n}", " }"), PP),
        ("etalon", etalon() + etalon("EXX"), PP),
        ("renishaw", rtl(OUT_AND_BACK), PP),
        *(
            ("renishaw", rtl(OUT_AND_BACK, f"linear\n{fact}"), PP)
            for fact in (
                *("Machine type: crossed-roller stage\nModel: roll controller", "Machine type: High-dynamic gantry"),
                *("Measurement type: of a stage on rollers", "Measurement location: Roll shop 3"),
                "Measurement type: of a roller stage",
            )
        ),
        ("api", pos(("Bidirectional", 2 * UM), ("Forward Directional", UM), ("Reverse Directional", UM)), PP),
        ("api", pos(("Bidirectional", UM)), PP),
    ],
)
def test_a_file_has_the_value_that_its_maker_gives_it(tmp_path, name, text, peak_to_peak):
    for run in read(tmp_path, name, text):
        assert len(run.x) == 24
        assert np.ptp(run.deviation) * 1e6 == pytest.approx(peak_to_peak, abs=0.1)


def test_runs_of_renishaw_and_the_mean_backward_of_api_alone_have_their_directions(tmp_path):
    forward, backward = read(tmp_path, "renishaw", rtl(OUT_AND_BACK), encoding="cp1252")
    assert (forward.direction, backward.direction) == ("forward", "backward")
    np.testing.assert_allclose(forward.x, X * 1e-3)
    np.testing.assert_allclose(backward.deviation - forward.deviation, 0.2e-6, atol=1e-12)
    (alone,) = read(tmp_path, "api", pos(("Reverse Directional", UM)))
    assert alone.direction == "backward"


@pytest.mark.parametrize(
    ("name", "text", "options"),
    [
        ("aerotech", aerotech("2 3 2 3", [UM, UM]), ""),
        ("aerotech", aerotech("2 2 2 1", [UM, UM]), ""),
        ("aerotech", aerotech("1 2 2 1", [UM, UM]), ""),
        ("aerotech", COLUMNS, "--stage-axis 2 --platform-axis 1"),
        ("aerotech", COLUMNS.replace(":END", ""), ""),
        ("aerotech", COLUMNS.replace("CORUNIT=METRIC/1000", "CORUNIT=METRIC/-1000"), ""),
        ("crosscomp", crosscomp(3, 2), ""),
        ("crosscomp", crosscomp(2, 2), ""),
        ("crosscomp", crosscomp(2, 1) + "kw.crosscomp.table[03].correction 99\n", ""),
        ("crosscomp", crosscomp(2, 1).replace("last_index 23", "last_index 19"), ""),
        ("etalon", etalon() + etalon(), ""),
        ("etalon", etalon().replace("}", ""), ""),
        ("etalon", etalon() + "[EZX]\nGridpoints = { }\n" + etalon(), ""),
        ("etalon", etalon().replace("}", "} 240 0.1"), ""),
        *(("etalon", etalon(error), f"--error {error}") for error in ("EXX", "YX")),
        ("renishaw", rtl(OUT_AND_BACK, "Angular"), ""),
        ("renishaw", rtl(OUT_AND_BACK, "linear\nFiletype: yaw"), ""),
        *(
            ("renishaw", rtl(OUT_AND_BACK, f"linear\n{fact}"), "")
            for fact in (
                *("Test mode: roll_error", "Measurement: RollAngle", "Measurement: RollError", "Type: rollerror"),
                *("Type: ZRoll", "error_type_1: yaw"),
            )
        ),
        ("renishaw", rtl(OUT_AND_BACK, count=25), ""),
        ("renishaw", rtl([*OUT_AND_BACK, (1, 3, 9.0)]), ""),
        ("renishaw", rtl(OUT_AND_BACK[:-1]), ""),
        ("renishaw", rtl([(1.5, *one[1:]) if one[0] == 1 else one for one in OUT_AND_BACK]), ""),
        ("renishaw", "HEADER::\n", ""),
        ("api", pos(("Forward Directional", UM), ("Forward Directional", UM)), ""),
        ("api", "Measurement type: Pitch\n" + pos(("Bidirectional", UM)), ""),
        ("api", "API\n", ""),
    ],
)
def test_a_file_that_says_another_axis_a_point_twice_or_is_cut_off_is_refused(tmp_path, verb, name, text, options):
    table = tmp_path / "table"
    table.write_text(text)
    code, _, said = verb("map", "convert", table, "--format", name, "-o", tmp_path / "o.csv", *options.split())
    assert code != 0 and said.startswith("straightcomp map convert: ") and list(tmp_path.iterdir()) == [table]


@pytest.mark.parametrize(
    ("others", "header", "x", "deviation"),
    [
        ("", "carriage_pos_mm,lateral_error_um", "Carriage_pos_mm", "lateral_error_um"),
        ("", "Pos [mm],Dev. (um)", "Pos [mm]", "Dev. (um)"),
        ("", "Pos [mm],Dev. (um)", "pos_mm", "dev. (um)"),
        ("x_mm,deviation_um,", "target_mm,straightness_um", "target_mm", "straightness_um"),
        ("Position (mm),Deviation (um),", "target_mm,straightness_um", "target_mm", "straightness_um"),
    ],
)
def test_columns_of_other_names_are_chosen_and_no_others_of_their_quantities_are_meant(
    tmp_path, verb, others, header, x, deviation
):
    path = tmp_path / "survey.csv"
    zeros = "0," * others.count(",")
    path.write_text("\n".join([others + header, *(f"{zeros}{at},{y}" for at, y in zip(X, UM, strict=True))]))
    refused = verb("map", "build", path)
    assert refused.code == 2 and "--x-column" in refused.err
    found = verb("map", "build", path, "--x-column", x, "--deviation-column", deviation, "--json").json
    assert found["points"] == 24 and found["correction_pp_um"] == pytest.approx(np.ptp(UM), rel=0.05)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("aerotech", COLUMNS),
        ("crosscomp", crosscomp(2, 1)),
        ("etalon", etalon()),
        ("linuxcnc", written("linuxcnc", POINTS, MM)),
        ("renishaw", rtl(OUT_AND_BACK)),
        ("api", pos(("Bidirectional", UM))),
    ],
)
def test_another_kind_of_file_in_place_of_a_survey_names_the_command_that_converts_it(tmp_path, verb, name, text):
    path = tmp_path / "file.csv"
    path.write_text(text, encoding="utf-8")
    for command in (
        ["map", "build", path],
        ["simulate", "--set", f"stage.guide.file={path}"],
        ["stage", "new", tmp_path / "stage", "--survey", path, "--yes"],
    ):
        code, _, said = verb(*command)
        assert code != 0 and f"map convert {path} --format {name}" in said
    assert verb("map", "convert", path, "--format", name, "-o", tmp_path / "s.csv").code == 0


def test_every_format_is_recognised_in_place_of_a_survey_and_stands_on_the_page():
    rows = re.findall(r"^\| `(\w+)` \| (\.\w+) \|", page("surveys"), re.MULTILINE)
    assert dict(rows) == {name: one.ending for name, one in FORMATS.items()}
    assert OTHER_KINDS.keys() == FORMATS.keys()


@pytest.mark.parametrize("name", WRITTEN)
def test_the_exported_map_comes_back_as_the_same_map(tmp_path, verb, name):
    table, survey = tmp_path / f"table{FORMATS[name].ending}", tmp_path / "survey.csv"
    exported = verb("map", "export", "-o", table, "--json").json
    converted = verb("map", "convert", table, "-o", survey, "--json").json
    assert exported["points"] == converted["points"] == 177
    original, again = load_map(), load_map(MapParameters(file=str(survey)))
    x = np.linspace(*original.span, 5000)
    assert np.abs(again.evaluate(x)[0] - original.evaluate(x)[0]).max() < 0.02e-6
    assert exported["interpolation_error_um"] < 0.1


def test_an_export_names_its_survey_and_goes_to_a_controller_only_if_that_is_of_a_guide(tmp_path, verb):
    shipped, copy, own = find_survey(MapParameters().file), tmp_path / "copy.csv", tmp_path / "own.csv"
    copy.write_bytes(shipped.read_bytes())
    own.write_text("x_mm,deviation_um\n" + "".join(f"{x},{y}\n" for x, y in zip(X, UM, strict=True)))
    for survey, options in ((shipped, []), (copy, ["--survey", copy]), (own, ["--survey", own])):
        table = tmp_path / f"{survey.stem}.cal"
        said = verb("map", "export", "-o", table, *options)
        assert survey.name in said.out and ("load it into the controller" in said.err) == (survey == own)
        assert verb("map", "export", "-o", table, "--force", "--json", *options).json["survey"] == str(survey)


def test_negate_turns_the_sign_over(tmp_path, verb):
    for option in ([], ["--negate"]):
        assert verb("map", "export", "-o", tmp_path / f"{len(option)}.comp", *option).code == 0
    plain, negated = (np.loadtxt(tmp_path / f"{count}.comp") for count in (0, 1))
    np.testing.assert_allclose(plain[:, 1:], -negated[:, 1:])
    np.testing.assert_allclose(plain[:, 1], load_map().evaluate(plain[:, 0] * 1e-3)[0] * 1e3, atol=1e-7)

"""What strangers' surveys and error tables say is read by value, or refused; never something else."""

import json

import numpy as np
import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.straightness.survey import SurveyError, read_survey
from straightcomp_ros.straightness.tables.error_table import Conventions
from straightcomp_ros.straightness.tables.formats import FORMATS, recognised

X = np.arange(24) * 10.0  # mm
UM = np.round(5.0 * np.sin(X / 36.0), 3)
PP = float(np.ptp(UM))
COARSE = np.round(0.5 * UM[::2], 3)


def aerotech(head, rows, spacing="10 10", columns=24):
    text = "\n".join("  ".join(f"{value} 0" for value in row) for row in rows)
    return f":START2D {head} {spacing} {columns}\n:START2D POSUNIT=METRIC CORUNIT=METRIC/1000\n{text}\n:END\n"


def etalon(points, error="EYX"):
    return f"[{error}]\nGridpoints = {points}\n"


PAIRS = [f"{x:g} {y * 1e-3:.6f}" for x, y in zip(X, UM, strict=True)]
BLOCK = "{\n" + "\n".join(PAIRS) + "\n}"
COLUMNS = aerotech("2 1 2 1", [UM, UM])


def crosscomp(platform, stage, more=""):
    lines = [f"kopf.achs_nr {platform}", "kw.crosscomp.last_index 23", f"kw.crosscomp.master_ax_nr {stage}"]
    lines.append("kw.crosscomp.unit 1")
    for index, (x, y) in enumerate(zip(X, UM, strict=True)):
        lines += [f"kw.crosscomp.table[{index}].setpoint {x * 1e4:g}"]
        lines += [f"kw.crosscomp.table[{index}].correction {y * 10:.2f}"]
    return "\n".join(lines) + "\n" + more


def rtl(runs, first="", count=24, listed=X):
    targets = "\n".join("  ".join(f"{x:.4f}" for x in listed[at : at + 5]) for at in range(0, len(listed), 5))
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


def survey_of(tmp_path, name, text, encoding="utf-8", **conventions):
    path = tmp_path / f"file{FORMATS[name].ending}"
    path.write_bytes(text.encode(encoding))
    found = FORMATS[name].read(path, Conventions(**conventions))
    return found if hasattr(found, "runs") else found.to_survey(str(path))


@pytest.mark.parametrize(
    ("name", "text", "conventions", "peak_to_peak"),
    [
        ("aerotech", COLUMNS, {}, PP),
        ("aerotech", aerotech("1 2 2 1", [[v, v] for v in UM], columns=2), {}, PP),
        ("aerotech", COLUMNS + aerotech("2 1 2 1", [0.5 * UM] * 2), {}, 1.5 * PP),
        ("aerotech", COLUMNS + aerotech("2 1 2 1", [COARSE] * 2, "10 20", 12), {}, 1.5 * PP),
        ("aerotech", COLUMNS + aerotech("2 3 2 3", [UM, UM]), {}, PP),
        ("crosscomp", crosscomp(2, 1), {}, PP),
        ("crosscomp", crosscomp(3, 2), {"platform_axis": 3, "stage_axis": 2}, PP),
        ("etalon", etalon(BLOCK), {}, PP),
        ("etalon", etalon("{ " + "\n".join(PAIRS) + " }"), {}, PP),
        ("etalon", etalon(BLOCK) + etalon(BLOCK, "EXX"), {}, PP),
        ("renishaw", rtl(OUT_AND_BACK), {}, PP),
        ("api", pos(("Bidirectional", 2 * UM), ("Forward Directional", UM), ("Reverse Directional", UM)), {}, PP),
        ("api", pos(("Bidirectional", UM)), {}, PP),
    ],
)
def test_a_file_has_the_value_that_its_maker_gives_it(tmp_path, name, text, conventions, peak_to_peak):
    for run in survey_of(tmp_path, name, text, **conventions).runs:
        assert len(run.x) == 24
        assert np.ptp(run.deviation) * 1e6 == pytest.approx(peak_to_peak, abs=0.1)


def test_runs_of_renishaw_are_those_of_the_survey_with_their_directions(tmp_path):
    forward, backward = survey_of(tmp_path, "renishaw", rtl(OUT_AND_BACK), encoding="cp1252").runs
    assert (forward.direction, backward.direction) == ("forward", "backward")
    np.testing.assert_allclose(forward.x, X * 1e-3)
    np.testing.assert_allclose(backward.deviation - forward.deviation, 0.2e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "conventions"),
    [
        ("aerotech", aerotech("2 3 2 3", [UM, UM]), {}),
        ("aerotech", aerotech("2 2 2 1", [UM, UM]), {}),
        ("aerotech", aerotech("1 1 2 1", [UM, UM]), {}),
        ("aerotech", aerotech("1 2 2 1", [UM, UM]), {}),
        ("aerotech", COLUMNS, {"stage_axis": 2, "platform_axis": 1}),
        ("crosscomp", crosscomp(3, 2), {}),
        ("crosscomp", crosscomp(1, 2), {}),
        ("crosscomp", crosscomp(2, 2), {}),
        ("crosscomp", crosscomp(2, 1, "kw.crosscomp.table[03].correction 99\n"), {}),
        ("etalon", etalon(BLOCK) + etalon(BLOCK), {}),
        ("etalon", etalon(BLOCK) + etalon("{ }", "EZX") + etalon(BLOCK), {}),
        ("etalon", etalon("{\n" + "\n".join(PAIRS) + "\n} 240 0.1"), {}),
        *(("etalon", etalon(BLOCK, error), {"error": error}) for error in ("EXX", "ECX", "EAX", "YX", "EYXX")),
        ("renishaw", rtl(OUT_AND_BACK, "Angular"), {}),
        ("renishaw", rtl(OUT_AND_BACK, count=25), {}),
        ("renishaw", rtl([*OUT_AND_BACK, (1, 3, 9.0)]), {}),
        ("renishaw", rtl(OUT_AND_BACK[:-1]), {}),
        ("renishaw", "HEADER::\n", {}),
        ("api", pos(("Forward Directional", UM), ("Forward Directional", UM)), {}),
        ("api", "Measurement type: Pitch\n" + pos(("Bidirectional", UM)), {}),
        ("api", "API\n", {}),
    ],
)
def test_a_file_that_says_another_axis_error_or_point_twice_is_refused(tmp_path, name, text, conventions):
    with pytest.raises(SurveyError):
        survey_of(tmp_path, name, text, **conventions)


def german(value, places=3):
    whole, _, fraction = f"{abs(value):,.{places}f}".partition(".")
    return ("-" if value < 0 else "") + whole.replace(",", ".") + ("," + fraction if fraction else "")


def csv(header, cell, delimiter=";", x=lambda value: f"{value:g}"):
    return "\n".join([header, *(f"{x(a)}{delimiter}{cell(b)}" for a, b in zip(X, UM, strict=True))]) + "\n"


MM_UM = csv("x_mm;deviation_um", lambda v: german(v))
READ = {
    "Excel's first line": "sep=;\n" + MM_UM,
    "Excel's first line with a comma": "sep=,\n" + csv("x_mm,deviation_um", lambda v: f"{v}", ","),
    "lines before the header": "Operator;Müller, A.\nDate, 2026\n\nRun 3\n" + MM_UM,
    "thousands in the deviation": csv("x_mm;deviation_nm", lambda v: german(v * 1e3, 0), x=lambda v: german(v, 1)),
    "thousands in x": csv("x_um;deviation_um", lambda v: german(v), x=lambda v: german(v * 1e3, 0)),
    "English thousands": csv("x_mm\tdeviation_nm", lambda v: f"{v * 1e3:,.0f}", "\t", lambda v: f"{v:.1f}"),
    "both marks in a number": csv("x_um\tdeviation_um", lambda v: f"{v:.3f}", "\t", lambda v: f"{v * 1e3:,.1f}"),
}


@pytest.mark.parametrize("kind", READ)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_spreadsheet_has_the_value_that_it_shows(tmp_path, kind, encoding):
    path = tmp_path / "survey.csv"
    path.write_bytes(READ[kind].encode(encoding))
    (run,) = read_survey(path).runs
    np.testing.assert_allclose(run.x, X * 1e-3, atol=1e-12)
    np.testing.assert_allclose(run.deviation, UM * 1e-6, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        csv("Position (mm);Straightness (µm)", lambda v: f"{v};{v}").replace("(µm)", "(µm);Straightness (µm)", 1),
        csv("x_mm;deviation_um", lambda v: f"{v};{v}").replace("deviation_um", "deviation_um;Straightness [nm]", 1),
        csv("Target (mm);deviation_um", lambda v: f"{v};{v}").replace("Target (mm)", "Target (mm);Position (mm)", 1),
        csv("x_mm;deviation_nm", lambda v: german(v * 1e3, 0)).replace("10;", "10,5;", 1).replace("20;", "20.5;", 1),
        csv("x_um;deviation_nm", lambda v: f"{abs(v) * 1e3 + 1000:,.0f}", x=lambda v: german(v * 1e3 + 1000, 0)),
    ],
)
def test_a_spreadsheet_that_may_mean_two_things_is_refused(tmp_path, text):
    path = tmp_path / "survey.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyError):
        read_survey(path)


def test_columns_of_other_names_are_chosen_by_name(tmp_path, capsys):
    path = tmp_path / "survey.csv"
    path.write_text(csv("carriage_pos_mm,lateral_error_um", lambda v: f"{v}", ","), encoding="utf-8")
    assert main(["map", "build", str(path)]) == 1
    assert "--x-column" in capsys.readouterr().err
    names = ["--x-column", "Carriage_pos_mm", "--deviation-column", "lateral_error_um"]
    assert main(["map", "build", str(path), *names, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 24


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("aerotech", COLUMNS),
        ("crosscomp", crosscomp(2, 1)),
        ("etalon", etalon(BLOCK)),
        ("linuxcnc", "".join(f"{x:g} {-y * 1e-3:.6f} {-y * 1e-3:.6f}\n" for x, y in zip(X, UM, strict=True))),
        ("renishaw", rtl(OUT_AND_BACK)),
        ("api", pos(("Bidirectional", UM))),
    ],
)
@pytest.mark.parametrize("ending", [None, ".csv"])
def test_another_kind_of_file_in_place_of_a_survey_names_the_command_that_converts_it(
    tmp_path, capsys, name, text, ending
):
    path = tmp_path / f"file{ending or FORMATS[name].ending}"
    path.write_text(text, encoding="utf-8")
    assert recognised(path) == name
    for command in (
        ["map", "build", str(path)],
        ["simulate", "--set", f"stage.guide.file={path}"],
        ["stage", "new", str(tmp_path / "stage"), "--survey", str(path), "--yes"],
    ):
        assert main(command) != 0
        assert f"map convert {path} --format {name}" in capsys.readouterr().err
    assert main(["map", "convert", str(path), "--format", name, "-o", str(tmp_path / "s.csv")]) == 0

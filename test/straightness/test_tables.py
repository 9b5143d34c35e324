"""Files of instruments and controllers: what the makers' own examples say, and that nothing is lost on the way."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from straightcomp_ros.straightness.survey import SurveyError
from straightcomp_ros.straightness.tables.error_table import UNITS, Conventions, ErrorTable
from straightcomp_ros.straightness.tables.formats import FORMATS, WRITTEN, format_of

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


def _read(tmp_path: Path, name: str, text: str, conventions: Conventions = MM) -> ErrorTable:
    path = tmp_path / f"table{FORMATS[name].ending}"
    path.write_text(text, encoding="utf-8")
    return format_of(path, None).read(path, conventions)


@pytest.mark.parametrize(
    ("name", "x_mm", "forward_um"),
    [
        ("linuxcnc", [0, 10, 20], [0, 4, -2]),
        ("crosscomp", [1.0735, 1000], [-0.3, -100]),
        ("etalon", [-280, -270], [-1.358635132, -0.240680764]),
        ("aerotech", [100, 110.5, 121], [-1.5, -2.5, 3]),
    ],
)
def test_an_example_is_read_in_metres_as_the_deviation(
    tmp_path: Path, name: str, x_mm: list[float], forward_um: list[float]
) -> None:
    table = _read(tmp_path, name, EXAMPLES[name])
    np.testing.assert_allclose(table.x, np.array(x_mm) * 1e-3, rtol=1e-12)
    np.testing.assert_allclose(table.forward, np.array(forward_um) * 1e-6, rtol=1e-9, atol=1e-15)
    assert (table.backward is not None) == (name == "linuxcnc")


def test_a_table_in_inches_is_read_in_metres(tmp_path: Path) -> None:
    table = _read(tmp_path, "linuxcnc", EXAMPLES["linuxcnc"], Conventions("inch"))
    np.testing.assert_allclose(table.x, [0.0, 0.254, 0.508], rtol=1e-12)
    np.testing.assert_allclose(table.forward, np.array([0.0, 4.0, -2.0]) * 25.4e-6, rtol=1e-9, atol=1e-15)


def test_linuxcnc_trims_are_the_negative_of_the_deviation(tmp_path: Path) -> None:
    """LinuxCNC: trim = nominal - position, so both types of the file say the same."""
    trims = _read(tmp_path, "linuxcnc", "0 0 0\n10 -0.004 -0.006\n20 0.002 0\n")
    positions = _read(tmp_path, "linuxcnc", EXAMPLES["linuxcnc"])
    np.testing.assert_allclose(trims.forward, positions.forward, atol=1e-15)
    np.testing.assert_allclose(trims.backward, positions.backward, atol=1e-15)


_micrometres = st.integers(-50_000, 50_000).map(lambda nanometres: nanometres * 1e-9)


@pytest.mark.parametrize("name", WRITTEN)
@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    start_um=st.integers(-2_000_000, 2_000_000),
    step_um=st.integers(1000, 20_000),
    values=st.lists(st.tuples(_micrometres, _micrometres), min_size=2, max_size=60),
    unit=st.sampled_from(["mm", "inch"]),
    axes=st.permutations(range(1, 5)),
)
def test_what_is_written_is_read_again(
    tmp_path: Path, name: str, start_um: int, step_um: int, values: list, unit: str, axes: list[int]
) -> None:
    x = (start_um + step_um * np.arange(len(values))) * 1e-6
    forward, backward = np.array(values).T
    conventions = Conventions(unit, axes[0], axes[1])
    directed = name == "linuxcnc"
    written = FORMATS[name].write(ErrorTable(x, forward, backward if directed else None), conventions)
    table = _read(tmp_path, name, written, conventions)
    np.testing.assert_allclose(table.x, x, rtol=0.0, atol=3e-9)
    np.testing.assert_allclose(table.forward, forward, rtol=0.0, atol=3e-9)
    if directed:
        np.testing.assert_allclose(table.backward, backward, rtol=0.0, atol=3e-9)


def test_a_format_with_one_value_gets_the_mean_of_both_directions(tmp_path: Path) -> None:
    table = ErrorTable(np.array([0.0, 0.1]), np.array([1e-6, 2e-6]), np.array([3e-6, 6e-6]))
    for name in ("aerotech", "crosscomp", "etalon"):
        np.testing.assert_allclose(
            _read(tmp_path, name, FORMATS[name].write(table, MM)).forward, [2e-6, 4e-6], atol=1e-12
        )


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
        (
            "aerotech",
            ":START2D    3          1           1            2",
            ":START2D 3 1 1 4",
            ["axis 2", "1 over", "4 over"],
        ),
        ("aerotech", "0 1.5   0 2.5   0 -3", "0 1.5   0 2.5   0 -4", ["row axis"]),
        ("aerotech", "0 -3\n", "\n", ["10 values", "3 × 2"]),
        ("aerotech", "PRIMARY/1000", "COUNTS", ["COUNTS", "METRIC"]),
        ("aerotech", ":START2D    3", ":START    3", [":START2D"]),
    ],
)
def test_a_fault_is_named(tmp_path: Path, name: str, old: str, new: str, words: list[str]) -> None:
    assert EXAMPLES[name].count(old) == 1
    with pytest.raises(SurveyError) as caught:
        _read(tmp_path, name, EXAMPLES[name].replace(old, new))
    assert f"table{FORMATS[name].ending}" in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_a_table_becomes_a_survey_only_with_lengths_that_a_guide_has() -> None:
    table = ErrorTable(np.linspace(0.0, 1.0, 30), np.sin(np.arange(30)) * 1e-6)
    assert [run.direction for run in table.to_survey("a").runs] == ["forward"]
    in_the_wrong_unit = ErrorTable(table.x * UNITS["mm"], table.forward)
    with pytest.raises(SurveyError, match="a: x_m extends over 1000 m"):
        in_the_wrong_unit.to_survey("a")


def test_too_many_points_for_a_controller_are_refused() -> None:
    table = ErrorTable(np.arange(2000) * 1e-3, np.zeros(2000))
    for name, most in (("linuxcnc", "256"), ("crosscomp", "1001")):
        with pytest.raises(SurveyError, match=most):
            FORMATS[name].write(table, MM)


def test_an_unknown_ending_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(SurveyError, match=r"\.cal \(aerotech\)"):
        format_of(Path("table.xyz"), None)
    assert format_of(Path("table.xyz"), "etalon") is FORMATS["etalon"]

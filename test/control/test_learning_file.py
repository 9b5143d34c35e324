"""What was learned survives a restart; a file that is damaged or meant for another law is refused in one sentence."""

import json
import math

import numpy as np
import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.control.learned_table import LearnedTable, LearningFileError, read_tables, write_tables

SPACING = 0.25e-3


def tables() -> dict[bool, LearnedTable]:
    return {forward: LearnedTable(SPACING, 0.05) for forward in (True, False)}


def learned() -> dict[bool, LearnedTable]:
    random = np.random.default_rng(2)
    filled = tables()
    for forward, first, count in ((True, -8, 60), (False, 4, 30)):
        squares = random.uniform(1e-16, 1e-14, count)
        squares[:4] = math.nan
        # As in every table, the correction fades out over the nodes at its ends.
        coefficients = np.pad(random.uniform(-1e-6, 1e-6, count - 8), 4)
        filled[forward].restore(first, coefficients, squares, 2.0 * squares, np.full(count, 0.2))
    return filled


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "learned.csv"
    write_tables(path, "smc", learned())
    return path


def test_a_file_gives_back_what_was_written(file):
    again, expected = tables(), learned()
    read_tables(file, "smc", again)
    for forward in (True, False):
        for x in np.linspace(-3e-3, 0.02, 40).tolist():
            assert again[forward].at(x, 0.2) == pytest.approx(expected[forward].at(x, 0.2), rel=1e-4, abs=1e-11)
    size = expected[True].best.size
    np.testing.assert_allclose(again[True].best_square[:size], expected[True].best_square, rtol=1e-5)
    np.testing.assert_allclose(again[True].bare_square[:size], expected[True].bare_square, rtol=1e-5)
    assert np.isnan(again[False].best_square[:12]).all()  # before its first node, and where nothing was learned
    second = file.with_name("second.csv")
    write_tables(second, "smc", again)
    assert second.read_text() == file.read_text()


def test_tables_in_which_nothing_was_learned_leave_no_file(tmp_path):
    write_tables(tmp_path / "none.csv", "smc", tables())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda text: text.replace("# law: smc", "# law: linear"), "learned with law 'linear'; allowed: '# law: smc'"),
        (lambda text: text.replace("# law: smc\n", ""), "names no law"),
        (lambda text: text.replace("x_m,", "x,"), "header 'x,forward"),
        (lambda text: "\n".join(text.splitlines()[:4]), "no rows"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.0017,"), "line 6: x_m -0.0017; allowed: -0.00175"),
        (lambda text: text.replace("\n-0.00175,", "\nnan,"), "line 6: x_m 'nan'; allowed: a finite number"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.00175,x"), "line 6: forward_correction_m 'x"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.00175,1"), "line 6: forward_correction_m '1"),
        (lambda text: text.replace("\n-0.00175,", "\n-0.00175,,"), "line 6: 10 cells; allowed: 9"),
    ],
)
def test_a_damaged_file_is_refused_with_the_place_and_what_is_allowed(file, change, message):
    text = file.read_text()
    file.write_text(change(text))
    assert file.read_text() != text
    with pytest.raises(LearningFileError) as refused:
        read_tables(file, "smc", tables())
    assert message in str(refused.value) and str(file) in str(refused.value)


@pytest.mark.parametrize("content", [b"\xff\xfe", None], ids=["binary", "folder"])
def test_a_file_that_is_no_text_is_refused(tmp_path, content):
    path = tmp_path / "learned.csv"
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(LearningFileError, match=r"learned\.csv: "):
        read_tables(path, "smc", tables())


SHORT = [f"--set=stage.motion.{name}" for name in ("stroke=0.05", "settle=0.2", "pause=0.1")]


def test_the_command_runs_strokes_keeps_what_it_learned_and_goes_on_from_there(tmp_path, capsys):
    path = tmp_path / "learned.csv"
    command = ["simulate", "--law", "linear", "--learned", str(path), "--json", *SHORT]
    assert main([*command, "--strokes", "4"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert [set(cycle) for cycle in first["cycles"]] == [{"true_pp_um", "true_rms_um", "verdict", "reason"}] * 4
    assert first["cycles"][-1]["true_rms_um"] == first["true_rms_um"] < 0.75 * first["cycles"][0]["true_rms_um"]
    assert main(command) == 0
    second = json.loads(capsys.readouterr().out)
    assert "cycles" not in second
    assert second["true_rms_um"] < 0.75 * first["cycles"][0]["true_rms_um"]


def test_strokes_without_learning_print_a_table_and_no_file(tmp_path, capsys):
    assert main(["simulate", "--strokes", "2", *SHORT]) == 0
    assert "cycle to cycle" in capsys.readouterr().out.replace("\n", " ").replace("  ", " ")


def test_the_command_refuses_a_wrong_file_and_a_wrong_number_of_strokes(file, capsys):
    assert main(["simulate", "--law", "linear", "--learned", str(file), *SHORT]) == 2
    assert "learned with law 'smc'" in capsys.readouterr().err
    assert main(["simulate", "--strokes", "0", *SHORT]) == 2
    assert "--strokes 0; allowed: >= 1" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_is_said_so(tmp_path, capsys):
    assert main(["simulate", "--learned", str(tmp_path / "absent" / "learned.csv"), *SHORT]) == 2
    assert "absent" in capsys.readouterr().err

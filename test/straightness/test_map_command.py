"""`straightcomp map`: from the map to a controller's table and back, and its refusals."""

import json
from pathlib import Path

import numpy as np
import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.tables.formats import FORMATS, WRITTEN


@pytest.mark.parametrize("name", WRITTEN)
def test_the_exported_map_comes_back_as_the_same_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    table, survey = tmp_path / f"table{FORMATS[name].ending}", tmp_path / "survey.csv"
    assert main(["map", "export", "-o", str(table), "--json"]) == 0
    exported = json.loads(capsys.readouterr().out)
    assert main(["map", "convert", str(table), "-o", str(survey), "--json"]) == 0
    converted = json.loads(capsys.readouterr().out)
    assert exported["points"] == converted["points"] == 177
    original, again = load_map(), load_map(MapParameters(file=str(survey)))
    x = np.linspace(*original.span, 5000)
    assert np.abs(again.evaluate(x)[0] - original.evaluate(x)[0]).max() < 0.02e-6
    assert exported["interpolation_error_um"] < 0.1


def test_negate_turns_the_sign_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in ([], ["--negate"]):
        assert main(["map", "export", "-o", str(tmp_path / f"{len(option)}.comp"), *option]) == 0
    plain, negated = (np.loadtxt(tmp_path / f"{count}.comp") for count in (0, 1))
    np.testing.assert_allclose(plain[:, 1:], -negated[:, 1:])
    np.testing.assert_allclose(plain[:, 1], load_map().evaluate(plain[:, 0] * 1e-3)[0] * 1e3, atol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["export", "-o", "table.xyz"], ["table.xyz", ".comp (linuxcnc)"]),
        (["export", "-o", "t.comp", "--spacing", "1"], ["1761 points", "256"]),
        (["export", "-o", "t.comp", "--spacing", "0"], ["--spacing 0", "0.1 to 1000 mm"]),
        (["export", "-o", "t.cal", "--stage-axis", "2"], ["--platform-axis", "two"]),
        (["export", "-o", "t.cal", "--survey", "no.csv"], ["no.csv"]),
        (["export", "-o", "no_folder/t.cal"], ["no_folder/t.cal", "no folder no_folder"]),
        (["convert", "no.comp", "-o", "o.csv"], ["no.comp", "cannot be read"]),
    ],
)
def test_a_refusal_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list, words: list
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["map", *arguments]) in (1, 2)
    printed = capsys.readouterr().err
    assert printed.startswith(f"straightcomp map {arguments[0]}: ")
    assert printed.count("\n") == 1
    for word in words:
        assert word in printed

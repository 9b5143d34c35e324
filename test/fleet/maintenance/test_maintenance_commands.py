"""`straightcomp history advise`, `report` and `map`: what they write and print, and how they refuse."""

import json
import shutil
from pathlib import Path

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.output_files import MARK
from straightcomp_ros.stage.due_maintenance import read_advice


def test_advise_writes_a_file_for_each_stage(worn, tmp_path, capsys):
    assert main(["history", "advise", str(worn), "-o", str(tmp_path / "advice")]) == 0
    told = capsys.readouterr().out
    assert "regrease" in told and "the guide moved from x = " in told
    files = sorted(path.name for path in (tmp_path / "advice").glob("[!.]*"))
    assert files == [f"{name}.json" for name in ("amplifier", "bolt", "friction", "guide", "latency", "scale", "sound")]
    assert "bolts" in read_advice(tmp_path / "advice" / "bolt.json").text


def test_advise_prints_one_json_object(worn, capsys):
    assert main(["history", "advise", str(worn), "--stage", "latency", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["stages"]
    assert list(told) == ["latency"] and told["latency"]["advice"][0]["cause"] == "host"


def test_since_begins_a_new_baseline(worn, capsys):
    assert main(["history", "advise", str(worn), "--stage", "latency", "--since", "2026-03-05", "--json"]) == 0
    causes = [one["cause"] for one in json.loads(capsys.readouterr().out)["stages"]["latency"]["advice"]]
    assert "host" not in causes


def test_a_report_is_one_file_that_loads_nothing(worn, tmp_path, capsys):
    words = ["history", "report", str(worn), "--stage", "guide", "-o", str(tmp_path), "--json"]
    assert main(words) == 0
    (file,) = json.loads(capsys.readouterr().out)["reports"].values()
    page = Path(file).read_text("utf-8")
    own = page.replace(page[page.index("<script>") : page.index("</script>")], "")
    assert "src=" not in own and "href=" not in own and "@import" not in own
    for words in ("What needs attention", "the guide moved", "Change of the guide over x", "Trends", "Bags to look at"):
        assert words in own


def test_names_of_stages_cannot_leave_the_folder_or_the_page(worn, tmp_path, capsys):
    store = tmp_path / "store"
    shutil.copytree(worn / "strokes" / "stage=sound", store / "strokes" / "stage=..%2F%3Cb%3E")
    assert main(["history", "report", str(store), "-o", str(tmp_path / "report")]) == 0
    assert main(["history", "advise", str(store), "-o", str(tmp_path / "report")]) == 0
    assert len([path for path in (tmp_path / "report").iterdir() if path.name != MARK]) == 2
    (page,) = (tmp_path / "report").glob("*.html")
    assert "Stage “../&lt;b&gt;”" in page.read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["advise", "STORE", "--stage", "none"], 2, "its stages are: amplifier, bolt"),
        (["advise", "STORE", "--since", "soon"], 2, "allowed: a date as"),
        (["advise", "STORE", "--since", "2030-01-01"], 1, "no strokes since 2030-01-01"),
        (["advise", "EMPTY"], 1, "has no strokes"),
        (["report", "STORE", "-o", "FILE"], 2, "is a file"),
        (["map", "STORE", "sound", "--map", "none.csv"], 2, "there is no such file"),
        (["map", "STORE", "sound", "--map", "config/survey_synthetic.csv"], 1, "with another map"),
        (["map", "STORE", "sound", "--map", "config/survey_synthetic.csv", "--days", "0"], 2, "allowed"),
    ],
)
def test_wrong_use_gets_one_sentence(worn, tmp_path, capsys, words, code, told):
    (tmp_path / "file").touch()
    places = {"STORE": str(worn), "EMPTY": str(tmp_path), "FILE": str(tmp_path / "file")}
    try:
        found = main(["history", *(places.get(word, word) for word in words)])
    except SystemExit as ended:
        found = ended.code
    error = capsys.readouterr().err
    assert found == code and told in error and "Traceback" not in error


def test_a_present_map_is_never_replaced(worn, tmp_path, capsys):
    survey = tmp_path / "survey.csv"
    survey.write_text("kept")
    words = ["history", "map", str(worn), "sound", "--map", str(survey), "-o", str(survey), "--force"]
    assert main(words) == 2 and "name another file" in capsys.readouterr().err
    assert survey.read_text() == "kept"

"""`straightcomp history`: what it prints, and how it refuses."""

import json
import shutil
import sys

import pytest
from stores import COUNT, SAMPLES

from straightcomp_ros.cli.main import main


def test_add_tells_what_it_added_and_fails_while_it_refuses(months, tmp_path, capsys):
    store = str(tmp_path / "store")
    assert main(["history", "add", str(months), "-o", store, "--jobs", "1", "--json"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out) == {"store": store, "added": COUNT, "known": 0, "refused": 2, "strokes": 2 * COUNT}
    assert told.err.count("refused: bag ") == 2 and "SELECT * FROM refused" in told.err
    assert main(["history", "add", str(months), "-o", store]) == 0
    assert f"added 0, known and unchanged {COUNT + 2}, refused 0; strokes added 0" in capsys.readouterr().out


def test_a_query_prints_one_json_object_with_times_as_iso(alone, capsys):
    sql = "SELECT min(start) AS first, count(*) AS strokes, 0.0 / 0.0 AS none FROM strokes"
    assert main(["history", "query", str(alone[0]), sql, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row == {"first": "2025-10-09T08:53:20.203500+00:00", "strokes": 2 * COUNT, "none": None}


def test_a_query_without_a_store_asks_the_default_one(alone, capsys, tmp_path, monkeypatch):
    (tmp_path / "history").symlink_to(alone[0])
    monkeypatch.chdir(tmp_path)
    assert main(["history", "query", "SELECT DISTINCT stage FROM strokes ORDER BY stage"]) == 0
    assert "stage_0" in capsys.readouterr().out


def test_the_bins_are_a_table_of_their_own(alone, capsys):
    sql = "SELECT count(*) AS n, min(x_mm) AS first, max(x_mm) AS last, count(error_um) AS known FROM bins"
    assert main(["history", "query", str(alone[0]), sql, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == [
        {"n": 40 * COUNT, "first": 0, "last": 190, "known": 40 * COUNT}
    ]


def test_rows_with_many_columns_are_printed_one_below_the_other(alone, capsys):
    assert main(["history", "query", str(alone[0]), "SELECT * FROM strokes LIMIT 2"]) == 0
    told = capsys.readouterr().out
    assert "row 1 of 2" in told and "row 2 of 2" in told and "control_activity_A" in told


def test_a_statement_may_write_a_table_elsewhere(alone, tmp_path, capsys):
    file = tmp_path / "figures.csv"
    assert main(["history", "query", str(alone[0]), f"COPY (SELECT stroke FROM strokes) TO '{file}'"]) == 0
    assert len(file.read_text().split()) == 1 + 2 * COUNT
    file.write_text("mine")
    inside = next(alone[0].rglob("*.parquet"))
    for name, *more in ((file,), (inside, "--force")):
        before = name.read_bytes()
        copy = f"SELECT 1; copy (SELECT stroke FROM strokes)\nto  '{name}'"
        assert main(["history", "query", str(alone[0]), copy, *more]) == 2
        assert name.read_bytes() == before
    assert main(["history", "query", str(alone[0]), "CREATE TABLE mine (a INTEGER)"]) == 0


def test_a_store_of_refused_bags_alone_has_a_table_of_strokes_without_rows(tmp_path, capsys):
    store = str(tmp_path / "store")
    assert main(["history", "add", str(SAMPLES / "cut_off"), "-o", store]) == 1
    capsys.readouterr()
    assert main(["history", "query", store, "SELECT stage, start FROM strokes", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"rows": []}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("add none", "none does not exist; give a bag, a folder of bags"),
        ("add empty", "empty: no bag is there; allowed: a bag, or a folder with bags below it"),
        ("add {bag} -o file", "store file: is a file; name a folder"),
        ("add {bag} -o nonsense://x", "nonsense://x: Protocol not known"),
        ("add {bag} --jobs 0", "'0'; allowed: a whole number >= 1"),
        ("add {bag} --dask here", "'here'; allowed: HOST:PORT"),
        ("add {bag} --every 0", "--every 0; allowed: 0.1 to"),
        ("query none SELECT", "store none: no bag was added there; make it: straightcomp history add BAG -o none"),
        ("query {store} SELEC", "query: Parser Error"),
        ("query {store} FROM_nowhere", "query: Parser Error"),
        ("query", "required: SQL"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(words, told, alone, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    given = words.format(bag=SAMPLES / "smc", store=alone[0]).split()
    try:
        code = main(["history", *given])
    except SystemExit as refused:
        code = refused.code
    assert code == 2
    said = capsys.readouterr().err
    assert told in said and "Traceback" not in said


@pytest.mark.parametrize(
    ("module", "words"), [("pyarrow", "add {bag}"), ("fsspec", "add {bag}"), ("duckdb", "query {store} SELECT")]
)
def test_a_package_that_is_missing_is_named_with_the_remedy(module, words, alone, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.chdir(tmp_path)
    given = words.format(bag=SAMPLES / "smc", store=alone[0]).split()
    assert main(["history", *given]) == 2
    told = capsys.readouterr().err
    assert module in told and "pip install 'straightcomp_ros[history]'" in told


def test_a_store_that_cannot_be_written_is_an_error_and_no_refused_bag(tmp_path, capsys):
    store = tmp_path / "store"
    shutil.copytree(SAMPLES / "smc", tmp_path / "run")
    store.mkdir()
    (store / "strokes").write_text("in the way")
    assert main(["history", "add", str(tmp_path / "run"), "-o", str(store)]) == 1
    told = capsys.readouterr().err
    assert "strokes" in told and "Traceback" not in told and not list(store.rglob("*.parquet"))

"""`straightcomp history`: what it prints and writes, how it refuses, and bags with any names and parameters."""

import json
import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from generated_bags import run, write_bag
from places import BAGS, SMC
from stores import COUNT, added, files_of
from tiers import nightly
from yaml_bomb import BOMB

from straightcomp_ros.bags import PARAMETERS_ATTACHMENT
from straightcomp_ros.fleet.history.rows import stored_name
from straightcomp_ros.fleet.history.store import Store
from straightcomp_ros.fleet.maintenance.stage_report import over_time
from straightcomp_ros.parameters.output_files import MARK
from straightcomp_ros.stage.due_maintenance import read_advice
from trials.wear import SOUND, WEARS


@pytest.fixture
def history(verb):
    """Runs a verb of `straightcomp history`."""
    return partial(verb, "history")


def test_add_tells_what_it_added_and_a_folder_may_hold_bags_that_are_refused(months, tmp_path, history):
    store = tmp_path / "store"
    first = history("add", months, "-o", store, "--jobs", 1, "--json")
    assert first.code == 0 and first.err.count("refused: bag ") == 2
    assert first.json == {"store": str(store), "added": COUNT, "known": 0, "refused": 2, "strokes": 2 * COUNT}
    code, out, err = history("add", months, "-o", store)
    assert code == 0 and f"added 0, known and unchanged {COUNT + 2}, refused 0; strokes in those added: 0" in out
    assert err == f"written: {store}\nnext: straightcomp history advise {store}\n"


def test_a_named_bag_that_was_refused_is_refused_as_long_as_it_is_unchanged(tmp_path, history):
    store, bag = tmp_path / "store", tmp_path / "bags" / "run"
    shutil.copytree(BAGS / "cut_off", bag)
    refused = [history("add", bag, "-o", store) for _ in range(2)]
    assert all(one.code == 1 and "bags refused: 1; the reasons: " in one.err for one in refused)
    assert all("FROM refused" in one.err for one in refused)
    assert ["refused: bag " in one.err for one in refused] == [True, False]
    assert history("add", bag.parent, "-o", store).code == 0


@pytest.mark.parametrize(
    "sql, row",
    [
        (
            "SELECT min(start) AS first, count(*) AS strokes, 0.0 / 0.0 AS none FROM strokes",
            {"first": "2025-10-09T08:53:20.203500+00:00", "strokes": 2 * COUNT, "none": None},
        ),
        (
            "SELECT count(*) AS n, min(x_mm) AS first, max(x_mm) AS last, count(error_um) AS known FROM bins",
            {"n": 40 * COUNT, "first": 0, "last": 190, "known": 40 * COUNT},
        ),
        (
            "SELECT sum(stroke) AS whole, {'of': sum(stroke)} AS inside, 2.50 AS decimal FROM strokes",
            {"whole": 3 * COUNT, "inside": {"of": 3 * COUNT}, "decimal": 2.5},
        ),
    ],
)
def test_a_query_prints_one_json_object_with_times_as_iso_and_the_bins_are_a_table(alone, history, sql, row):
    assert history("query", alone[0], sql, "--json").json == {"rows": [row]}


def test_a_store_of_refused_bags_alone_has_a_table_of_strokes_without_rows(tmp_path, history):
    assert history("add", BAGS / "cut_off", "-o", tmp_path).code == 1
    assert history("query", tmp_path, "SELECT stage, start FROM strokes", "--json").json == {"rows": []}


def test_a_query_without_a_store_asks_the_default_one_and_prints_many_columns_below_each_other(
    alone, history, tmp_path, monkeypatch
):
    (tmp_path / "history").symlink_to(alone[0])
    monkeypatch.chdir(tmp_path)
    code, printed, _ = history("query", "SELECT * FROM strokes ORDER BY stage LIMIT 2")
    assert code == 0
    assert all(words in printed for words in ("rows: 2", "\n  control_activity_A: ", "\n  stage: stage_0"))


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT 1; copy (SELECT stroke FROM strokes)\nto  '{}'",
        "SET VARIABLE f = '{}'; COPY strokes TO (getvariable('f'))",
        "EXPLAIN ANALYZE COPY strokes TO E'{}'",
        "PREPARE mine AS COPY strokes TO E'{}'; EXECUTE mine",
        "EXPORT DATABASE 'file://{}'",
        "COPY (PIVOT strokes ON law USING max(stroke)) TO '{}'",
        "SET enable_profiling = 'json'; SET profiling_output = '{}'; SELECT 1",
        "SELECT * FROM query('COPY strokes TO $${}$$')",
        "FROM enable_profiling(format='json', save_location='{}'); SELECT 1",
        "FROM enable_logging(storage='file', storage_path='{}'); SELECT 1",
        "-- {}",
    ],
)
def test_a_query_only_reads(alone, tmp_path, history, statement):
    (file := tmp_path / "figures.csv").write_text("mine")
    for name in (file, tmp_path / "new", next(alone[0].rglob("*.parquet"))):
        assert history("query", alone[0], statement.format(name)).code == 2
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("figures.csv", "mine")]
    assert files_of(alone[0]) == alone[1]


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        ("add empty", 2, "empty: no bag is there; allowed: a bag, or a folder with bags below it"),
        ("add {bag} -o file", 2, "store file: is a file; name a folder"),
        ("add {bag} -o nonsense://x", 2, "store nonsense://x: is a URL; name a folder"),
        ("query {store} SELEC", 2, "query: Parser Error"),
        ("advise {worn} --name none", 2, "its stages are: amplifier, bolt"),
        ("advise {worn} --since soon", 2, "allowed: a date as"),
        ("advise {worn} --since 2030-01-01", 1, "no strokes since 2030-01-01"),
        ("advise empty", 2, "has no strokes"),
        ("report {worn} -o file", 2, "is a file"),
        ("map {worn} sound --survey config/survey_synthetic.csv", 1, "with another map"),
        ("map {worn} sound --survey config/survey_synthetic.csv --days 0", 2, "allowed"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(words, code, sentence, alone, worn, tmp_path, monkeypatch, history):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    found = history(*words.format(bag=SMC, store=alone[0], worn=worn).split())
    assert found.code == code and sentence in found.err and "Traceback" not in found.err


def test_a_store_that_cannot_be_written_is_an_error_and_no_refused_bag(tmp_path, history):
    store = tmp_path / "store"
    store.mkdir()
    (store / "strokes").write_text("in the way")
    code, _, said = history("add", SMC, "-o", store)
    assert code == 1 and "strokes" in said and "Traceback" not in said and not list(store.rglob("*.parquet"))


def test_advise_writes_a_file_for_each_stage_and_since_begins_a_new_baseline(worn, tmp_path, history):
    code, printed, _ = history("advise", worn, "-o", tmp_path)
    assert code == 0 and "regrease" in printed and "the guide moved from x = " in printed
    assert {file.stem for file in tmp_path.glob("[!.]*.json")} == {wear.name for wear in (SOUND, *WEARS)}
    assert "bolts" in read_advice(tmp_path / "bolt.json")
    whole, since = (
        history("advise", worn, "--name", "latency", "--json", *words).json["stages"]["latency"]["advice"]
        for words in ((), ("--since", "2026-03-05"))
    )
    assert whole[0]["cause"] == "host" and "host" not in {one["cause"] for one in since}


def test_a_report_is_one_file_that_loads_nothing(worn, tmp_path, history):
    (file,) = history("report", worn, "--name", "guide", "-o", tmp_path, "--json").json["reports"].values()
    page = Path(file).read_text("utf-8")
    own = page.replace(page[page.index("<script>") : page.index("</script>")], "")
    assert not any(words in own for words in ("src=", "href=", "@import"))
    for heading in ("Change of the guide over x", "Trends", "Straightness (ISO 230-1)", "Bags to look at"):
        assert heading in own
    assert "the guide moved" in own


def test_each_page_is_written_before_the_next_one_is_made(worn, tmp_path, history, monkeypatch):
    there = list[int]()

    def page(stage, strokes):
        there.append(len(list(tmp_path.glob("*.html"))))
        return stage

    monkeypatch.setattr("straightcomp_ros.fleet.maintenance.stage_report.stage_report", page)
    assert history("report", worn, "-o", tmp_path).code == 0
    assert len(there) > 1 and there == list(range(len(there)))


def test_a_stage_that_was_idle_since_a_day_does_not_keep_the_others_from_their_pages(tmp_path, history):
    for number in (0, 9):
        write_bag(tmp_path / "bags" / f"{number}", number, stages=2)
    added(tmp_path / "store", tmp_path / "bags")
    since = tmp_path / "store", "--since", "2025-10-10"
    for verb, ending in (("report", ".html"), ("advise", ".json")):
        found = history(verb, *since, "-o", tmp_path / verb)
        assert found.code == 0 and "'stage_0' has no strokes since 2025-10-10" in found.err
        assert [file.name for file in (tmp_path / verb).glob(f"[!.]*{ending}")] == [f"stage_1{ending}"]
        found = history(verb, *since, "-o", tmp_path / "none", "--name", "stage_0")
        assert found.code == 1 and "no strokes since 2025-10-10 of stage_0" in found.err
    assert history("report", tmp_path / "store", "--since", "2025-10-12", "-o", tmp_path / "none").code == 1
    # As a damaged file is to be removed.
    for file in (tmp_path / "store").glob("strokes/*/*/strokes.parquet"):
        file.unlink()
    found = history("report", tmp_path / "store", "-o", tmp_path / "none")
    assert found.code == 1 and "'stage_0' has no strokes\n" in found.err
    assert not any((tmp_path / "none").iterdir())


def test_the_colours_over_x_and_time_leave_weeks_without_strokes_empty(make_levels):
    levels = make_levels()
    kept = np.flatnonzero((levels.day < levels.day[0] + 10) | (levels.day >= levels.day[0] + 40))
    profiles = levels.profiles["error_bins_um"][kept]
    (colours,) = over_time(replace(levels, day=levels.day[kept]), profiles).data
    days = np.array(colours.x, "datetime64[D]").astype(int)
    assert set(np.diff(days)) == {7} and days[0] == levels.day[0]
    empty = ~np.isfinite(np.array(colours.z)).any(axis=0)
    assert [days[0] + 14, days[0] + 21, days[0] + 28] == days[empty].tolist() and np.isfinite(
        colours.z[:, ~empty]
    ).all()


NAMES = ["轴" * 28, "ü" * 300 + "1", "ü" * 300 + "2", "[/x]", "gantry[left]", "gantry[right]", "a/../b", ".."]
NAMES += [r"\frac{$", "<b>bold</b>", "%41", "A", "\x1b[2Jx", "2026-99-99", "007"]


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """A store with a bag of each of NAMES, and its tally."""
    folder = tmp_path_factory.mktemp("named")
    text = run()[1][PARAMETERS_ATTACHMENT].decode()
    for number, name in enumerate(NAMES):
        parameters = text.replace("stage.name: synthetic", f"stage.name: {json.dumps(name)}")
        write_bag(folder / "bags" / f"{number:02}", number, parameters=parameters)
    return folder / "store", added(folder / "store", folder / "bags")


def test_each_stage_has_a_folder_of_its_own_whatever_it_is_called(named):
    folder, tally = named
    store, folders = Store(str(folder)), list((folder / "strokes").iterdir())
    assert (tally.added, tally.refused) == (len(NAMES), 0)
    assert store.stages() == sorted(map(stored_name, NAMES)) and len(set(store.stages())) == len(NAMES)
    assert all(store.strokes(name).num_rows == 2 for name in NAMES)
    found = [sorted(store.query(f"SELECT DISTINCT stage FROM {of}")["stage"].to_pylist()) for of in ("strokes", "bags")]
    assert found == [store.stages()] * 2
    assert len(folders) == len(NAMES) and max(len(os.fsencode(folder.name)) for folder in folders) < 255


def test_files_reports_and_tables_show_each_name_as_it_is(named, tmp_path, history):
    """None leaves its folder or its page."""
    store, whole, one = named[0], tmp_path / "report", tmp_path / "one"
    printed = [history("advise", store, "-o", whole), history("report", store, "-o", whole)]
    pages = {file.name: file.read_text(encoding="utf-8") for file in whole.glob("*.html")}
    assert len(pages) == len(NAMES) and len(list(whole.iterdir())) == 2 * len(NAMES) + len([MARK])
    assert not any("<b>bold" in page for page in pages.values())
    assert sum("Stage “&lt;b&gt;bold" in page for page in pages.values()) == 1
    printed.append(history("report", store, "-o", one, "--name", NAMES[1]))
    assert {file.name for file in one.glob("*.html")} < set(pages)
    table = history("query", store, "SELECT stage, count(*) AS n FROM strokes GROUP BY stage")
    assert [each.code for each in (*printed, table)] == [0] * 4
    printed = "".join(each.out for each in printed)
    for text, own in ((printed, "\\x1b[2Jx"), (table.out, "<b>bold</b>")):
        assert all(name in text for name in ("gantry[left]", "gantry[right]", "[/x]", own)) and "\x1b" not in text


@pytest.mark.parametrize("jobs", [1, *nightly([2])])
def test_a_bag_that_cannot_be_added_is_listed_and_the_next_ones_are_added(tmp_path, history, jobs):
    good = run()[1][PARAMETERS_ATTACHMENT].decode()
    cases = {"a": good, "b": BOMB, "c": good, "d": "x: " + "[" * 400, "e[/x]": "[/x]: 1", "f": good}
    for number, (name, parameters) in enumerate([*cases.items(), (os.fsdecode(b"g\xff"), good)]):
        write_bag(tmp_path / "bags" / name, number, parameters=parameters)
    command = ["add", tmp_path / "bags", "-o", tmp_path / "store", "--jobs", jobs, "--json"]
    first = history(*command)
    assert first.code == 0 and first.json.items() >= {"added": 4, "refused": 3}.items()
    assert first.err.count("refused: bag ") == 3 and "e[/x]" in first.err
    assert history(*command).json.items() >= {"added": 0, "known": 7, "refused": 0}.items()

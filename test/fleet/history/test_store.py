"""A store is the same whoever makes it, in whatever order, however often, and whatever interrupts."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import duckdb
import pandas
import polars
import pyarrow.dataset
import pytest
from stores import COUNT, SAMPLES, added, files_of

from straightcomp_ros.fleet.history import HistoryError
from straightcomp_ros.fleet.history.bag_places import bags_in
from straightcomp_ros.fleet.history.queries import query
from straightcomp_ros.fleet.history.rows import BagRow, StrokeRow, columns_of, schema_of, table_of
from straightcomp_ros.fleet.history.store import Store


def command(months, store, *more):
    return [sys.executable, "-m", "straightcomp_ros.cli.main", "history", "add", str(months), "-o", str(store), *more]


def test_each_bag_has_a_file_by_stage_and_month_and_a_row(alone):
    store, files = alone
    strokes = [name for name in files if name.startswith("strokes/")]
    assert len(strokes) == COUNT and len(files) == 2 * COUNT + 2
    assert {name.split("/")[1] for name in strokes} == {"stage=stage_0", "stage=stage_1"}
    assert {name.split("/")[2] for name in strokes} == {"month=2025-10"}
    assert Store(str(store)).stages() == ["stage_0", "stage_1"]


def test_adding_the_same_bags_again_changes_nothing(months, alone):
    store, files = alone
    again = added(store, months)
    assert (again.added, again.refused, again.known) == (0, 0, COUNT + 2) and files_of(store) == files
    evaluated_again = added(store, months, again=True)
    assert (evaluated_again.added, evaluated_again.refused) == (COUNT, 2) and files_of(store) == files


def test_refused_bags_are_listed_with_the_reason(months, alone):
    store, _ = alone
    rows = query(Store(str(store)), "SELECT location, reason FROM refused ORDER BY location").to_pylist()
    assert [row["location"] for row in rows] == [str(months / "cut_off"), str(months / "damaged")]
    assert "was not finished" in rows[0]["reason"] and "straightcomp recover" in rows[0]["reason"]
    assert "is damaged at byte" in rows[1]["reason"]


def test_two_processes_make_the_store_that_one_makes(months, alone, tmp_path):
    assert added(tmp_path, months, jobs=2).added == COUNT
    assert files_of(tmp_path) == alone[1]


def test_dask_workers_make_the_store_that_this_machine_makes_to_the_last_bit(months, alone, tmp_path, scheduler):
    assert added(tmp_path, months, dask=scheduler).added == COUNT
    assert files_of(tmp_path) == alone[1]


def test_several_processes_may_add_to_one_store_at_once(months, alone, tmp_path):
    """Each would add all bags: they meet at every file."""
    processes = [subprocess.Popen(command(months, tmp_path, "--jobs", "1"), stderr=subprocess.PIPE) for _ in range(3)]
    told = [process.communicate()[1].decode() for process in processes]
    # A process that found all bags known has refused none.
    assert {process.returncode for process in processes} <= {0, 1}, told
    assert not any("Traceback" in text for text in told), told
    assert files_of(tmp_path) == alone[1]


def test_a_store_survives_kills_at_any_moment(months, alone, tmp_path):
    chance, kills = random.Random(5), 0
    while kills < 6:
        process = subprocess.Popen(
            command(months, tmp_path, "--jobs", "1"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        before = len(files_of(tmp_path))
        # The start of the program takes longer than all bags: begin to count when it writes.
        while len(files_of(tmp_path)) == before and process.poll() is None:
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.05))
        process.send_signal(signal.SIGKILL)
        process.wait()
        kills += 1
        whole = files_of(tmp_path)
        assert whole.items() <= alone[1].items(), "a file is there that is not whole"
        # As if the kill had come before the last file: what is left for the next process.
        for name in list(whole)[-2:]:
            os.unlink(tmp_path / name)
    added(tmp_path, months)
    assert files_of(tmp_path) == alone[1]


def test_what_a_killed_process_left_half_written_is_removed_by_a_later_one(tmp_path):
    parts = tmp_path / ".parts"
    parts.mkdir(parents=True)
    abandoned, fresh = parts / "1-a", parts / "2-b"
    for part in (abandoned, fresh):
        part.write_bytes(b"half a fi")
    os.utime(abandoned, (time.time() - 3600.0,) * 2)
    Store(str(tmp_path)).clear_abandoned()
    assert not abandoned.exists() and fresh.exists()


def test_a_copy_of_a_bag_adds_a_place_and_no_strokes(tmp_path):
    for name in ("first", "second"):
        shutil.copytree(SAMPLES / "smc", tmp_path / "bags" / name)
    tally = added(tmp_path / "store", tmp_path / "bags")
    store = Store(str(tmp_path / "store"))
    assert tally.added == 2 and query(store, "SELECT count(*) AS n FROM strokes").to_pylist() == [{"n": 2}]
    assert query(store, "SELECT count(*) AS n, count(DISTINCT checksum) AS k FROM bags").to_pylist() == [
        {"n": 2, "k": 1}
    ]


def test_a_bag_that_was_refused_is_added_when_its_recording_has_been_finished(tmp_path):
    bag, store = tmp_path / "run", tmp_path / "store"
    shutil.copytree(SAMPLES / "cut_off", bag)
    assert added(store, bag).refused == 1
    shutil.rmtree(bag)
    shutil.copytree(SAMPLES / "smc", bag)
    assert added(store, bag).added == 1
    assert query(Store(str(store)), "SELECT * FROM refused").num_rows == 0


def test_a_bag_that_could_not_be_read_is_tried_again(tmp_path, monkeypatch):
    place = next(bags_in(str(SAMPLES / "smc")))

    def unplugged(*_):
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr("straightcomp_ros.fleet.history.adding.checksum_of", unplugged)
        assert added(tmp_path, SAMPLES / "smc").refused == 1
    store = Store(str(tmp_path))
    assert query(store, "SELECT reason FROM refused").to_pylist() == [{"reason": "cannot be read: Input/output error"}]
    assert not store.has(place)
    assert added(tmp_path, SAMPLES / "smc").added == 1 and store.has(place)


def test_an_error_of_our_own_refuses_one_bag_and_not_all(tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("straightcomp_ros.fleet.history.adding.rows_of", broken)
    assert added(tmp_path, SAMPLES / "smc").refused == 1
    reason = query(Store(str(tmp_path)), "SELECT reason FROM refused").to_pylist()[0]["reason"]
    assert "ZeroDivisionError: division by zero; please report" in reason


def test_duckdb_polars_pandas_and_arrow_read_the_same_strokes(alone):
    store, _ = alone
    strokes = store / "strokes"
    wanted = ["stage", "month", "checksum", "stroke", "encoder_pp_um", "start", "error_bins_um"]
    order = ["checksum", "stroke"]
    by_duckdb = duckdb.sql(
        f"SELECT {', '.join(wanted)} FROM read_parquet('{strokes}/**/*.parquet', hive_partitioning = true)"
    ).to_arrow_table()
    by_polars = polars.read_parquet(strokes, hive_partitioning=True).select(wanted).to_arrow()
    by_pandas = pyarrow.Table.from_pandas(pandas.read_parquet(strokes)[wanted], preserve_index=False)
    data = pyarrow.dataset.dataset(strokes, partitioning="hive")
    by_arrow = data.to_table(columns=wanted)
    tables = [by_duckdb, by_polars, by_pandas, by_arrow]
    rows = [table.sort_by([(name, "ascending") for name in order]).to_pylist() for table in tables]
    assert len(rows[0]) == 2 * COUNT and rows[0][0]["encoder_pp_um"] > 0.0 and len(rows[0][0]["error_bins_um"]) == 20
    assert all(others == rows[0] for others in rows[1:])


def test_the_strokes_of_a_stage_come_in_the_order_of_time_with_the_columns_that_were_asked_for(alone):
    store = Store(str(alone[0]))
    table = store.strokes("stage_1", ["start", "direction"])
    assert table.column_names == ["start", "direction"] and table.num_rows == COUNT
    assert table["start"].to_pylist() == sorted(table["start"].to_pylist())
    assert store.strokes("stage_0").column_names == schema_of(StrokeRow).names
    with pytest.raises(HistoryError, match="has no stage 'stage_7'; its stages are: stage_0, stage_1"):
        store.strokes("stage_7")


@pytest.mark.parametrize("name", ["A/B 1", "ständer=ä%2F", "007", ".."])
def test_any_name_of_a_stage_comes_back(tmp_path, name, monkeypatch):
    from straightcomp_ros.fleet.history import adding

    facts = adding.recorded_facts

    def named(*arguments):
        import dataclasses

        return dataclasses.replace(facts(*arguments), stage=name)

    monkeypatch.setattr(adding, "recorded_facts", named)
    added(tmp_path / "store", SAMPLES / "smc")
    store = Store(str(tmp_path / "store"))
    assert store.stages() == [name] and store.strokes(name, ["stroke"]).num_rows == 2
    found = query(store, "SELECT DISTINCT stage FROM strokes").to_pylist()
    assert found == [{"stage": name}] and query(store, "SELECT stage FROM bags").to_pylist() == found


def test_every_column_says_what_it_is_and_keeps_its_type():
    for row in (StrokeRow, BagRow):
        assert all(one.description for one in columns_of(row))
        assert table_of(row, []).schema == schema_of(row)
        for one, field in zip(columns_of(row), schema_of(row), strict=True):
            assert field.nullable == one.nullable

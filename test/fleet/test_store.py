"""A store is the same whoever makes it, in whatever order, however often, and whatever interrupts."""

import os
import shutil
import signal
import subprocess
import sys
import warnings
from unittest.mock import Mock

import fsspec
import pyarrow.dataset
import pyarrow.parquet
import pytest
from bag_of_rows import by_rosbags, messages_of
from generated_bags import write_bag
from places import BAGS, SMC
from stores import COUNT, added, files_of, reasons_of, strokes_of
from tiers import nightly

from straightcomp_ros.fleet.history import HistoryError, adding
from straightcomp_ros.fleet.history.bag_places import bags_in
from straightcomp_ros.fleet.history.rows import StrokeRow, schema_of
from straightcomp_ros.fleet.history.store import Store


def test_a_month_of_a_stage_is_a_file_and_a_bag_a_row_or_a_reason_why_it_was_refused(months, alone):
    store, files = alone
    names = [f"strokes/stage=stage_{number}/month=2025-10/strokes.parquet" for number in (0, 1)]
    assert [name for name in files if name.startswith("strokes/")] == names
    assert len(files) == 2 + COUNT + 2
    assert Store(str(store)).stages() == ["stage_0", "stage_1"]
    rows = Store(str(store)).query("SELECT location, reason FROM refused ORDER BY location").to_pylist()
    assert [row["location"] for row in rows] == [str(months / "cut_off"), str(months / "damaged")]
    assert "was not finished" in rows[0]["reason"] and "straightcomp recover" in rows[0]["reason"]
    assert "is damaged at byte" in rows[1]["reason"]


def test_adding_the_same_bags_again_changes_nothing(months, alone):
    store, files = alone
    known = added(store, months)
    assert (known.added, known.refused, known.known) == (0, 0, COUNT + 2) and files_of(store) == files
    again = added(store, months, again=True)
    assert (again.added, again.refused) == (COUNT, 2) and files_of(store) == files
    # They may have been refused for the names of their topics.
    named = added(store, months, remap={"encoder": "/encoder"})
    assert (named.added, named.refused, named.known) == (0, 2, COUNT) and files_of(store) == files


@pytest.mark.parametrize("workers", ["two processes", *nightly(["dask"])])
def test_workers_make_the_store_that_one_process_makes_to_the_last_bit(months, alone, tmp_path, request, workers):
    where = {"dask": request.getfixturevalue("scheduler")} if workers == "dask" else {"jobs": 2}
    assert added(tmp_path, months, **where).added == COUNT
    assert files_of(tmp_path) == alone[1]


@pytest.mark.nightly
def test_several_processes_may_add_to_one_store_at_once(months, alone, tmp_path):
    """Each would add all bags: they meet at every file."""
    words = ["history", "add", str(months), "-o", str(tmp_path), "--jobs", "1"]
    command = [sys.executable, "-m", "straightcomp_ros.cli.main", *words]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(3)]
    errors = [process.communicate()[1].decode() for process in processes]
    # A process that found all bags known has refused none.
    assert {process.returncode for process in processes} <= {0, 1}, errors
    assert not any("Traceback" in text for text in errors), errors
    assert files_of(tmp_path) == alone[1]


@pytest.fixture
def copy(alone, tmp_path):
    """A store of its own, as ``alone``."""
    return shutil.copytree(alone[0], tmp_path / "store")


@pytest.mark.parametrize(("moment", "nth"), [("before", 2), *nightly([("before", 1), ("after", 1), ("after", 2)])])
def test_a_kill_at_a_rename_leaves_a_store_that_is_right(months, alone, tmp_path, moment, nth):
    """The moments at which a store could be wrong: a whole file is there, but not under its name, and the reverse."""
    program = f"""
import os, signal
from stores import added
rename, count = os.replace, 0
def killed(one, other):
    global count
    count += 1
    if {moment == "after"} or count < {nth}:
        rename(one, other)
    if count == {nth}:
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = killed
added({str(tmp_path)!r}, {str(months / "stage_0")!r})
"""
    here = os.path.dirname(__file__)
    done = subprocess.run([sys.executable, "-c", program], cwd=here, check=False)
    assert done.returncode == -signal.SIGKILL
    if list((tmp_path / "bags").glob("*")):
        # Each stroke is there once and as it should be, with those of each bag that has a row.
        found, expected = strokes_of(tmp_path), strokes_of(alone[0])
        known = Store(str(tmp_path)).query("SELECT checksum FROM bags WHERE reason IS NULL").to_pylist()
        stored = [row["checksum"] for row in found]
        assert all(row in expected for row in found) and all(stored.count(row["checksum"]) == 2 for row in known)
    added(tmp_path, months)
    assert files_of(tmp_path) == alone[1]


def test_what_a_killed_process_left_half_written_is_removed_by_a_later_one(tmp_path):
    (part := tmp_path / ".parts" / ".strokes.parquet.0.part").parent.mkdir()
    part.write_bytes(b"half a fi")
    added(tmp_path, SMC)
    assert not list(part.parent.iterdir())


def test_strokes_that_were_added_before_a_column_was_declared_are_null_there_until_they_are_added_again(copy, months):
    for file in copy.glob("strokes/*/*/strokes.parquet"):
        table = pyarrow.parquet.read_table(file, partitioning=None)
        pyarrow.parquet.write_table(table.drop_columns("after_minimum_zone_um"), file)
    null = "SELECT count(*) AS strokes FROM strokes WHERE after_minimum_zone_um IS NULL"
    assert Store(str(copy)).query(null).to_pylist() == [{"strokes": len(strokes_of(copy))}]
    assert added(copy, months, again=True).added == COUNT
    assert Store(str(copy)).query(null).to_pylist() == [{"strokes": 0}]


def test_a_bag_that_gives_other_strokes_than_before_changes_its_own(alone, months, copy, monkeypatch):
    rows_of = adding.rows_of
    monkeypatch.setattr(adding, "rows_of", lambda *run: rows_of(*run)[:1])
    added(copy, months / "stage_0" / "run_0", again=True)
    found = strokes_of(copy)
    (gone,) = (row for row in strokes_of(alone[0]) if row not in found)
    assert len(found) == 2 * COUNT - 1 and gone["stroke"] == 2


@pytest.mark.parametrize(
    "damaged",
    [
        lambda _: b"damaged",
        # As earlier versions wrote it, without a checksum: a page's header.
        lambda whole: whole[:4] + b"\xff" * 40 + whole[44:].replace(b"blake2b:", b"no sum: "),
    ],
)
def test_a_month_s_file_that_is_damaged_is_named_with_the_remedy(alone, months, copy, damaged):
    (file, *_) = sorted(copy.rglob("strokes.parquet"))
    file.write_bytes(damaged(file.read_bytes()))
    stage = file.parent.parent.name.removeprefix("stage=")
    for use in (lambda: added(copy, months, again=True), lambda: Store(str(copy)).strokes(stage)):
        with pytest.raises(HistoryError, match=r"strokes\.parquet is damaged: .*; remove it, and add .* --again"):
            use()
    with pytest.raises(HistoryError, match=r"strokes\.parquet|^query: "):
        Store(str(copy)).query("FROM strokes")
    file.unlink()
    added(copy, months, again=True)
    assert files_of(copy) == alone[1]


def test_a_copy_of_a_bag_adds_a_place_and_no_strokes_and_a_bag_keeps_its_name(tmp_path):
    for name in ("first", "second"):
        shutil.copytree(SMC, tmp_path / "bags" / name)
    store = tmp_path / "store"
    assert added(store, tmp_path / "bags").added == 2 and len(strokes_of(store)) == 2
    sql = "SELECT count(*) AS n, count(DISTINCT checksum) AS k FROM bags"
    assert Store(str(store)).query(sql).to_pylist() == [{"n": 2, "k": 1}]
    assert Store(str(store)).query("SELECT DISTINCT bag FROM strokes").to_pylist() == [{"bag": "smc"}]


def test_a_sqlite_bag_is_refused_until_its_recorder_has_described_it_at_last(tmp_path):
    bag, store = tmp_path / "run", tmp_path / "store"
    by_rosbags(bag, messages_of(SMC))
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    metadata.unlink()
    assert added(store, bag).refused == 1
    (reason,) = reasons_of(store)
    assert "was not finished" in reason and "ros2 bag reindex" in reason
    metadata.write_text(text)
    assert added(store, bag).added == 1 and len(strokes_of(store)) == 2
    # At another place.
    fsspec.filesystem("memory").put(str(bag), "/run", recursive=True)
    assert added(store, "memory://run").added == 1


@pytest.mark.parametrize("there", [1, 2])
def test_a_split_bag_is_refused_until_its_last_file_the_metadata_has_been_copied(tmp_path, there):
    """The files that are there may be whole, but not all."""
    whole, bag, store = tmp_path / "whole", tmp_path / "run", tmp_path / "store"
    write_bag(whole, 0, max_duration=2.0)
    files = sorted(whole.glob("*.mcap"))
    bag.mkdir()
    for file in files[:there]:
        shutil.copy(file, bag)
    assert len(files) > there and added(store, bag).refused == 1
    (reason,) = reasons_of(store)
    assert "was not finished" in reason and "ros2 bag reindex" in reason
    for file in (*files[there:], whole / "metadata.yaml"):
        shutil.copy(file, bag)
    assert added(store, bag).added == 1 and [row["stroke"] for row in strokes_of(store)] == [1, 2]


@pytest.mark.parametrize(("name", "named"), [("run.mcap", ""), ("run_0.mcap", "run_0.mcap")])
def test_an_mcap_file_without_a_number_or_that_is_named_itself_needs_no_metadata(tmp_path, name, named):
    (tmp_path / "run").mkdir()
    shutil.copy(SMC / "smc_0.mcap", tmp_path / "run" / name)
    assert added(tmp_path / "store", tmp_path / "run" / named).added == 1
    # At another place the file alone.
    fsspec.filesystem("memory").put(str(tmp_path / "run" / name), f"/alone/{name}")
    assert added(tmp_path / "other", f"memory://alone/{name}").added == 1


@pytest.mark.parametrize(
    "name, error, reason",
    [
        ("checksum_of", OSError(5, "Input/output error"), "cannot be read: Input/output error"),
        ("rows_of", ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero; please report"),
    ],
)
def test_a_bag_that_cannot_be_read_or_meets_an_error_of_ours_is_refused_and_tried_again(
    tmp_path, monkeypatch, name, error, reason
):
    with monkeypatch.context() as patch:
        patch.setattr(adding, name, Mock(side_effect=error))
        assert added(tmp_path, SMC).refused == 1
    store, place = Store(str(tmp_path)), next(bags_in(str(SMC)))
    assert reason in reasons_of(tmp_path)[0]
    if isinstance(error, OSError):
        assert not store.has(place) and added(tmp_path, SMC).added == 1
        assert store.has(place)


@pytest.mark.nightly
def test_duckdb_polars_pandas_and_arrow_read_the_same_strokes(alone):
    import pandas
    import polars

    strokes = alone[0] / "strokes"
    wanted = list(strokes_of(alone[0])[0])
    by_polars = polars.read_parquet(strokes, hive_partitioning=True).select(wanted).to_arrow()
    by_pandas = pyarrow.Table.from_pandas(pandas.read_parquet(strokes)[wanted], preserve_index=False)
    by_arrow = pyarrow.dataset.dataset(strokes, partitioning="hive").to_table(columns=wanted)
    order = [(name, "ascending") for name in ("checksum", "stroke")]
    rows = strokes_of(alone[0])
    assert len(rows) == 2 * COUNT and rows[0]["encoder_pp_um"] > 0.0 and len(rows[0]["error_bins_um"]) == 20
    assert all(table.sort_by(order).to_pylist() == rows for table in (by_polars, by_pandas, by_arrow))


def test_the_strokes_of_a_stage_come_in_the_order_of_time(alone):
    store = Store(str(alone[0]))
    table = store.strokes("stage_1")
    assert table.column_names == schema_of(StrokeRow).names and table.num_rows == COUNT
    assert table["start"].to_pylist() == sorted(table["start"].to_pylist())
    with pytest.raises(HistoryError, match="has no stage 'stage_7'; its stages are: stage_0, stage_1"):
        store.strokes("stage_7")


READS_AND_ADDS = """\
import os, sys, time, pyarrow.compute, pyarrow.parquet
from straightcomp_ros.fleet.history.bag_places import bags_in
from straightcomp_ros.fleet.history.adding import Tally, add
from straightcomp_ros.fleet.history.store import Store
store, bag = Store(sys.argv[1]), sys.argv[2]
def threads():
    return set(os.listdir("/proc/self/task"))
before, tally = threads(), Tally()
assert not store.has(next(bags_in(bag)))
list(add(store, bags_in(bag), tally, jobs=1))
assert store.has(next(bags_in(bag))) and tally.added == 1
assert all(store.strokes(stage).num_rows for stage in store.stages())
end = time.monotonic() + 10.0
while threads() - before and time.monotonic() < end:
    time.sleep(0.01)  # a thread of Python's has been joined before the kernel forgets it
print(threads() - before)
"""


def test_no_thread_of_arrow_s_is_left_that_could_hold_python_s_bytes_when_the_interpreter_ends(copy):
    """It would end the process with `terminate called without an active exception`, now and then (rows_in)."""
    command = [sys.executable, "-c", READS_AND_ADDS, str(copy), str(SMC)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "set()\n"


def test_a_file_of_which_one_bit_is_another_gives_no_figures(copy):
    """DuckDB and Arrow take what it gives for values, and adding would write them on for good."""
    for file in (min(copy.rglob("strokes.parquet")), min(copy.rglob("bags/*.parquet"))):
        whole = file.read_bytes()
        mark = range(whole.rindex(b"blake2b:"), whole.rindex(b"blake2b:") + 56)  # damaged, it is none: no value is
        for at in (at for at in range(0, len(whole), len(whole) // 40) if at not in mark):
            file.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
            with pytest.raises(HistoryError, match=f"{file.name} is damaged"):
                Store(str(copy)).query("FROM strokes")
        if file.name == "strokes.parquet":
            with pytest.raises(HistoryError, match="is damaged"):
                Store(str(copy)).strokes("stage_0")
        file.write_bytes(whole)


def test_what_a_worker_warns_of_is_said_here_with_the_bag(tmp_path, monkeypatch):
    rows_of = adding.rows_of
    monkeypatch.setattr(adding, "rows_of", lambda *run: warnings.warn("odd", stacklevel=1) or rows_of(*run))
    with pytest.warns(UserWarning, match=f"^{BAGS / 'smc'}: odd$"):
        added(tmp_path, SMC)

"""A compacted store has the same strokes, each once, whatever is killed and whoever adds meanwhile."""

import json
import random
import signal
import subprocess
import sys
import time

import pandas
import pyarrow.dataset
import pytest
from stores import COUNT, added, files_of

from straightcomp_ros.cli.main import main
from straightcomp_ros.fleet.history import HistoryError, store
from straightcomp_ros.fleet.history.queries import query
from straightcomp_ros.fleet.history.store import Store

STORED = ["stage", "checksum", "stroke", "start", "encoder_pp_um", "error_bins_um"]


def strokes(store):
    sql = f"SELECT {', '.join(STORED)} FROM strokes ORDER BY checksum, stroke"
    return query(Store(str(store)), sql).to_pylist()


def names(store):
    return sorted(name for name in files_of(store) if name.startswith("strokes/"))


@pytest.fixture
def store(months, tmp_path):
    added(tmp_path / "store", months)
    return tmp_path / "store"


def verb(store, *words):
    return [sys.executable, "-m", "straightcomp_ros.cli.main", "history", *words, "-o", str(store), "--jobs", "1"]


def test_each_month_becomes_one_file_with_the_same_strokes(store, alone, capsys):
    assert main(["history", "compact", str(store), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"store": str(store), "months": 2, "files": COUNT}
    assert [name.rpartition("/")[2].partition("-")[0] for name in names(store)] == ["compacted"] * 2
    assert strokes(store) == strokes(alone[0])
    before, after = (Store(str(one)).strokes("stage_1") for one in (alone[0], store))
    assert after.equals(before)
    assert len(pandas.read_parquet(store / "strokes")) == 2 * COUNT
    assert main(["history", "compact", str(store)]) == 0
    assert "0 files of 0 months" in capsys.readouterr().out


def test_known_bags_stay_known_and_bags_that_are_evaluated_again_add_no_stroke(store, months, alone):
    list(Store(str(store)).compact())
    files = files_of(store)
    assert added(store, months).known == COUNT + 2
    assert added(store, months, again=True).added == COUNT
    assert files_of(store) == files and strokes(store) == strokes(alone[0])


def test_a_bag_that_gives_other_strokes_than_before_changes_its_own(store, months, alone):
    list(Store(str(store)).compact())
    (file, *_) = sorted((alone[0] / "strokes" / "stage=stage_0").rglob("*.parquet"))
    (month,) = (store / "strokes" / "stage=stage_0").iterdir()
    other = store._file_of(store._table([file]).slice(0, 1))
    with store.alone(store):
        store.write_bag(month, file.stem, other, store)
    found = strokes(store)
    assert len(found) == 2 * COUNT - 1
    assert [row for row in found if row["checksum"] != file.stem] == [
        row for row in strokes(alone[0]) if row["checksum"] != file.stem
    ]


def test_bags_that_come_later_join_the_compacted_ones(months, alone, tmp_path):
    store = tmp_path / "store"
    added(store, months / "stage_0")
    list(Store(str(store)).compact())
    added(store, months)
    assert strokes(store) == strokes(alone[0])
    assert sum(merged for _, merged in Store(str(store)).compact()) == COUNT // 2
    assert strokes(store) == strokes(alone[0])


def test_a_reader_that_listed_the_files_before_reads_each_stroke_once(store, alone, monkeypatch):
    dataset = pyarrow.dataset.dataset

    def listed(*arguments, **options):
        found = dataset(*arguments, **options)
        monkeypatch.undo()
        list(Store(str(store)).compact())
        return found

    monkeypatch.setattr(pyarrow.dataset, "dataset", listed)
    assert Store(str(store)).strokes("stage_0").equals(Store(str(alone[0])).strokes("stage_0"))


def test_no_file_that_was_listed_before_is_another_one_after(months, tmp_path):
    """Who has read a bag's file, and then opens the compacted one, must not find that bag's strokes there too."""
    store = tmp_path / "store"
    added(store, months / "stage_0" / "run_0")
    list(Store(str(store)).compact())
    added(store, months / "stage_0")
    listed = sorted((store / "strokes" / "stage=stage_0").rglob("*.parquet"))
    assert len(listed) > 1
    list(Store(str(store)).compact())
    assert not [file for file in listed if file.exists()]


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_process_that_is_killed_beside_the_exchange_leaves_each_stroke_once(store, alone, moment):
    """The moments at which the store could be wrong: the new folder is there, but not in its place, and the reverse."""
    program = f"""
import os, signal
from straightcomp_ros.fleet.history import store
from straightcomp_ros.fleet.history.store import Store
exchange = store.exchange
def killed(one, other):
    if {moment!r} == "after":
        exchange(one, other)
    os.kill(os.getpid(), signal.SIGKILL)
store.exchange = killed
list(Store({str(store)!r}).compact())
"""
    done = subprocess.run([sys.executable, "-c", program], check=False)
    assert done.returncode == -signal.SIGKILL and list((store / ".parts").iterdir())
    assert strokes(store) == strokes(alone[0])
    assert len(pandas.read_parquet(store / "strokes")) == 2 * COUNT
    # The lock went with the process.
    list(Store(str(store)).compact())
    assert strokes(store) == strokes(alone[0]) and len(names(store)) == 2


def test_what_a_killed_process_left_is_removed_later(store, monkeypatch):
    left = store / ".parts" / "1-a"
    left.mkdir()
    (left / "compacted-0.parquet").write_bytes(b"half")
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3600.0)
    Store(str(store)).clear_abandoned()
    assert not left.exists()


def test_others_add_while_it_compacts_again_and_again_and_is_killed(months, alone, tmp_path):
    store, chance = tmp_path / "store", random.Random(3)
    added(store, months / "stage_0" / "run_0")
    compacting = f"""
from straightcomp_ros.fleet.history.store import Store
print("ready", flush=True)
while True:
    list(Store({str(store)!r}).compact())
"""
    writer = subprocess.Popen(verb(store, "add", str(months)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    kills = 0
    while writer.poll() is None or kills == 0:
        with subprocess.Popen([sys.executable, "-c", compacting], stdout=subprocess.PIPE) as other:
            other.stdout.readline()
            time.sleep(chance.uniform(0.05, 0.3))
            other.kill()
        kills += 1
    assert strokes(store) == strokes(alone[0])
    assert added(store, months).known == COUNT + 2


def test_a_file_that_is_damaged_is_named_and_its_month_left_as_it_is(store, capsys):
    (file, *_) = sorted((store / "strokes" / "stage=stage_0").rglob("*.parquet"))
    file.write_bytes(b"damaged")
    before = names(store)
    assert main(["history", "compact", str(store)]) == 2
    assert file.name in capsys.readouterr().err and names(store) == before
    assert not list((store / ".parts").iterdir())


def test_a_store_elsewhere_is_refused():
    with pytest.raises(HistoryError, match="cannot be compacted; allowed: a folder of this machine"):
        list(Store("memory://store").compact())

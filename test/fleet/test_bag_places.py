"""Which bags a folder has, and when those that are being recorded enter the store: when they rest."""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
from places import BAGS, SMC

from straightcomp_ros.fleet.history import StorageError
from straightcomp_ros.fleet.history.bag_places import GrowingFolders, bags_in


def given(growing, folder):
    return [os.path.basename(place.location) for place in growing.resting(bags_in(str(folder)))]


def test_a_bag_is_given_out_when_it_rests_and_again_when_it_changed_or_could_not_be_read(tmp_path):
    (bag := tmp_path / "run").mkdir()
    growing, whole = GrowingFolders(), (SMC / "smc_0.mcap").read_bytes()
    for size in (1_000_000, 1_100_000, len(whole)):
        (bag / "run_0.mcap").write_bytes(whole[:size])
        assert given(growing, tmp_path) == []
    assert [given(growing, tmp_path) for _ in range(3)] == [["run"], [], []]
    (bag / "metadata.yaml").write_text("more")
    assert [given(growing, tmp_path) for _ in range(3)] == [[], ["run"], []]
    growing.retry(next(bags_in(str(tmp_path))))
    assert given(growing, tmp_path) == ["run"]


def test_a_file_that_vanishes_while_its_folder_is_listed_hides_no_other(tmp_path, monkeypatch):
    for name in ("gone", "there"):
        (tmp_path / f"{name}.mcap").write_bytes(b"")
    scandir = os.scandir

    @contextmanager
    def listed(folder):
        with scandir(folder) as found:
            entries = list(found)
        (tmp_path / "gone.mcap").unlink()
        yield entries

    monkeypatch.setattr(os, "scandir", listed)
    assert [place.location for place in bags_in(str(tmp_path))] == [str(tmp_path / "there.mcap")]


@pytest.mark.parametrize(
    ("own", "bags"),
    [
        (["run_0.mcap"], ["."]),
        (["run.mcap", "metadata.yaml"], ["."]),
        (["run.mcap"], ["run.mcap"]),
        ([f"{number}_run_2025_12_17-10_{number:02}_00.mcap" for number in range(12)], ["."]),
        (["a_run.mcap", "z_run.mcap"], ["a_run.mcap", "z_run.mcap"]),
        # Of two recordings, one of which is split: a bag that is refused when it is added.
        (["a_1.mcap", "a_2.mcap", "z_run.mcap"], ["."]),
    ],
)
def test_the_files_of_one_recording_are_a_bag_that_hides_none_in_the_folders_below_it(tmp_path, own, bags):
    for name in (*own, "one/metadata.yaml", "one/one_0.mcap", "one/two/two.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = [os.path.relpath(place.location, tmp_path) for place in bags_in(str(tmp_path))]
    assert found == [*bags, "one", "one/two/two.mcap"]


def test_a_folder_that_may_not_be_listed_hides_no_other_and_the_one_that_is_named_is_an_error(tmp_path, monkeypatch):
    kept = tmp_path / "bags" / "lost+found"
    for folder in (kept, tmp_path / "bags" / "there"):
        folder.mkdir(parents=True)
        (folder / "bag.mcap").write_bytes(b"")
    scandir = os.scandir

    def listed(folder):
        if os.fspath(folder) == str(kept):
            raise PermissionError(13, "Permission denied", str(kept))
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", listed)
    with pytest.warns(UserWarning, match=r"lost\+found: left out, since it cannot be listed: Permission denied"):
        found = list(bags_in(str(tmp_path)))
    assert [place.location for place in found] == [str(tmp_path / "bags" / "there" / "bag.mcap")]
    with pytest.raises(StorageError, match="Permission denied"):
        list(bags_in(str(kept)))


def test_following_adds_bags_as_they_are_finished_until_it_is_interrupted(tmp_path):
    bags, store = tmp_path / "bags", tmp_path / "store"
    bags.mkdir()
    words = ["history", "add", str(bags), "-o", str(store), "--follow", "--every", "0.1", "--json"]
    process = subprocess.Popen(
        [sys.executable, "-m", "straightcomp_ros.cli.main", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        for number, name in enumerate(("smc", "uncompensated"), 1):
            shutil.copytree(BAGS / name, bags / name)
            deadline = time.monotonic() + 120.0
            while len(list(store.glob("bags/*"))) < number:
                assert process.poll() is None and time.monotonic() < deadline, process.communicate()
                time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60.0)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0 and b'"added": 2' in out and b"Traceback" not in err

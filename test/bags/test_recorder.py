"""What a recording keeps, passes over, counts as lost, and when it stops."""

import re
import subprocess
import threading
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from unittest.mock import Mock

import pytest
from recording import LAYOUTS, information
from waiting import comes_true

from straightcomp_ros.bags import BagError, RecorderParameters
from straightcomp_ros.bags import information as origin_module
from straightcomp_ros.bags import recorder as recorder_module
from straightcomp_ros.bags.information import origin
from straightcomp_ros.bags.reader import read_metadata, read_streams
from straightcomp_ros.bags.recorder import BREAK, Intake, Losses, Recorder, check_disk
from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.contract import ENCODER


@pytest.fixture(autouse=True)
def no_writer_is_left(monkeypatch):
    """The thread of a recorder that a failing test did not stop would keep the run from ending."""
    started, start = [], Recorder.start
    monkeypatch.setattr(Recorder, "start", lambda self: started.append(self) or start(self))
    yield
    for recorder in started:
        with suppress(BagError):
            recorder.stop()


def message(number: int) -> tuple[str, bytes, int, int]:
    return "/encoder", bytes([number % 256]), number * 1_000_000, 0


def test_messages_wait_in_their_order_those_of_a_pause_are_ignored_and_those_beyond_the_limit_dropped():
    intake = Intake(limit=7)
    for number in range(10):
        if number == 2:
            intake.pause()
        intake.paused = 2 <= number < 4
        intake.add(*message(number))
    assert list(intake.queue) == [message(0), message(1), BREAK, *map(message, range(4, 8))]
    assert (intake.received, intake.dropped) == (10, 2)


def test_a_snapshot_has_all_of_the_last_seconds_and_those_only():
    intake = Intake(limit=510, snapshot_s=0.5)
    for number in range(3000):
        intake.add(*message(number))
    assert not intake.queue and intake.snapshot() == 501
    assert list(intake.queue) == [BREAK, *(message(number) for number in range(2499, 3000))]
    for number in range(3000, 3010):
        intake.add(*message(number))
    # More than may wait for the disk, but they are in memory all the same.
    assert (intake.snapshot(), intake.dropped, intake.received) == (10, 0, 3010)
    assert list(intake.queue)[502:] == [BREAK, *(message(number) for number in range(3000, 3010))]


@pytest.mark.parametrize("step", [-3600_000, -300, 3600_000])
def test_a_snapshot_keeps_no_more_than_its_seconds_where_the_clock_is_set(step):
    intake = Intake(limit=10_000, snapshot_s=0.5)
    for number in [*range(4_000_000, 4_003_000), *range(4_003_000 + step, 4_006_000 + step)]:
        intake.add(*message(number))
    assert intake.snapshot() == 501


def test_a_pause_within_a_snapshot_is_an_interruption_and_no_message():
    intake = Intake(limit=8, snapshot_s=0.02)
    for number in range(10, 14):
        intake.add(*message(number))
    intake.pause()
    intake.add(*message(14))
    intake.paused = False
    for number in range(20, 22):
        intake.add(*message(number))
    assert intake.snapshot() == 6
    assert list(intake.queue) == [BREAK, *map(message, range(10, 14)), BREAK, *map(message, (20, 21))]
    intake.interrupt()
    intake.add(*message(30))
    assert (intake.snapshot(), intake.dropped, intake.received) == (1, 0, 8)
    # A pause before the oldest message of the memory is of no use any more.
    intake.queue.clear()
    intake.add(*message(30))
    intake.interrupt()
    intake.add(*message(60))
    assert (intake.snapshot(), list(intake.queue)) == (1, [BREAK, message(60)])


def test_the_revision_is_that_of_the_repository_that_has_this_file(tmp_path, monkeypatch, capfd):
    def git(*words):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b")
        return subprocess.run(["git", "-C", tmp_path, *identity, *words], check=True, capture_output=True, text=True)

    ours, others = tmp_path / "ours.py", tmp_path / "others.py"
    for file in (ours, others):
        file.touch()
    git("init", "-q")
    git("add", "ours.py")
    git("commit", "-q", "-m", "one")
    monkeypatch.setattr(origin_module, "__file__", str(ours))
    assert origin()["revision"] == git("rev-parse", "--short=12", "HEAD").stdout.strip()
    monkeypatch.setattr(origin_module, "__file__", str(others))
    assert origin()["revision"] == "unknown"
    assert capfd.readouterr() == ("", "")  # a logger's terminal is the operator's


def test_stamps_lost_between_two_batches_are_counted_and_those_of_an_interruption_are_not():
    def packed(*numbers):
        return [ENCODER.layout.pack(10**18 + 10**6 * number, 0, 0, 0, 0) for number in numbers]

    losses = Losses()
    losses.add("/a", packed(0, 1, 2))
    losses.add("/a", packed(5, 6))
    assert losses.by_topic() == {"/a": 2}
    losses.interrupt()
    losses.add("/a", packed(100, 102))
    assert losses.by_topic() == {"/a": 3}
    # Repeated, overtaken and too short for a stamp: no step, and no loss.
    losses.add("/a", [*packed(102, 101), b"short", bytes(11), packed(103)[0][:12]])
    losses.add("/a", packed(104))
    assert losses.by_topic() == {"/a": 3}
    losses.add("/b", [])
    losses.add("/c", packed(1))
    assert losses.by_topic() == {"/a": 3, "/c": 0}
    # Seconds count as well as nanoseconds.
    losses.add("/d", packed(0, 1000, 3000))
    assert losses.by_topic()["/d"] == 1
    # However fine the grid is.
    losses.add("/e", [ENCODER.layout.pack(ns, 0, 0, 0, 0) for ns in (10, 11, 13)])
    assert losses.by_topic()["/e"] == 1


def recorder_in(folder: Path, describe=lambda bag, at_end: None, **options) -> Recorder:
    """One of the encoder, whose losses it counts."""
    recorder = Recorder(RecorderParameters(str(folder / "run"), **options), ["/encoder"], describe)
    recorder.announce(Topic("/encoder", ENCODER.layout.type_name))
    return recorder


def sample(number: int) -> tuple[str, bytes, int, int]:
    stamp = 10**18 + 500_000 * number
    return "/encoder", ENCODER.layout.pack(stamp, 0.0, 0.0, 0.0, 0.0), stamp, stamp


def test_a_recorder_makes_one_bag_after_the_other_and_counts_no_pause_as_loss(tmp_path):
    described = []
    recorder = recorder_in(tmp_path, lambda bag, at_end: described.append(at_end))
    recorder.intake.add(*sample(0))
    assert recorder.start() == tmp_path / "run"
    with pytest.raises(BagError, match="being recorded already"):
        recorder.start()
    for number in range(100):
        if number == 20:
            recorder.intake.pause()
        recorder.intake.paused = 20 <= number < 60
        if number != 80:
            recorder.intake.add(*sample(number))
    recorder.stop()
    assert not recorder.recording
    recorder.intake.add(*sample(100))
    assert recorder.start() == tmp_path / "run_2"
    recorder.announce(Topic("/late", "std_msgs/msg/Float64"))
    recorder.intake.add(*sample(101))
    recorder.intake.add("/late", bytes(12), 10**18, 10**18)
    recorder.stop()
    recorder.stop()
    assert len(read_streams(tmp_path / "run", LAYOUTS)["encoder"]) == 59
    metadata = read_metadata(tmp_path / "run")
    assert metadata["losses"] == {"/encoder": "1"}
    assert metadata["logger"] == {"received": "99", "written": "59", "dropped": "0"}
    assert metadata["origin"]["package"] == "straightcomp_ros" and metadata["origin"]["version"]
    assert re.fullmatch(r"unknown|[0-9a-f]{7,40}(-dirty)?", metadata["origin"]["revision"])
    topics = information(tmp_path / "run_2")["topics_with_message_count"]
    assert {one["topic_metadata"]["name"]: one["message_count"] for one in topics} == {"/encoder": 1, "/late": 1}
    assert described[-1] is True


def test_recordings_that_begin_in_one_second_in_one_folder_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recorder_module, "datetime", Mock(now=lambda: datetime(2026, 11, 29, 12, 30, 15)))
    recorders = [Recorder(RecorderParameters(), [], lambda bag, at_end: None) for _ in range(3)]
    names = [str(one.start()) for one in recorders]
    first = "straightcomp_2026_11_29-12_30_15"
    assert names == [first, f"{first}_2", f"{first}_3"]
    for one in recorders:
        one.stop()
        assert (one.folder / "metadata.yaml").exists()
    monkeypatch.setattr(Path, "mkdir", Mock(side_effect=PermissionError(13, "Permission denied")))
    with pytest.raises(BagError, match=r"straightcomp_.* cannot be made.*Permission denied"):
        recorders[0].start()


def test_an_expected_topic_is_in_each_bag_as_it_was_announced_or_else_as_it_was_expected(tmp_path):
    recorder = Recorder(RecorderParameters(str(tmp_path / "run")), [], lambda bag, at_end: None)
    recorder.expect(Topic("/encoder", ENCODER.layout.type_name, TopicQos("best_effort")))
    recorder.start()
    recorder.stop()
    recorder.start()
    recorder.announce(Topic("/encoder", ENCODER.layout.type_name))
    recorder.intake.add(*sample(0))
    recorder.stop()

    def only_topic(folder):
        (topic,) = information(tmp_path / folder)["topics_with_message_count"]
        return topic["topic_metadata"]["offered_qos_profiles"][0]["reliability"], topic["message_count"]

    assert only_topic("run") == ("best_effort", 0)
    assert only_topic("run_2") == ("reliable", 1)


def test_a_recording_goes_on_in_a_new_file_when_that_is_asked_for(tmp_path):
    recorder = recorder_in(tmp_path, min_free_bytes=0)
    recorder.start()
    for number in range(2):
        recorder.intake.add(*sample(number))
        # What still waits goes to the next file.
        assert comes_true(lambda number=number: recorder.written == number + 1)
        recorder.split()
        assert comes_true(lambda number=number: (tmp_path / "run" / f"run_{number + 1}.mcap").exists())
    recorder.intake.add(*sample(2))
    recorder.stop()
    assert [file["message_count"] for file in information(tmp_path / "run")["files"]] == [1, 1, 1]


def test_a_full_disk_ends_a_recording_with_what_came_before(tmp_path):
    check_disk(tmp_path, 1)
    recorder = recorder_in(tmp_path)
    recorder.start()
    recorder.keep_free(10**18)
    recorder._thread.join(30)
    assert re.search(r"\d+ bytes are free on its disk; allowed: >= 10{18} \(min_free_bytes\)", str(recorder.failure))
    with pytest.raises(BagError, match="min_free_bytes"):
        recorder.stop()
    assert (tmp_path / "run" / "metadata.yaml").exists()


def test_what_waits_when_a_recording_is_stopped_does_not_fill_the_disk(tmp_path):
    looked = threading.Event()

    def describe(bag, at_end):
        looked.set()
        recorder._stopping.wait(30)

    recorder = recorder_in(tmp_path, describe, queue_limit=1000, min_free_bytes=0)
    recorder.start()
    assert looked.wait(30)
    # As a snapshot does.
    recorder.intake.queue.extend(sample(number) for number in range(2500))
    recorder.keep_free(10**18)
    with pytest.raises(BagError, match="min_free_bytes"):
        recorder.stop()
    assert recorder.written == 1000 and (tmp_path / "run" / "metadata.yaml").exists()


@pytest.mark.parametrize("words", ["MemoryError", "'/unknown' was not added"])
def test_what_ends_the_writing_is_raised_when_the_bag_is_finished(tmp_path, words):
    def describe(bag, at_end):
        if words == "MemoryError":
            raise MemoryError

    recorder = recorder_in(tmp_path, describe, min_free_bytes=0)
    recorder.start()
    if words == "MemoryError":
        recorder._thread.join(30)
        assert isinstance(recorder.failure, BagError)
    # Written last, after the stop was asked for.
    recorder.intake.add("/unknown", b"", 0, 0)
    with pytest.raises(BagError, match=f"run.*{words}"):
        recorder.stop()
    assert not recorder.recording and (tmp_path / "run" / "metadata.yaml").exists()

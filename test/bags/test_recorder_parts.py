"""What a recording keeps, passes over, counts as lost, and when it stops."""

import random
import re
import subprocess

import pytest
from recording import START_NS

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags import information as origin_module
from straightcomp_ros.bags.information import origin
from straightcomp_ros.bags.recorder import BREAK, DiskGuard, Intake, Losses
from straightcomp_ros.contract import COMMAND, ENCODER


def message(number: int) -> tuple[str, bytes, int, int]:
    return "/encoder", bytes([number % 256]), number * 1_000_000, 0


def test_all_messages_wait_for_the_disk_in_their_order_and_those_beyond_the_limit_are_counted():
    intake = Intake(limit=5)
    for number in range(8):
        intake.add(*message(number))
    assert list(intake.queue) == [message(number) for number in range(5)]
    assert intake.dropped == 3


def test_what_comes_in_a_pause_is_passed_over():
    intake = Intake(limit=100)
    for number in range(6):
        intake.paused = 2 <= number < 4
        intake.add(*message(number))
    assert list(intake.queue) == [message(0), message(1), BREAK, message(4), message(5)]
    assert (intake.passed_over, intake.dropped) == (2, 0)


def test_a_snapshot_has_the_last_seconds_only_and_memory_stays_bounded():
    intake = Intake(limit=10_000, snapshot_s=0.5)
    for number in range(3000):
        intake.add(*message(number))
    assert not intake.queue
    assert intake.snapshot() == 501
    assert list(intake.queue) == [BREAK, *(message(number) for number in range(2499, 3000))]
    intake.queue.clear()
    assert intake.snapshot() == 0


def test_lost_messages_are_counted_by_topic_from_the_stamps():
    source, losses, one_by_one = random.Random(4), Losses(), Losses()
    lost = {"/encoder": 0, "/command": 0}
    for stream in (ENCODER, COMMAND):
        topic = f"/{stream.topic}"
        batch = []
        for number in range(1000):
            # The first and the last come, so that all that is lost lies between.
            if 0 < number < 999 and source.random() < 0.1:
                lost[topic] += 1
                continue
            data = stream.layout.pack(START_NS + 500_000 * number, *(0.0 for _ in stream.layout.columns))
            batch += [data] * (2 if number % 100 == 0 else 1)
            one_by_one.add(topic, [data])
            if source.random() < 0.05 or number == 999:
                losses.add(topic, batch)
                batch = []
    assert losses.by_topic() == one_by_one.by_topic() == lost
    assert lost["/encoder"] > 50


def test_the_recording_stops_before_the_disk_is_full(tmp_path):
    DiskGuard(tmp_path, 0).check()
    with pytest.raises(BagError, match=r"bytes are free on its disk; allowed: >= 10{30} \(min_free_bytes\)"):
        DiskGuard(tmp_path, 10**30).check()


def test_the_revision_is_that_of_the_repository_that_has_this_file(tmp_path, monkeypatch):
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


def test_the_origin_names_package_version_and_revision():
    found = origin()
    assert found["package"] == "straightcomp_ros"
    assert found["revision"] == "unknown" or re.fullmatch(r"[0-9a-f]{7,40}(-dirty)?", found["revision"])

"""A written bag, as other software finds it."""

import errno
import re
import shutil
import sys
import tracemalloc
import warnings
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import ANY

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from recording import LAYOUTS, Recording, add_streams, information, messages, recorded, write
from rosbags.interfaces import QosReliability
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags import writer as writer_module
from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.bags.folder import found_files
from straightcomp_ros.bags.mcap_output import McapOutput
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata, read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.topics import Topic, TopicQos, definition
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import COMMAND, ENCODER, STREAMS

COMPRESSIONS = ("zstd", "lz4", "none")


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_rosbags_and_mcap_find_every_message_with_its_times_type_and_qos(tmp_path, compression):
    bag = recorded(tmp_path / "run", compression=compression, chunk_size=4096)
    with Reader(bag.directory) as reader:
        found = [(connection.topic, data, time) for connection, time, data in reader.messages()]
        assert reader.message_count == len(bag.messages)
        assert {connection.digest for connection in reader.connections} == {
            definition(stream.layout.type_name).type_hash for stream in STREAMS
        }
        for connection in reader.connections:
            assert connection.ext.offered_qos_profiles[0].reliability == QosReliability.BEST_EFFORT
            assert connection.msgdef.data == definition(connection.msgtype).text
    assert sorted(found) == sorted(message[:3] for message in bag.messages)
    with open(bag.file, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [
            (channel.topic, message.data, message.log_time, message.publish_time)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
        statistics = reader.get_summary().statistics
        assert reader.get_header().profile == "ros2"
        file.seek(0)
        found_records = StreamReader(file, emit_chunks=True, validate_crcs=True).records
        chunks = sum(isinstance(one, Chunk) for one in found_records)
    assert found == bag.messages and statistics.message_count == len(bag.messages)
    times = [message.log_time for message in bag.messages]
    assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
    assert statistics.chunk_count == chunks > 1


def test_metadata_yaml_says_what_rosbags_writes_of_the_same_messages(tmp_path):
    bag, theirs = recorded(tmp_path / "run"), tmp_path / "theirs"
    with Reader(bag.directory) as reader, Writer(theirs, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            one.topic: writer.add_connection(
                one.topic,
                one.msgtype,
                msgdef=one.msgdef.data,
                rihs01=one.digest,
                offered_qos_profiles=one.ext.offered_qos_profiles,
            )
            for one in reader.connections
        }
        for message in bag.messages:
            writer.write(connections[message.topic], message.log_time, message.data)
    found, expected = information(bag.directory), information(theirs)
    assert found == expected | {
        "relative_file_paths": ["run_0.mcap"],
        "files": [expected["files"][0] | {"path": "run_0.mcap"}],
        "custom_data": {"survey.guide": "synthetic", "survey.points": "177"},
        "ros_distro": "jazzy",
    }
    profile = found["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"][0]
    # These come from our bag: what they must be, rosbags does not say.
    expected = {"history": "keep_last", "depth": 10, "reliability": "best_effort", "durability": "volatile"}
    expected |= {"liveliness": "automatic", "avoid_ros_namespace_conventions": False}
    forever = {"sec": 9223372036, "nsec": 854775807}
    assert profile == expected | dict.fromkeys(("deadline", "lifespan", "liveliness_lease_duration"), forever)
    text = (bag.directory / "metadata.yaml").read_text()
    # rosbag2 reads no anchors; it looks into the file when it is given that alone.
    assert "&id" not in text
    assert {path.name for path in bag.directory.iterdir()} == {"metadata.yaml", "run_0.mcap"}
    named = recorded(tmp_path / "Prüfstand").directory
    assert f"- {named.name}_0.mcap\n" in (named / "metadata.yaml").read_text("utf-8")
    serialized = read_metadata(bag.file)["rosbag2"]["serialized_metadata"]
    assert yaml.safe_load(serialized) == information(bag.directory)


def test_a_bag_without_messages_lists_its_topics_and_has_an_attachment_and_a_metadata_record(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        add_streams(bag)
    found = information(tmp_path / "bag")
    assert [topic["message_count"] for topic in found["topics_with_message_count"]] == [0] * len(STREAMS)
    assert found["starting_time"]["nanoseconds_since_epoch"] == 2**63 - 1  # as rosbag2 says that nothing began
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 0 and len(reader.connections) == len(STREAMS)
    assert list(read_attachments(tmp_path / "bag")) == ["metadata.yaml"]
    assert list(read_metadata(tmp_path / "bag")) == ["rosbag2"]
    with pytest.raises(BagError, match="has no messages; record again"):
        read_streams(tmp_path / "bag", LAYOUTS)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_the_bag_is_finished_when_an_exception_ends_the_block(tmp_path, error):
    with pytest.raises(error), BagWriter(tmp_path / "bag") as bag:
        add_streams(bag)
        bag.write_all(messages(20))
        raise error
    assert information(tmp_path / "bag")["message_count"] == 20 * len(STREAMS)


@pytest.mark.nightly
def test_an_interrupt_at_any_call_while_writing_leaves_a_whole_bag(tmp_path):
    written = [message for message in messages(1) if message.topic in ("/encoder", "/command")]

    def taken_before(call: int) -> int:
        """Messages that ``write`` took before an interrupt at the call of that number."""
        calls = taken = 0

        def interrupt(frame: object, event: str, argument: object) -> None:
            # Python handles signals before and after calls: these are the places of Ctrl-C.
            nonlocal calls
            calls += event in ("call", "c_call", "c_return")
            if calls == call:
                sys.setprofile(None)
                raise KeyboardInterrupt

        with suppress(KeyboardInterrupt), BagWriter(tmp_path / f"bag{call}", chunk_size=1) as bag:
            bag.add(Topic("/encoder", ENCODER.layout.type_name))
            bag.add(Topic("/command", COMMAND.layout.type_name))
            try:
                sys.setprofile(interrupt)
                for message in written:
                    bag.write(*message)
                    taken += 1
            finally:
                sys.setprofile(None)
        return taken

    call = 1
    while (taken := taken_before(call)) < len(written):
        with Reader(tmp_path / f"bag{call}") as reader:
            kept = [data for _, _, data in sorted(reader.messages(), key=lambda entry: entry[1])]
            assert reader.message_count in (taken, taken + 1)
        assert sorted(kept) == sorted(message.data for message in written[: len(kept)])
        if kept:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read_streams(tmp_path / f"bag{call}", LAYOUTS)
        call += 1
    assert call > 100


def test_a_chunk_that_is_written_stays_in_memory_as_its_index_entry_only(tmp_path):
    # The logger writes some 25,000 of them in an hour.
    chunks, entry = 500, 9 + 4 * 8 + 4 + 10 * len(STREAMS) + 8 + 8 + 16
    with BagWriter(tmp_path / "bag") as bag:
        add_streams(bag)

        def write(count):
            for message in messages(count):
                bag.write(*message)
                if message.topic == f"/{STREAMS[-1].topic}":
                    bag.flush_older(0.0)

        write(10)
        tracemalloc.start()
        before, _ = tracemalloc.get_traced_memory()
        write(chunks)
        after, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert after - before < 2.0 * chunks * entry


def test_a_folder_becomes_a_bag_where_it_is_empty_or_can_be_made_and_is_closed_once(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "year" / "day" / "run"):
        bag = BagWriter(folder)
        bag.attach("map.csv", "text/csv", b"")
        bag.close()
        before = bag.path.read_bytes()
        bag.close()
        assert bag.path.read_bytes() == before and read_attachments(folder) == {"map.csv": b""}
    bag = recorded(tmp_path / "run")
    before = bag.file.read_bytes()
    with pytest.raises(BagError, match="not empty"):
        BagWriter(bag.directory)
    assert bag.file.read_bytes() == before
    with pytest.raises(BagError, match="cannot be made"):
        BagWriter(bag.file / "bag")


def test_a_topic_or_a_message_that_is_not_allowed_is_named_with_what_is(tmp_path):
    kind = ENCODER.layout.type_name
    with BagWriter(tmp_path / "bag") as bag:
        bag.add(Topic("/encoder", kind))
        bag.write("/encoder", b"", 0, 0)
        unknown, negative, late = ("/unknown", b"", 1, 1), ("/encoder", b"", -1, 0), ("/encoder", b"", 0, 0)
        for refused, words in (
            (lambda: bag.add(Topic("encoder", kind)), "starts with '/'"),
            (lambda: bag.add(Topic("/encoder", kind)), "already in the bag"),
            (lambda: bag.write(*unknown), "'/unknown' was not added; known are /encoder"),
            (lambda: bag.write_all([late, unknown]), "'/unknown' was not added"),
            (lambda: bag.write(*negative), "log time is -1 ns"),
            (lambda: bag.write_all([late, negative]), "log time is -1 ns"),
        ):
            with pytest.raises(BagError, match=words):
                refused()
    for refused in (lambda: bag.write(*late), lambda: bag.write_all([late])):
        with pytest.raises(BagError, match="is closed"):
            refused()


class SmallDisk:
    """A file on a disk that is full from a size of ``limit`` bytes on."""

    def __init__(self, file, limit):
        self._file, self._limit = file, limit

    def write(self, data):
        room = self._limit - self._file.tell()
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(data[:room])

    def __getattr__(self, name):
        return getattr(self._file, name)


def test_a_full_disk_costs_the_last_chunk_and_not_the_bag(tmp_path):
    written = messages(100)
    kept, rest = written[:100], written[100:]
    bag = BagWriter(tmp_path / "bag", compression="none", chunk_size=50_000)
    add_streams(bag)
    write(bag, kept)
    bag.flush_older(0.0)
    bag._output._file = SmallDisk(bag._output._file, bag.path.stat().st_size + 40_000)
    with pytest.raises(BagError, match="cannot be written: No space left on device; free space"):
        write(bag, rest)
    with pytest.raises(BagError, match="cannot be written: No space left on device; free space"):
        bag.write_all(rest)
    with pytest.raises(BagError, match=r"the disk took no more, the last (\d+) messages are lost") as lost:
        bag.close()
    # Those of the chunk that did not fit any more, and what came together.
    count = int(re.search(r"last (\d+)", str(lost.value))[1]) - len(rest)
    assert 50_000 <= sum(31 + len(message.data) for message in rest[:count]) < 50_500
    with Reader(tmp_path / "bag") as reader:
        found = [data for _, _, data in reader.messages()]
    assert sorted(found) == sorted(message.data for message in kept)
    assert read_streams(tmp_path / "bag", LAYOUTS)


def test_messages_written_together_make_the_file_that_single_ones_make(tmp_path):
    # One is of a source that stamps before the epoch.
    some, stored = [one._replace(publish_time=-5 * (one.log_time % 2)) for one in messages(400)], []
    for together in (False, True):
        folder = tmp_path / str(together) / "bag"
        with BagWriter(folder, chunk_size=20_000, max_duration=0.05) as bag:
            add_streams(bag)
            for first in range(0, len(some), 37):
                (bag.write_all if together else partial(write, bag))(some[first : first + 37])
        with Reader(folder) as reader:
            found = [(connection.topic, time, data) for connection, time, data in reader.messages()]
        stored.append((found, [file["message_count"] for file in information(folder)["files"]]))
    assert stored[0] == stored[1] and len(stored[0][0]) == len(some)


COUNT = 1200


@pytest.fixture(scope="module")
def three_files(tmp_path_factory) -> Recording:
    return recorded(tmp_path_factory.mktemp("written") / "split", COUNT, max_duration=0.2, chunk_size=20_000)


@pytest.fixture
def split(three_files, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return shutil.copytree(three_files.directory, tmp_path / "split")


def test_a_bag_is_split_by_duration_listed_as_rosbag2_does_and_read_whole_by_others_and_by_us(three_files):
    bag, written = three_files.directory, three_files.messages
    found, names = information(bag), [f"split_{number}.mcap" for number in range(3)]
    assert found["relative_file_paths"] == [entry["path"] for entry in found["files"]] == names
    assert [file.name for file in found_files(bag)[0]] == names
    assert sum(entry["message_count"] for entry in found["files"]) == found["message_count"] == len(written)
    assert all(entry["duration"]["nanoseconds"] < 0.2e9 for entry in found["files"])
    times = [message.log_time for message in written]
    assert found["starting_time"]["nanoseconds_since_epoch"] == min(times)
    assert found["duration"]["nanoseconds"] == max(times) - min(times)
    with Reader(bag) as reader:
        theirs = [(c.topic, bytes(data)) for c, _, data in reader.messages()]
    # rosbags reads by log time.
    assert sorted(theirs) == sorted((message.topic, message.data) for message in written)
    streams = read_streams(bag, LAYOUTS)
    assert all(len(stream) == COUNT for stream in streams.values())
    assert (np.diff(streams["encoder"].stamp) == 500_000).all()
    assert len(read_field(bag, Field("encoder", "position[stage_x]")).stamp) == COUNT
    assert len(read_messages(bag, "encoder").data) == COUNT
    assert read_metadata(bag)["survey"] == {"guide": "synthetic", "points": "177"}
    assert read_attachments(bag) == {"parameters.yaml": b"rate: 2000\n", "metadata.yaml": ANY}


def test_a_bag_is_one_file_if_nothing_else_is_asked_for_and_counts_a_topic_of_one_file_in_the_whole(tmp_path):
    data, day = messages(1)[0].data, 86_400_000_000_000
    for name, limit, files in (("one", {}, 1), ("three", {"max_duration": 1.0}, 3)):
        with BagWriter(tmp_path / name, **limit) as bag:
            for topic in ("/always", "/late"):
                bag.add(Topic(topic, ENCODER.layout.type_name, TopicQos("best_effort")))
            write(bag, [("/always", data, day * number, day * number) for number in range(3)])
            bag.write("/late", data, 2 * day, 2 * day)
        found = information(tmp_path / name)
        counts = {each["topic_metadata"]["name"]: each["message_count"] for each in found["topics_with_message_count"]}
        assert len(found["files"]) == len(found_files(tmp_path / name)[0]) == files
        assert counts == {"/always": 3, "/late": 1}


@pytest.mark.parametrize("step", [1, -1])
def test_a_step_of_the_clock_either_way_begins_one_file_though_the_topics_of_a_batch_alternate(tmp_path, step):
    data, day, topics = messages(1)[0].data, 86_400_000_000_000, [f"/{letter}" for letter in "abcde"]
    with BagWriter(tmp_path / "bag", max_duration=60.0) as bag:
        for topic in topics:
            bag.add(Topic(topic, ENCODER.layout.type_name, TopicQos("best_effort")))
        for batch in ([0, 0], [0, step], [step, step]):
            times = [(5 + days) * day for days in batch]
            bag.write_all([(topic, data, time, time) for topic in topics for time in times])
    found = information(tmp_path / "bag")
    assert len(found["files"]) == 2 and found["message_count"] == 30


def test_a_bag_is_split_by_size(tmp_path):
    recording = recorded(tmp_path / "large", COUNT, max_size=60_000, chunk_size=20_000, compression="none")
    *full, _ = [file.stat().st_size for file in found_files(recording.directory)[0]]
    # The chunk that made it so, its index, and the file's own end.
    assert len(full) > 2 and all(60_000 <= size < 110_000 for size in full)


def test_a_bag_whose_first_files_are_not_there_and_not_listed_is_read_and_said_to_begin_later(split):
    for name in ("split_0.mcap", "metadata.yaml"):
        (split / name).unlink()
    with pytest.warns(UserWarning, match=r"begins with split_1\.mcap"):
        assert read_streams(split, LAYOUTS)


def test_the_last_file_of_a_killed_recording_may_be_cut_off_or_empty(split, tmp_path):
    (split / "metadata.yaml").unlink()
    last = split / "split_2.mcap"
    last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    with pytest.warns(UserWarning, match="split_2.mcap was not finished"):
        stream = read_streams(split, LAYOUTS)["encoder"]
    assert 800 <= len(stream) < COUNT
    result = recover(split, tmp_path / "saved")
    assert result.unfinished == ["split_2.mcap"]
    assert result.saved["/encoder"] == len(stream)
    assert len(found_files(tmp_path / "saved")[0]) == 1
    last.write_bytes(b"")
    assert len(read_streams(split, LAYOUTS)["encoder"]) == 800


def test_a_file_that_cannot_be_opened_leaves_a_finished_bag_of_those_before(tmp_path, monkeypatch):
    written = messages(COUNT)
    with pytest.raises(BagError, match="No space"), BagWriter(tmp_path / "full", max_duration=0.2) as bag:
        add_streams(bag)
        for message in written:
            if message.log_time - written[0].log_time > 0.3e9:
                monkeypatch.setattr(McapOutput, "__init__", refuse)
            bag.write(*message)
    monkeypatch.undo()
    found = information(tmp_path / "full")
    assert found["relative_file_paths"] == ["full_0.mcap", "full_1.mcap"]
    assert len(read_streams(tmp_path / "full", LAYOUTS)["encoder"]) == found["message_count"] // len(STREAMS)


def test_a_file_of_another_program_in_the_place_of_the_next_one_stays(tmp_path):
    with pytest.raises(BagError, match="File exists"), BagWriter(tmp_path / "bag") as bag:
        bag.add(Topic("/encoder", ENCODER.layout.type_name))
        bag.split()
        assert bag.path.name == "bag_0.mcap"  # a file without messages is kept
        bag.write("/encoder", b"", 1, 1)
        (tmp_path / "bag" / "bag_1.mcap").write_bytes(b"theirs")
        bag.split()
    assert (tmp_path / "bag" / "bag_1.mcap").read_bytes() == b"theirs"
    assert information(tmp_path / "bag")["message_count"] == 1


def test_what_is_written_is_brought_to_the_disk_at_its_interval_and_each_name_once(tmp_path, monkeypatch):
    now, synced, names = [1000.0], [], []
    monkeypatch.setattr(writer_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(writer_module, "sync_names", names.append)
    monkeypatch.setattr(McapOutput, "sync", lambda self: synced.append(now[0]))
    with BagWriter(tmp_path / "bag") as bag:
        bag.add(Topic("/encoder", ENCODER.layout.type_name))
        bag.sync_older(0.0)
        for _ in range(5):
            bag.sync_older(0.25)
            now[0] += 0.125
        assert synced == [1000.0, 1000.25, 1000.5] and names == [tmp_path / "bag", tmp_path]
        bag.write("/encoder", b"", 1, 1)
        bag.split()
        bag.sync_older(0.125)
        assert names == [tmp_path / "bag", tmp_path] * 2
    bag.sync_older(0.125)
    assert len(synced) == 4


def refuse(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")

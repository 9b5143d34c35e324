"""Damaged and cut-off bags: a clear refusal, or a warning and what is whole; never a wrong number."""

import os
import random
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from recording import LAYOUTS, add_streams, messages

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_attachments, read_metadata, read_streams
from straightcomp_ros.bags.writer import BagWriter


def read(path):
    """(streams, whether a warning was given); None for the streams when the bag was refused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            streams = read_streams(path, LAYOUTS)
        except BagError as error:
            assert str(path) in str(error) and ";" in str(error)
            return None, bool(caught)
    return streams, bool(caught)


def assert_prefix(part, whole):
    """Every column of ``part`` is the start of the same column of ``whole``, to the last bit."""
    for topic, stream in part.items():
        count = len(stream)
        assert 0 < count <= len(whole[topic])
        for name in ("log_time", "publish_time", "stamp"):
            assert np.array_equal(getattr(stream, name), getattr(whole[topic], name)[:count])
        for name, values in stream.columns.items():
            assert values.tobytes() == whole[topic].columns[name][:count].tobytes()


def assert_whole(found, whole):
    assert list(found) == list(whole)
    assert_prefix(found, whole)
    assert [len(stream) for stream in found.values()] == [len(stream) for stream in whole.values()]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_bag_cut_off_anywhere_is_refused_or_read_up_to_the_cut_with_a_warning(record, tmp_path, compression):
    bag = record(count=60, compression=compression, chunk_size=6000)
    content, whole = bag.file.read_bytes(), read_streams(bag.directory, LAYOUTS)
    cut = tmp_path / "cut.mcap"
    counts = []
    for size in [*range(0, len(content), 997), *range(len(content) - 45, len(content))]:
        cut.write_bytes(content[:size])
        streams, warned = read(cut)
        if streams is not None:
            assert warned
            assert_prefix(streams, whole)
            counts.append(sum(map(len, streams.values())))
    assert counts == sorted(counts)
    assert counts[-1] == len(bag.messages)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_flipped_bit_is_refused_or_without_effect(record, tmp_path, compression):
    bag = record(count=12, compression=compression, chunk_size=3000)
    content, whole = bag.file.read_bytes(), read_streams(bag.directory, LAYOUTS)
    flipped = tmp_path / "flipped.mcap"
    source = random.Random(11)
    refused = 0
    for place in [*range(0, len(content), 53), *range(60), *range(len(content) - 45, len(content))]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << source.randrange(8)
        flipped.write_bytes(damaged)
        streams, warned = read(flipped)
        if streams is None:
            refused += 1
        elif warned:
            assert_prefix(streams, whole)
        else:
            assert_whole(streams, whole)
    assert refused > 10


def test_a_flipped_bit_in_attachments_or_metadata_is_refused_or_without_effect(record, tmp_path):
    bag = record(count=2)
    content = bag.file.read_bytes()
    attachments, metadata = read_attachments(bag.file), read_metadata(bag.file)
    flipped = tmp_path / "flipped.mcap"
    for place in range(0, len(content), 17):
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        flipped.write_bytes(damaged)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for function, expected in ((read_attachments, attachments), (read_metadata, metadata)):
                try:
                    found = function(flipped)
                except BagError:
                    continue
                assert found == expected or caught


def test_random_bytes_behind_the_magic_are_refused(tmp_path):
    source = random.Random(5)
    path = tmp_path / "noise.mcap"
    for _ in range(300):
        path.write_bytes(b"\x89MCAP0\r\n" + source.randbytes(source.randrange(400)))
        assert read(path)[0] is None


def test_a_chunk_that_never_reached_the_disk_ends_the_reading(record, tmp_path):
    bag = BagWriter(tmp_path / "bag")
    add_streams(bag)
    for message in messages(10):
        bag.write(message.topic, message.data, message.log_time, message.publish_time)
    bag.flush()
    size = bag.path.stat().st_size
    for message in messages(10):
        bag.write(message.topic, message.data, message.log_time, message.publish_time)
    bag.flush()
    content = bag.path.read_bytes()
    bag.close()
    cut = tmp_path / "cut.mcap"
    for kept in (size, size + 9, size + 200):
        cut.write_bytes(content[:kept] + bytes(len(content) - kept))
        streams, warned = read(cut)
        assert warned
        assert {len(stream) for stream in streams.values()} == {10}


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("run_0.mcap", b"", "is empty: the recording was never started"),
        ("run_0.mcap", b"SQLite format 3\0", "is not an MCAP file"),
        ("run_0.mcap", b"\x89MCAP0\r\n", "has no messages"),
        ("run_0.txt", b"", "holds no .mcap"),
        ("run_0.db3", b"", "is no SQLite bag of rosbag2, or is damaged: no such table: topics; copy it again"),
        ("run_0.mcap.zstd", b"", "compressed as a whole; .*unzstd"),
        ("../elsewhere", b"", "does not exist"),
    ],
)
@pytest.mark.filterwarnings("ignore:bag .* was not finished")
def test_what_is_no_bag_is_refused_with_the_reason(tmp_path, name, content, reason):
    folder = tmp_path / "bag"
    if ".." not in name:
        folder.mkdir()
        (folder / name).write_bytes(content)
    with pytest.raises(BagError, match=reason):
        read_streams(folder, LAYOUTS)


def test_a_killed_recording_loses_the_open_chunk_at_most(tmp_path):
    chunk_size = 5000
    program = f"""
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parent)!r})
from recording import add_streams, messages
from straightcomp_ros.bags.writer import BagWriter
bag = BagWriter(Path({str(tmp_path / "bag")!r}), chunk_size={chunk_size})
add_streams(bag)
for message in messages(100):
    bag.write(message.topic, message.data, message.log_time, message.publish_time)
os.kill(os.getpid(), signal.SIGKILL)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ended = subprocess.run([sys.executable, "-c", program], check=False, env=environment)
    assert ended.returncode == -signal.SIGKILL
    streams, warned = read(tmp_path / "bag")
    assert warned
    kept = sum(map(len, streams.values()))
    written = messages(100)
    assert sum(len(message.data) for message in written[kept:]) < chunk_size
    x = [
        values
        for message in written[:kept]
        if message.topic == "/encoder"
        for values in LAYOUTS["encoder"].unpack(message.data)[1][:1]
    ]
    assert streams["encoder"].columns["x"].tobytes() == np.array(x).tobytes()

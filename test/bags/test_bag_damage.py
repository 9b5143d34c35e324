"""Damaged and cut-off bags: a clear refusal, or a warning and what is whole; never a wrong number."""

import os
import random
import re
import struct
import warnings
from unittest.mock import Mock

import numpy as np
import pytest
from mcap.opcode import Opcode
from recording import LAYOUTS, add_streams, chunk, chunk_of, mcap_of, messages, record, recorded, records, write
from rosbags.rosbag2 import Reader
from tiers import nightly

from straightcomp_ros.bags import BagError, mcap_input, recovery
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata, read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.writer import BagWriter


def read_everything(path):
    return read_streams(path, LAYOUTS)


def read(path, reader=read_everything):
    """(what is read, whether a warning was given); None for what is read when the bag was refused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return reader(path), bool(caught)
        except BagError as error:
            assert str(path) in str(error) and ";" in str(error)
            return None, bool(caught)


def assert_prefix(part, whole):
    """Every column of ``part`` is the start of the same column of ``whole``, to the last bit."""
    for topic, stream in part.items():
        count = len(stream)
        assert 0 < count <= len(whole[topic])
        for name in ("log_time", "stamp"):
            assert np.array_equal(getattr(stream, name), getattr(whole[topic], name)[:count])
        for name, values in stream.columns.items():
            assert values.tobytes() == whole[topic].columns[name][:count].tobytes()


def assert_whole(found, whole):
    assert list(found) == list(whole)
    assert_prefix(found, whole)
    assert [len(stream) for stream in found.values()] == [len(stream) for stream in whole.values()]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_bag_cut_off_anywhere_is_refused_or_read_and_recovered_up_to_the_cut(tmp_path, compression):
    bag = recorded(tmp_path / "run", 60, compression=compression, chunk_size=6000)
    content, whole = bag.file.read_bytes(), read_streams(bag.directory, LAYOUTS)
    every = {(message.topic, message.log_time, message.data) for message in bag.messages}
    cut = tmp_path / "cut.mcap"
    counts = []
    for number, size in enumerate([*range(0, len(content), 997), *range(len(content) - 45, len(content))]):
        cut.write_bytes(content[:size])
        streams, warned = read(cut)
        if streams is None:
            continue
        assert warned
        assert_prefix(streams, whole)
        counts.append(sum(map(len, streams.values())))
        if number % 7 == 0 or size == len(content) - 9:
            result = recover(cut, tmp_path / f"new{size}")
            with Reader(tmp_path / f"new{size}") as reader:
                saved = [(one.topic, time_ns, bytes(data)) for one, time_ns, data in reader.messages()]
            assert set(saved) <= every and len(saved) == len(set(saved)) == result.saved.total() == counts[-1]
            assert result.lost is None and result.unfinished
    assert counts == sorted(counts)
    assert counts[-1] == len(bag.messages)


@pytest.mark.parametrize("compression", ["zstd", "none", *nightly(["lz4"])])
def test_flipped_bits_are_refused_or_without_effect_and_bring_no_message_that_was_not_recorded(tmp_path, compression):
    bag = recorded(tmp_path / "run", 12, compression=compression, chunk_size=3000)
    content, whole = bag.file.read_bytes(), read_streams(bag.directory, LAYOUTS)
    others = {reader: reader(bag.file) for reader in (read_attachments, read_metadata)}
    every = {(message.log_time, message.data) for message in bag.messages}
    flipped = tmp_path / "flipped.mcap"
    source = random.Random(11)
    refused = 0
    places = [*range(0, len(content), 53), *range(60), *range(len(content) - 45, len(content))]
    for number, place in enumerate(places):
        damaged = bytearray(content)
        for at in (place, *source.sample(range(8, len(content)), number % 3)):
            damaged[at] ^= 1 << source.randrange(8)
        flipped.write_bytes(damaged)
        streams, warned = read(flipped)
        refused += streams is None
        if streams is not None:
            (assert_prefix if warned else assert_whole)(streams, whole)
        for reader, expected in others.items():
            found, warned = read(flipped, reader)
            assert found in (None, expected) or warned
        if number % 10 == 0 and place >= 8:
            recover(flipped, tmp_path / f"new{number}")
            with Reader(tmp_path / f"new{number}") as saved:
                assert {(time_ns, bytes(data)) for _, time_ns, data in saved.messages()} <= every
    assert refused > 10


def test_a_chunk_that_never_reached_the_disk_ends_the_reading(tmp_path):
    bag = recorded(tmp_path / "run", 60, chunk_size=6000)
    content, cut = bag.file.read_bytes(), tmp_path / "cut.mcap"
    _, second, *_ = records(content, Opcode.CHUNK)
    cut.write_bytes(content[:second])
    before, _ = read(cut)
    for kept in (second, second + 9, second + 200):
        cut.write_bytes(content[:kept] + bytes(len(content) - kept))
        streams, warned = read(cut)
        assert warned
        assert_whole(streams, before)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("run_0.mcap", b"SQLite format 3\0", "is not an MCAP file"),
        ("run_0.mcap", b"\x89MCAP0\r\n", "has no messages"),
        ("run_0.txt", b"", "holds no .mcap"),
        ("run_0.db3", b"", "is no SQLite bag of rosbag2, or is damaged: no such table: topics; copy it again"),
        ("../elsewhere", b"", "does not exist"),
        ("run_0.mcap", None, "is no file"),
    ],
)
@pytest.mark.filterwarnings("ignore:bag .* was not finished")
def test_what_is_no_bag_is_refused_with_the_reason(tmp_path, name, content, reason):
    folder = tmp_path / "bag"
    if ".." not in name:
        folder.mkdir()
        os.mkfifo(folder / name) if content is None else (folder / name).write_bytes(content)
    with pytest.raises(BagError, match=reason):
        read_streams(folder, LAYOUTS)


def test_a_killed_recording_loses_the_open_chunk_at_most(tmp_path):
    written, left = messages(100), tmp_path / "left.mcap"
    with BagWriter(tmp_path / "bag", chunk_size=5000) as bag:
        add_streams(bag)
        write(bag, written)
        # What the system has of the file; all else would end with the process.
        left.write_bytes(bag.path.read_bytes())
    streams, warned = read(left)
    assert warned
    assert_prefix(streams, read_streams(tmp_path / "bag", LAYOUTS))
    assert sum(len(message.data) for message in written[sum(map(len, streams.values())) :]) < 5000


# Within a chunk: size, CRC, the end of its compression's name.
SIZE_AT, CRC_AT, NAME_END_AT = 9 + 16, 9 + 24, 9 + 35
UNKNOWN = r"a chunk cannot be unpacked \(compression is 'zstf': allowed are zstd, lz4 and none\)"
NO_RECORD = "no record starts here, or it is longer than the file"
LENGTH = r"a chunk has \d+ bytes, not \d+"


@pytest.mark.parametrize(
    ("compression", "opcode", "at", "number", "words"),
    [
        ("zstd", Opcode.CHUNK, CRC_AT, 1, "the checksum of a chunk is wrong"),
        ("zstd", Opcode.CHUNK, NAME_END_AT, 2, UNKNOWN),
        ("zstd", Opcode.CHUNK, 6, 1, NO_RECORD),
        *(("zstd", Opcode.CHUNK, 0, opcode - Opcode.CHUNK, NO_RECORD) for opcode in (0x00, 0x10, 0x7F)),
        ("zstd", Opcode.ATTACHMENT, -6, 1, "the checksum of an attachment is wrong"),
        ("lz4", Opcode.CHUNK, SIZE_AT, 1, LENGTH),
        ("none", Opcode.CHUNK, SIZE_AT, 1, LENGTH),
    ],
)
def test_damage_is_reported_with_its_byte_and_what_is_wrong_there(tmp_path, compression, opcode, at, number, words):
    """``number`` is added to the byte ``at`` of a record, from its end if negative."""
    file = recorded(tmp_path / "run", 40, chunk_size=6000, compression=compression).file
    content = bytearray(file.read_bytes())
    place = records(content, opcode)[-1]
    (length,) = struct.unpack_from("<Q", content, place + 1)
    changed = place + at + (9 + length if at < 0 else 0)
    content[changed] = (content[changed] + number) % 256
    file.write_bytes(content)
    with pytest.raises(BagError, match=rf"^bag {file} is damaged at byte {place}: {words}; copy the bag again"):
        (read_attachments if opcode == Opcode.ATTACHMENT else read_everything)(file)


def test_a_file_is_closed_when_it_is_refused(tmp_path):
    path = tmp_path / "empty.mcap"
    path.write_bytes(b"")
    with warnings.catch_warnings(), pytest.raises(BagError, match="is empty: the recording was never started"):
        warnings.simplefilter("error", ResourceWarning)
        McapInput(path)
    with pytest.raises(BagError, match=r"nowhere\.mcap cannot be read: No such file or directory; check the path"):
        McapInput(tmp_path / "nowhere.mcap")


CHANNEL = Opcode.CHANNEL, struct.pack("<HHI2sI3sI", 1, 0, 2, b"/x", 3, b"cdr", 0)


def loose(channel, data=b""):
    return Opcode.MESSAGE, struct.pack("<HIQQ", channel, 0, 7, 7) + data


SHORT = Opcode.MESSAGE, b"\1" + bytes(20)
"""A message needs 22 bytes: channel, number and two times."""


def test_an_applications_own_records_are_passed_over(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap_of((0x80, b"own"), CHANNEL, chunk(loose(1)), (0xFF, b""), chunk(loose(1))))
    assert len(read_messages(path, "/x").data) == 2
    result = recover(path, tmp_path / "new")
    assert result.whole and result.saved == {"/x": 2}


@pytest.mark.parametrize("said", [2, 4, 8])
def test_statistics_with_another_number_of_messages_refuse_a_file_and_count_no_negative_loss(tmp_path, said):
    path = tmp_path / "run.mcap"
    statistics = struct.pack("<QHIIIIQQIHQ", said, 0, 1, 0, 0, 0, 7, 7, 10, 1, said)
    path.write_bytes(mcap_of(CHANNEL, *[loose(1)] * 3, summary=record(Opcode.STATISTICS, statistics)))
    with pytest.raises(BagError, match=f"at byte 0: it holds 3 messages, and its statistics say {said};"):
        read_messages(path, "/x")
    result = recover(path, tmp_path / "new")
    assert (result.saved, result.lost, result.whole) == ({"/x": 3}, {"/x": max(said - 3, 0)}, False)


def test_messages_outside_chunks_are_taken_in_blocks_with_their_places(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_input, "_LOOSE_SIZE", 100)
    path = tmp_path / "loose.mcap"
    # Of 41 bytes each; a chunk among them is a block of its own.
    messages = [loose(1, bytes([number] * 10)) for number in range(7)]
    path.write_bytes(mcap_of(CHANNEL, *messages[:4], chunk(messages[4]), *messages[5:]))
    with McapInput(path) as file:
        blocks = list(file.blocks(["/x"]))
    assert [places["/x"].tolist() for _, places in blocks] == [[0, 41, 82], [0], [0], [0, 41]]
    assert b"".join(data for data, _ in blocks) == b"".join(record(*one) for one in messages)


@pytest.mark.parametrize(
    ("wrong", "words", "here", "saved"),
    [
        (loose(9), "it has messages of a channel 9 that it does not describe", False, 2),
        (SHORT, "a message is too short", True, 2),
        (chunk(loose(9)), "it has messages of a channel 9 that it does not describe", False, 2),
        (chunk(loose(1), SHORT), "a message is too short", True, 3),
    ],
)
def test_a_message_that_cannot_be_one_is_damage_where_it_stands_and_the_others_are_saved(
    tmp_path, wrong, words, here, saved
):
    path, good = tmp_path / "run.mcap", chunk(loose(1))
    content = mcap_of(CHANNEL, good, wrong, good)
    path.write_bytes(content)
    place = content.index(record(*wrong))
    with McapInput(path) as file, pytest.raises(BagError, match=re.escape(words)) as refused:
        list(file.blocks(["/x"]))
    assert refused.value.damage == words and f"at byte {place if here else 0}:" in str(refused.value)
    result = recover(path, tmp_path / "new")
    assert result.saved == {"/x": saved}
    ((name, start, length, _),) = result.gaps
    assert (name, start) == ("run.mcap", place) and 0 < length <= len(record(*wrong))


def test_behind_a_record_of_a_wrong_length_the_next_sound_chunk_is_found_wherever_it_starts(tmp_path, monkeypatch):
    wrong = bytearray(record(Opcode.METADATA, struct.pack("<I1sI", 1, b"a", 0)))
    wrong[1] += 3  # into the next record
    good = chunk(loose(1))
    # What looks like chunks: one is longer than the file, another is of an unknown compression.
    noise = bytes([6]) * 20 + record(*chunk_of(b"x", b"xz"))
    content = mcap_of(CHANNEL, good, good)
    place = content.index(record(*good)) + len(record(*good))
    path = tmp_path / "run.mcap"
    path.write_bytes(content[:place] + wrong + noise + content[place:])
    (tmp_path / "cut.mcap").write_bytes(content[:place])
    result = recover(tmp_path / "cut.mcap", tmp_path / "of_cut")
    assert (result.saved, result.gaps, result.unfinished) == ({"/x": 1}, [], ["cut.mcap"])
    for size in (1 << 20, 1, 7, 30):
        monkeypatch.setattr(recovery, "_SEARCH_SIZE", size)
        result = recover(path, tmp_path / f"new{size}")
        assert result.saved == {"/x": 2}
        assert result.gaps == [("run.mcap", place, len(wrong + noise), "a record's length is wrong")]


@pytest.mark.parametrize("place", [3, 30])
def test_a_disk_that_does_not_read_is_named_with_the_byte(tmp_path, place):
    (tmp_path / "run.mcap").write_bytes(mcap_of(CHANNEL))
    with McapInput(tmp_path / "run.mcap") as file:
        assert file.finished and file.read(place, 5) == mcap_of(CHANNEL)[place : place + 5]
        file._file.close()
        file._file = Mock(seek=Mock(side_effect=OSError(5, "Input/output error")))
        with pytest.raises(BagError, match=f"cannot be read at byte {place}: Input/output error"):
            file.read(place, 5)


@pytest.mark.parametrize(
    ("summary", "finished"), [(None, True), (b"", True), (record(Opcode.STATISTICS, b"x"), False), (b"\x0b", False)]
)
def test_a_file_whose_summary_cannot_be_read_was_not_finished(tmp_path, summary, finished):
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap_of(CHANNEL, loose(1, b"abcd"), summary=summary))
    with McapInput(path) as file:
        assert file.finished is finished
        assert [places["/x"].tolist() for _, places in file.blocks(["/x"])] == [[0]]

"""What is said of a damaged bag: where the damage is, in bytes, and what is wrong there."""

import re
import struct
import warnings

import numpy as np
import pytest
from mcap.opcode import Opcode
from recording import LAYOUTS

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.mcap_input import McapInput, Record
from straightcomp_ros.bags.reader import read_attachments, read_streams
from straightcomp_ros.bags.recovery import _checked
from straightcomp_ros.contract import STREAMS

MAGIC_SIZE, FRAME_SIZE = 8, 9
# Within a chunk: two times, size, CRC, the name of the compression.
SIZE_AT, CRC_AT, NAME_AT = 16, 24, 32


class Bag:
    """The bytes of a bag, to be changed in places."""

    def __init__(self, file):
        self.file, self.content = file, bytearray(file.read_bytes())

    def record(self, opcode, which=0):
        """Offset of the ``which``-th record of this kind."""
        position, found = MAGIC_SIZE, []
        while position < len(self.content) - MAGIC_SIZE:
            kind, length = struct.unpack_from("<BQ", self.content, position)
            found += [position] * (kind == opcode)
            position += FRAME_SIZE + length
        return found[which]

    def add(self, offset, number, size=4):
        value = int.from_bytes(self.content[offset : offset + size], "little") + number
        self.content[offset : offset + size] = value.to_bytes(size, "little")

    def without_crc_of_the_summary(self):
        footer = self.record(Opcode.FOOTER)
        self.content[footer + FRAME_SIZE + 16 : footer + FRAME_SIZE + 20] = bytes(4)
        return self

    def without_crc_of_the_data(self):
        end = self.record(Opcode.DATA_END) + FRAME_SIZE
        self.content[end : end + 4] = bytes(4)
        return self

    def refusal(self, reader=lambda path: read_streams(path, LAYOUTS)):
        """Where the damage is said to be, and what it is."""
        self.file.write_bytes(self.content)
        with warnings.catch_warnings(), pytest.raises(BagError) as refused:
            warnings.simplefilter("error")
            reader(self.file)
        said = re.fullmatch(r"bag (.*) is damaged at byte (\d+): (.*); copy the bag again.*", str(refused.value))
        assert said is not None and said[1] == str(self.file), refused.value
        return int(said[2]), said[3]


@pytest.fixture
def bag(record):
    return Bag(record(count=40, chunk_size=6000, compression="zstd").file)


NO_RECORD = "no record starts here, or it is longer than the file"


def _wrong(opcode, which, at, number, size=1):
    """Add ``number`` to ``size`` bytes at ``at`` of a record; returns the record's place."""

    def change(bag):
        place = bag.record(opcode, which)
        bag.add(place + at, number, size)
        return place

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_wrong(Opcode.CHUNK, 1, FRAME_SIZE + CRC_AT, 1), "the checksum of a chunk is wrong"),
        (
            _wrong(Opcode.CHUNK, 0, FRAME_SIZE + NAME_AT + 3, 2),
            "a chunk cannot be unpacked (compression is 'zstf': allowed are zstd, lz4 and none)",
        ),
        (_wrong(Opcode.CHUNK, 2, 1, 1 << 40, 8), NO_RECORD),
        *((_wrong(Opcode.CHUNK, 2, 0, opcode - Opcode.CHUNK), NO_RECORD) for opcode in (0x00, 0x10, 0x7F)),
    ],
)
def test_damage_is_reported_with_its_byte_and_what_is_wrong_there(bag, change, words):
    place = change(bag)
    assert bag.refusal() == (place, words)


def test_a_chunk_without_a_checksum_is_covered_by_that_of_the_data_section(bag):
    chunk = bag.record(Opcode.CHUNK, 1)
    bag.content[chunk + FRAME_SIZE + CRC_AT : chunk + FRAME_SIZE + CRC_AT + 4] = bytes(4)
    assert bag.refusal() == (0, "the checksum of the data section is wrong")
    bag.without_crc_of_the_data().file.write_bytes(bag.content)
    assert len(read_streams(bag.file, LAYOUTS)["encoder"]) == 40


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_a_chunk_of_another_length_than_it_says(record, compression):
    bag = Bag(record(count=40, chunk_size=6000, compression=compression).file)
    chunk = bag.record(Opcode.CHUNK, 2)
    (size,) = struct.unpack_from("<Q", bag.content, chunk + FRAME_SIZE + SIZE_AT)
    bag.add(chunk + FRAME_SIZE + SIZE_AT, 1)
    assert bag.refusal() == (chunk, f"a chunk has {size} bytes, not {size + 1}")


def test_an_applications_own_records_are_passed_over(bag):
    start = bag.record(Opcode.CHUNK, 1)
    bag.content[start:start] = struct.pack("<BQ", 0x80, 3) + b"own"
    # The places in the summary are behind it now, and nobody needs them.
    footer = bag.without_crc_of_the_summary().record(Opcode.FOOTER)
    bag.add(footer + FRAME_SIZE, FRAME_SIZE + 3, 8)
    bag.file.write_bytes(bag.content)
    assert len(read_streams(bag.file, LAYOUTS)["encoder"]) == 40


def test_messages_beside_the_chunks_are_read_in_their_place(record):
    bag = Bag(record(count=40, chunk_size=6000, compression="none").file)
    whole = read_streams(bag.file, LAYOUTS)
    for which in (0, 2):
        chunk = bag.record(Opcode.CHUNK, which)
        (length,) = struct.unpack_from("<Q", bag.content, chunk + 1)
        # The name of no compression is empty, and the length of the records follows.
        inside = bag.content[chunk + FRAME_SIZE + NAME_AT + 8 : chunk + FRAME_SIZE + length]
        bag.content[chunk : chunk + FRAME_SIZE + length] = inside
        footer = bag.without_crc_of_the_summary().record(Opcode.FOOTER)
        bag.add(footer + FRAME_SIZE, len(inside) - FRAME_SIZE - length, 8)
    bag.without_crc_of_the_data().file.write_bytes(bag.content)
    found = read_streams(bag.file, LAYOUTS)
    assert found.keys() == whole.keys()
    for topic, stream in found.items():
        assert np.array_equal(stream.log_time, whole[topic].log_time)


def test_a_file_with_more_or_fewer_messages_than_its_statistics_say(bag):
    count = 40 * len(STREAMS)
    bag.add(bag.without_crc_of_the_summary().record(Opcode.STATISTICS) + FRAME_SIZE, 5, 8)
    assert bag.refusal() == (0, f"it holds {count} messages, and its statistics say {count + 5}")


def test_an_attachment_whose_checksum_is_wrong(bag):
    attachment = bag.record(Opcode.ATTACHMENT)
    (length,) = struct.unpack_from("<Q", bag.content, attachment + 1)
    bag.content[attachment + FRAME_SIZE + length - 6] ^= 1
    assert bag.refusal(read_attachments) == (attachment, "the checksum of an attachment is wrong")


def test_a_data_section_whose_checksum_is_wrong(bag):
    def check(path):
        with McapInput(path) as file:
            (record,) = file.records(Opcode.DATA_END)
            file.check_data_section(record)

    check(bag.file)
    end = bag.record(Opcode.DATA_END)
    bag.content[end + FRAME_SIZE : end + FRAME_SIZE + 4] = b"\1\2\3\4"
    assert bag.refusal(check) == (0, "the checksum of the data section is wrong")


def test_a_file_is_closed_when_it_is_refused(tmp_path):
    path = tmp_path / "empty.mcap"
    path.write_bytes(b"")
    with warnings.catch_warnings(), pytest.raises(BagError, match="is empty: the recording was never started"):
        warnings.simplefilter("error", ResourceWarning)
        McapInput(path)
    with pytest.raises(BagError, match=r"nowhere\.mcap cannot be read: No such file or directory; check the path"):
        McapInput(tmp_path / "nowhere.mcap")


def test_the_shortest_message_is_one_without_data():
    # Channel, number and two times make 22 bytes.
    for length in (22, 23):
        assert _checked(None, Record(Opcode.MESSAGE, 0, bytes(length))) == (bytes(length), length)
    with pytest.raises(ValueError, match="too short"):
        _checked(None, Record(Opcode.MESSAGE, 0, bytes(21)))

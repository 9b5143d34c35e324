"""MCAP's conformance data (foxglove/mcap, tests/conformance): its six inputs with each set of features that means
something for them."""

import io
import itertools
import struct
import zlib
from functools import reduce
from operator import or_

import pytest
from mcap.opcode import Opcode
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from recording import chunk, mcap_of
from tiers import nightly

from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata
from straightcomp_ros.bags.recovery import recover

INPUTS = ("NoData", "OneSchemalessMessage", "OneMessage", "OneAttachment", "OneMetadata", "TenMessages")
TIMES = {"OneSchemalessMessage": (2,), "OneMessage": (2,), "TenMessages": (0, 2, 1, 3, 3, 5, 4, 7, 8, 9)}
FEATURES = ("use_chunking", "use_statistics", "repeat_schemas", "repeat_channels", "use_summary_offsets")
INDEXES = (IndexType.ATTACHMENT, IndexType.METADATA, IndexType.CHUNK, IndexType.MESSAGE)


def written(name: str, features: tuple[bool, ...]) -> bytes:
    options, out = dict(zip(FEATURES, features, strict=False)), io.BytesIO()
    indexes = reduce(or_, itertools.compress(INDEXES, features[len(FEATURES) :]), IndexType.NONE)
    options |= {"compression": CompressionType.NONE, "index_types": indexes, "enable_data_crcs": True}
    writer = Writer(out, **options)
    writer.start()
    if name == "OneAttachment":
        writer.add_attachment(2, 1, "myFile", "application/octet-stream", b"\1\2\3")
    elif name == "OneMetadata":
        writer.add_metadata("myMetadata", {"foo": "bar"})
    elif name in TIMES:
        schema = 0 if name == "OneSchemalessMessage" else writer.register_schema("Example", "c", b"\4\5\6")
        channel = writer.register_channel("example", "a", schema, {"foo": "bar"})
        for number, time_ns in enumerate(TIMES[name]):
            writer.add_message(channel, time_ns, b"\1\2\3", time_ns // 2, number)
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize("every", [7, *nightly([1])])
def test_all_files_of_the_conformance_suite_are_read_and_recovered_as_the_mcap_library_reads_them(tmp_path, every):
    sets = itertools.product((False, True), repeat=len(FEATURES) + len(INDEXES))
    # A feature that means nothing for an input changes nothing.
    files = sorted({(name, written(name, features)) for features in sets for name in INPUTS})
    assert len(files) > 200
    for number, (name, content) in enumerate(files[::every]):
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(content)
        theirs = [one for one in StreamReader(io.BytesIO(content)).records if isinstance(one, Message)]
        with McapInput(path) as file:
            blocks = list(file.blocks(["example"]))
            assert file.summary is not None and (not theirs or file.topics[1].name == "example")
        count = sum(len(places["example"]) for _, places in blocks)
        assert count == len(theirs) == len(TIMES.get(name, ()))
        result, new = recover(path, tmp_path / f"new{number}"), tmp_path / f"new{number}"
        assert result.whole and result.saved.total() == count, (name, result)
        for bag in (path, new) if theirs else ():
            ours = read_messages(bag, "example")
            found = zip(ours.log_time, ours.publish_time, ours.data, strict=True)
            assert list(found) == [(one.log_time, one.publish_time, one.data) for one in theirs]
        assert read_attachments(path) == ({"myFile": b"\1\2\3"} if name == "OneAttachment" else {})
        assert read_metadata(path) == ({"myMetadata": {"foo": "bar"}} if name == "OneMetadata" else {})
        assert read_attachments(new).items() >= read_attachments(path).items()


@pytest.mark.parametrize("chunked", [False, True])
def test_bytes_behind_the_fields_of_a_record_are_of_a_later_version(tmp_path, chunked):
    pad, text = b"\1\xff\xff", struct.Struct("<I3s").pack
    attached = struct.pack("<QQ", 2, 1) + text(3, b"map") + text(3, b"csv") + struct.pack("<Q3s", 3, b"\1\2\3")
    attached += zlib.crc32(attached).to_bytes(4, "little")
    schema = struct.pack("<H", 1) + text(3, b"two") + text(3, b"any") + bytes(4)
    channel = struct.pack("<HH", 1, 1) + text(3, b"one") + text(3, b"cdr") + bytes(4)
    metadata = text(3, b"foo") + struct.pack("<I", 14) + text(3, b"key") + text(3, b"bar")
    described = [(Opcode.SCHEMA, schema + pad), (Opcode.CHANNEL, channel + pad)]
    message = (Opcode.MESSAGE, b"\1" + bytes(23))
    messages = [chunk(*described, message)] if chunked else [*described, message]
    path = tmp_path / "padded.mcap"
    path.write_bytes(mcap_of(*messages, (Opcode.ATTACHMENT, attached + pad), (Opcode.METADATA, metadata + pad)))
    result = recover(path, tmp_path / "new")
    assert (result.saved, result.gaps) == ({"one": 1}, [])
    for bag in (path, tmp_path / "new"):
        assert read_messages(bag, "one").data == [b"\0\0"]
        assert read_attachments(bag)["map"] == b"\1\2\3" and read_metadata(bag)["foo"] == {"key": "bar"}

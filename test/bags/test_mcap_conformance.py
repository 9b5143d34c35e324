"""MCAP's conformance data, made as the public generator (foxglove/mcap, tests/conformance) makes them: six inputs with
all sets of features that mean something for them."""

import io
import itertools
import struct
import zlib

from mcap.opcode import Opcode
from mcap.records import Message
from mcap.stream_reader import StreamReader

from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata
from straightcomp_ros.bags.recovery import recover

SCHEMA = struct.pack("<HI7sI1sI3s", 1, 7, b"Example", 1, b"c", 3, b"\4\5\6")
CHANNEL = struct.pack("<HHI7sI1sI", 1, 1, 7, b"example", 1, b"a", 14) + struct.pack("<I3sI3s", 3, b"foo", 3, b"bar")
SCHEMALESS = struct.pack("<HHI7sI4sI", 1, 0, 7, b"example", 4, b"text", 0)
ATTACHMENT = struct.pack("<QQI6sI24sQ3s", 2, 1, 6, b"myFile", 24, b"application/octet-stream", 3, b"\1\2\3")
METADATA = struct.pack("<I10sI", 10, b"myMetadata", 14) + struct.pack("<I3sI3s", 3, b"foo", 3, b"bar")


def message_of(sequence: int, log_time: int, publish_time: int) -> tuple[int, bytes]:
    return Opcode.MESSAGE, struct.pack("<HIQQ3s", 1, sequence, log_time, publish_time, b"\1\2\3")


DESCRIBED = [(Opcode.SCHEMA, SCHEMA), (Opcode.CHANNEL, CHANNEL)]
TIMES = (0, 2, 1, 3, 3, 5, 4, 7, 8, 9)
INPUTS = {
    "NoData": [],
    "OneSchemalessMessage": [(Opcode.CHANNEL, SCHEMALESS), message_of(10, 2, 1)],
    "OneMessage": [*DESCRIBED, message_of(10, 2, 1)],
    "OneAttachment": [(Opcode.ATTACHMENT, ATTACHMENT + zlib.crc32(ATTACHMENT).to_bytes(4, "little"))],
    "OneMetadata": [(Opcode.METADATA, METADATA)],
    "TenMessages": [*DESCRIBED, *(message_of(number, time_ns, time_ns) for number, time_ns in enumerate(TIMES))],
}
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
NEEDS = {"ax": {Opcode.ATTACHMENT}, "mdx": {Opcode.METADATA}, "rsh": {Opcode.SCHEMA}, "rch": {Opcode.CHANNEL}}
IN_CHUNKS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
NEEDS |= dict.fromkeys(("ch", "chx", "mx"), IN_CHUNKS)


def variants() -> list[tuple[str, frozenset[str]]]:
    """Names of the inputs with each set of features that means something for them."""
    found = []
    for name, records in INPUTS.items():
        kinds = {opcode for opcode, _ in records}
        for chosen in itertools.product((False, True), repeat=len(FEATURES)):
            features = frozenset(itertools.compress(FEATURES, chosen))
            possible = all(NEEDS[one] & kinds for one in features & NEEDS.keys())
            summed = "sum" not in features or features & {"chx", "rsh", "rch", "mdx", "ax", "st"}
            if possible and summed and ("ch" in features or not features & {"chx", "mx"}):
                found.append((name, features))
    return found


def conformance_file(name: str, features: frozenset[str]) -> bytes:
    """The file of the public generator for these."""
    out = bytearray(b"\x89MCAP0\r\n")
    unpadded = {Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END, Opcode.FOOTER}

    def put(opcode: int, content: bytes, padded: bool = True) -> bytes:
        pad = b"\1\xff\xff" if "pad" in features and padded and opcode not in unpadded else b""
        return struct.pack("<BQ", opcode, len(content + pad)) + content + pad

    records = INPUTS[name]
    of_kind = {opcode: [content for kind, content in records if kind == opcode] for opcode, _ in records}
    messages = of_kind.get(Opcode.MESSAGE, [])
    times = [int.from_bytes(content[6:14], "little") for content in messages] or [0]
    out += put(Opcode.HEADER, bytes(8))
    in_chunk, index, groups = b"", b"", {}
    for opcode, content in records:
        if "ch" in features and opcode in IN_CHUNKS:
            if opcode == Opcode.MESSAGE:
                index += struct.pack("<QQ", int.from_bytes(content[6:14], "little"), len(in_chunk))
            in_chunk += put(opcode, content, padded=False)
            continue
        start, record = len(out), put(opcode, content)
        out += record
        if opcode == Opcode.ATTACHMENT and "ax" in features:
            fields = struct.pack("<QQQQQ", start, len(record), 2, 1, 3) + ATTACHMENT[16:54]
            groups[Opcode.ATTACHMENT_INDEX] = [put(Opcode.ATTACHMENT_INDEX, fields)]
        if opcode == Opcode.METADATA and "mdx" in features:
            fields = struct.pack("<QQI10s", start, len(record), 10, b"myMetadata")
            groups[Opcode.METADATA_INDEX] = [put(Opcode.METADATA_INDEX, fields)]
    if "ch" in features:
        start, span = len(out), struct.pack("<QQ", min(times), max(times))
        sizes = struct.pack("<QII", len(in_chunk), zlib.crc32(in_chunk), 0)
        chunk = put(Opcode.CHUNK, span + sizes + struct.pack("<Q", len(in_chunk)) + in_chunk)
        indexes = put(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, len(index)) + index) if "mx" in features else b""
        out += chunk
        offsets = struct.pack("<HQ", 1, len(out)) if indexes else b""
        out += indexes
        if "chx" in features:
            fields = span + struct.pack("<QQI", start, len(chunk), len(offsets)) + offsets
            fields += struct.pack("<QIQQ", len(indexes), 0, len(in_chunk), len(in_chunk))
            groups[Opcode.CHUNK_INDEX] = [put(Opcode.CHUNK_INDEX, fields)]
    out += put(Opcode.DATA_END, zlib.crc32(out).to_bytes(4, "little"))
    repeated = [(Opcode.SCHEMA, "rsh"), (Opcode.CHANNEL, "rch")]
    first = {kind: [put(kind, one) for one in of_kind[kind]] for kind, feature in repeated if feature in features}
    if "st" in features:
        numbers = [
            len(of_kind.get(kind, [])) for kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA)
        ]
        counts = struct.pack("<HQ", 1, len(messages)) if messages else b""
        fields = struct.pack("<QHIIII", len(messages), *numbers, "ch" in features)
        fields += struct.pack("<QQI", min(times), max(times), len(counts)) + counts
        first[Opcode.STATISTICS] = [put(Opcode.STATISTICS, fields)]
    summary_start, offsets = len(out), b""
    for opcode, parts in {**first, **groups}.items():
        offsets += put(Opcode.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, len(out), len(b"".join(parts))))
        out += b"".join(parts)
    has_summary = len(out) > summary_start
    offset_start = len(out) if "sum" in features else 0
    out += offsets if "sum" in features else b""
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start * has_summary, offset_start)
    crc = zlib.crc32(footer, zlib.crc32(out[summary_start:]))
    return bytes(out) + footer + crc.to_bytes(4, "little") + b"\x89MCAP0\r\n"


def test_all_files_of_the_conformance_suite_are_read_and_recovered_as_the_mcap_library_reads_them(tmp_path):
    every = variants()
    assert len(every) == 416
    for number, (name, features) in enumerate(every):
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(conformance_file(name, features))
        theirs = [record for record in StreamReader(io.BytesIO(path.read_bytes())).records]
        expected = [
            (record.log_time, record.publish_time, record.data) for record in theirs if isinstance(record, Message)
        ]
        with McapInput(path) as file:
            blocks = list(file.blocks(["example"]))
            assert file.summary is not None and (not expected or file.topics[1].name == "example")
        count = sum(len(places["example"]) for _, places in blocks)
        assert count == len(expected) == sum(kind == Opcode.MESSAGE for kind, _ in INPUTS[name])
        if expected:
            ours = read_messages(path, "example")
            assert list(zip(ours.log_time, ours.publish_time, ours.data, strict=True)) == expected
        assert read_attachments(path) == ({"myFile": b"\1\2\3"} if name == "OneAttachment" else {})
        assert read_metadata(path) == ({"myMetadata": {"foo": "bar"}} if name == "OneMetadata" else {})
        result = recover(path, tmp_path / f"new{number}")
        assert result.whole and result.saved.total() == count, (name, features, result)
        if expected:
            again = read_messages(tmp_path / f"new{number}", "example")
            assert (again.data, again.log_time, again.publish_time) == (ours.data, ours.log_time, ours.publish_time)
        assert read_attachments(tmp_path / f"new{number}").items() >= read_attachments(path).items()

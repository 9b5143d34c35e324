"""Bags as other writers make them: every verb reads them with the values of the plain bag, or refuses them by name."""

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import numpy as np
import pytest
import zstandard
from bag_of_rows import STORE
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from places import SMC
from recording import LAYOUTS, chunk_of, described, mcap_of, records, sqlite_bag

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.bags import PARAMETERS_ATTACHMENT, BagError
from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata, read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.offline.audit import audit

SAMPLE = next(SMC.glob("*.mcap"))
CYCLES = 800


class One(NamedTuple):
    """A message of the sample bag."""

    topic: str
    type_name: str
    text: bytes
    data: bytes
    log_time: int
    publish_time: int


@pytest.fixture(scope="module")
def whole_run() -> list[One]:
    """The messages of the sample bag in the order of recording."""
    with SAMPLE.open("rb") as file:
        return [
            One(channel.topic, schema.name, schema.data, message.data, message.log_time, message.publish_time)
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


@pytest.fixture(scope="module")
def sample(whole_run) -> list[One]:
    """The first samples of our streams in it."""
    found: list[One] = []
    counts = dict.fromkeys((f"/{topic}" for topic in LAYOUTS), 0)
    for one in whole_run:
        if counts.get(one.topic, CYCLES) < CYCLES:
            counts[one.topic] += 1
            found.append(one)
    return found


def written(
    messages,
    path,
    *,
    channel=lambda *_: 0,
    encoding="ros2msg",
    name=str,
    text=None,
    data=None,
    parameters=True,
    **how,
) -> Path:
    """Our messages as another writer stores them; ``channel(number, count)`` is that of a topic."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        to = Writer(file, **{"compression": CompressionType.ZSTD, "chunk_size": 100_000} | how)
        to.start("ros2")
        if parameters:
            attached = read_attachments(SAMPLE)[PARAMETERS_ATTACHMENT]
            to.add_attachment(0, 0, PARAMETERS_ATTACHMENT, "application/yaml", attached)
        channels: dict[tuple[str, int], int] = {}
        for number, one in enumerate(messages):
            key = one.topic, channel(number, len(messages))
            if key not in channels:
                schema = to.register_schema(one.type_name, encoding, text(one) if text else one.text)
                channels[key] = to.register_channel(name(one.topic), "cdr", schema)
            to.add_message(channels[key], one.log_time, data(one) if data else one.data, one.publish_time)
        to.finish()
    return path


PLAIN = {"compression": CompressionType.NONE}
IDL = b"module sensor_msgs {};"
READ_AS_IT_IS = {
    "plain": {},
    "lz4": {"compression": CompressionType.LZ4},
    "no message index": {"index_types": IndexType.ALL ^ IndexType.MESSAGE, "enable_crcs": False},
    "two channels": {"channel": lambda number, count: number * 2 // count},
    "three channels": {"channel": lambda number, count: number * 3 // count},
    "channels in turn": {"channel": lambda number, _: number // 6 % 2},
    "no definitions": {"text": lambda one: b""},
    "one without definition": {"text": lambda one: b"" if one.topic == "/encoder" else one.text},
    "ros2idl": {"encoding": "ros2idl", "text": lambda one: IDL},
    "no slash": {"name": lambda topic: topic[1:]},
}


@pytest.mark.parametrize("kind", READ_AS_IT_IS)
def test_a_bag_of_another_writer_gives_the_same_commands_and_comes_back_whole_or_as_far_as_it_goes(
    sample, tmp_path, kind
):
    bag = written(sample, tmp_path / "b" / "b_0.mcap", **READ_AS_IT_IS[kind]).parent
    found = audit(bag)
    assert (found.commands, found.different, found.unverified) == (CYCLES, 0, 0)
    assert evaluate_bag(bag).received_samples == CYCLES
    result = recover(bag, tmp_path / "new")
    assert result.whole and result.saved.total() == len(sample) and not any((result.lost or {}).values())
    for one in (bag, tmp_path / "new"):
        streams = read_streams(one, LAYOUTS)
        for topic, layout in LAYOUTS.items():
            own = [message for message in sample if message.topic == f"/{topic}"]
            assert streams[topic].log_time.tolist() == [message.log_time for message in own]
            expected = np.array([layout.unpack(message.data)[1] for message in own]).T
            assert np.array(list(streams[topic].columns.values())).tobytes() == expected.tobytes()
    path = next(bag.iterdir())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(UserWarning, match="not finished"):
        there = sum(map(len, read_streams(path, LAYOUTS).values()))
    result = recover(path, tmp_path / "of_half")
    assert result.unfinished and not result.whole and result.saved.total() == there > 500


def test_a_topic_of_two_types_is_named_and_what_is_not_copied_counts_as_lost(tmp_path):
    with (tmp_path / "b.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number, (name, encoding) in enumerate([("a", "cdr"), ("b", "cdr"), ("a", "json")]):
            channel = writer.register_channel("/x", encoding, writer.register_schema(name, "jsonschema", b"{}"))
            for _ in range(number + 1):
                writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    result = recover(tmp_path / "b.mcap", tmp_path / "new")
    assert (result.not_copied, result.saved["/x"], result.lost["/x"], result.whole) == (["/x"], 1, 5, False)
    with pytest.raises(BagError, match="'a' and 'b'"):
        read_messages(tmp_path / "b.mcap", "/x")


@pytest.mark.parametrize(("name", "compress"), [("zstd", zstandard.compress), ("lz4", lz4.frame.compress)])
def test_messages_that_are_compressed_one_by_one_are_named_by_every_verb(sample, tmp_path, name, compress, verb):
    bag = written(sample, tmp_path / "b" / "b_0.mcap", data=lambda one: compress(one.data)).parent
    map_ = ["map", "build", bag, "--sensor", "encoder:position[0]", "-o", tmp_path / "m.csv"]
    for listed in (False, True):
        if listed:
            described(bag, compression_format=name, compression_mode="MESSAGE", relative_file_paths=["b_0.mcap"])
        for words in (["evaluate", bag], ["replay", bag], map_, ["recover", bag, "-o", tmp_path / "new"]):
            found = verb(*words)
            assert found.code != 0 and f"is compressed ({name})" in found.err
        assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("where", ["message", "chunk without checksum"])
def test_a_flipped_bit_that_only_the_checksum_of_the_data_section_covers_is_found(sample, tmp_path, where):
    loose = {"use_chunking": False, "enable_data_crcs": True}
    path = written(sample, tmp_path / "b_0.mcap", **(loose if where == "message" else PLAIN))
    content = bytearray(path.read_bytes())
    if where != "message":
        place = records(content, Opcode.CHUNK)[0]
        content[place + 9 + 24 : place + 9 + 28] = bytes(4)
        end = records(content, Opcode.DATA_END)[-1]
        content[end + 9 : end + 13] = zlib.crc32(content[:end]).to_bytes(4, "little")
    assert path.write_bytes(content) and len(read_streams(path, LAYOUTS)["encoder"]) == CYCLES
    wanted = next(one for one in sample[300:] if one.topic == "/encoder")
    content[content.index(wanted.data) + len(wanted.data) - 30] ^= 1
    path.write_bytes(content)
    for read in (lambda: evaluate_bag(path), lambda: audit(path), lambda: read_field(path, Field("encoder", "x"))):
        with pytest.raises(BagError, match="at byte 0: the checksum of the data section"):
            read()
    result = recover(path, tmp_path / "new")
    ((name, *place, words),) = result.gaps
    assert (name, place) == (path.name, [0, 0]) and "checksum" in words
    assert not result.whole and result.saved.total() == len(sample)


# SQLite


TRACER = "acme_msgs/msg/Tracer"
HEAD = "=" * 80 + "\n"


def custom_messages() -> tuple[str, list[bytes]]:
    """The text of a type that ROS 2 lacks, and three messages of it: point.y is 0.5, 1.5, 2.5."""
    text = STORE.generate_msgdef("geometry_msgs/msg/PointStamped", ros_version=2)[0]
    pack = struct.Struct("<4sII4s4x3d").pack
    return text, [pack(b"\0\1\0\0", 10 + n, 0, b"\1\0\0\0", 0.0, n + 0.5, 0.0) for n in range(3)]


def sqlite_of(path: Path, messages: list[One]) -> Path:
    rows = [(one.topic, one.log_time, one.data) for one in messages]
    return sqlite_bag(path, {one.topic: one.type_name for one in messages}, rows)


def idl_of(name: str, members: str) -> str:
    package, kind = name.split("/msg/")
    return f"{HEAD}IDL: {name}\nmodule {package} {{ module msg {{ struct {kind} {{ {members} }}; }}; }};\n"


IDL_OF_BOTH = idl_of(TRACER, "std_msgs::msg::Header header; geometry_msgs::msg::Point point;")
IDL_OF_BOTH += idl_of("geometry_msgs/msg/Point", "double x; double y; double z;")


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("name", [TRACER, TRACER.replace("/msg", "")])
def test_a_type_of_ones_own_is_read_by_the_definition_in_the_bag(tmp_path, encoding, storage, name):
    text, messages = custom_messages()
    text = text if encoding == "ros2msg" else IDL_OF_BOTH
    if storage == "sqlite3":
        rows = [("/probe", 10 + n, data) for n, data in enumerate(messages)]
        bag = sqlite_bag(tmp_path / "b_0.db3", {"/probe": name}, rows, [(name, encoding, text)])
    else:
        recorded = [One("/probe", name, text.encode(), data, 10, 10) for data in messages]
        bag = written(recorded, tmp_path / "b_0.mcap", encoding=encoding)
    assert read_field(bag, Field("/probe", "point.y")).values.tolist() == [0.5, 1.5, 2.5]


HUMBLE_RANGE = "std_msgs/Header header\nuint8 radiation_type\nfloat32 field_of_view\nfloat32 min_range\n"
HUMBLE_RANGE += "float32 max_range\nfloat32 range\n"
HUMBLE_BYTES = struct.pack("<4sIIIsB2x4f", b"\0\1\0\0", 10, 0, 1, b"", 0, 0, 0, 0, 0.5)


@pytest.mark.parametrize(
    ("type_name", "text", "message"),
    [
        # Humble's has no variance at the end.
        ("sensor_msgs/msg/Range", HUMBLE_RANGE, HUMBLE_BYTES),
        # A header of one's own has no stamp.
        ("acme_msgs/msg/Probe", "uint8 header\nfloat32 range\n", struct.pack("<4sB3xf", b"\0\1\0\0", 1, 0.5)),
    ],
)
def test_the_definition_in_the_bag_counts_and_not_what_its_names_mean_elsewhere(tmp_path, type_name, text, message):
    bag = written([One("/probe", type_name, text.encode(), message, 7, 7)] * 2, tmp_path / "b_0.mcap")
    found = read_field(bag, Field("/probe", "range"))
    assert found.values.tolist() == [0.5] and found.stamped == ("sensor" in type_name)


@pytest.mark.parametrize("text", [b"", b" \n", b"acme_msgs/Other other\n"])
def test_a_type_that_the_bag_does_not_describe_is_named(tmp_path, text):
    _, messages = custom_messages()
    bag = written([One("/probe", TRACER, text, data, 10, 10) for data in messages], tmp_path / "b_0.mcap")
    with pytest.raises(BagError, match=f"'{TRACER}', which the bag does not describe"):
        read_field(bag, Field("/probe", "point.y"))


def test_a_topic_that_an_sqlite_bag_has_twice_is_read_in_the_order_of_time(sample, tmp_path):
    own = [one for one in sample if one.topic == "/encoder"]
    rows = [("/encoder" + "+" * (number % 2), one.log_time, one.data) for number, one in enumerate(own)]
    kind = ENCODER.layout.type_name
    bag = sqlite_bag(tmp_path / "b_0.db3", {"/encoder": kind, "/encoder+": kind}, rows)
    stamps = read_streams(bag, {"encoder": ENCODER.layout})["encoder"].stamp
    assert len(stamps) == CYCLES and (np.diff(stamps) > 0).all()


def test_an_sqlite_bag_of_a_recorder_that_was_killed_in_motion_is_interrupted(whole_run, tmp_path, verb):
    sqlite_of(tmp_path / "b_0.db3", [one for one in whole_run if one.log_time < whole_run[0].log_time + 10**9])
    assert verb("evaluate", tmp_path, "--json").json["verdict"] == "interrupted"
    assert verb("evaluate", described(tmp_path), "--json").json["verdict"] == "in_order"


def test_an_sqlite_bag_without_our_topics_is_refused_with_those_that_it_has_and_so_is_a_damaged_one(sample, tmp_path):
    path = sqlite_of(tmp_path / "b_0.db3", sample[:400])
    with pytest.raises(BagError, match="is stored as sqlite3; this needs MCAP"):
        recover(path, tmp_path / "new")
    with pytest.raises(BagError, match=r"has no messages on nothing; its topics are /command, "):
        read_streams(path, {"nothing": LAYOUTS["encoder"]})
    content = path.read_bytes()
    path.write_bytes(content[:2000] + b"\xff" * 5000 + content[7000:])
    with pytest.raises(BagError, match="is no SQLite bag of rosbag2, or is damaged"):
        read_streams(path, LAYOUTS)


def test_an_sqlite_bag_with_another_number_of_messages_than_it_says_is_refused(sample, tmp_path):
    parts = {"b_0.db3": sample[:1000], "b_1.db3": sample[1000:]}
    names = {"relative_file_paths": [sqlite_of(tmp_path / name, part).name for name, part in parts.items()]}
    assert len(read_streams(described(tmp_path, message_count=len(sample), **names), LAYOUTS)["encoder"]) == CYCLES
    with pytest.raises(BagError, match=f"{len(sample)} messages are there, and metadata.yaml says {len(sample) + 5}"):
        read_streams(described(tmp_path, message_count=len(sample) + 5, **names), LAYOUTS)


# Verbs


def test_the_history_takes_other_names_of_topics(sample, tmp_path, verb):
    bag = written(sample, tmp_path / "b" / "b.mcap", name=lambda topic: f"/machine{topic}s").parent
    remap = [word for topic in LAYOUTS for word in ("--remap", f"{topic}:=/machine/{topic}s")]
    for options, added in (([], 0), (["--again", *remap], 1)):
        assert verb("history", "add", bag, "-o", tmp_path / "store", "--json", *options).json["added"] == added


def test_replay_takes_the_parameters_of_a_bag_that_has_none(sample, tmp_path, verb):
    parameters_file = tmp_path / "parameters.yaml"
    parameters_file.write_bytes(read_attachments(SAMPLE)[PARAMETERS_ATTACHMENT])
    bag = written(sample, tmp_path / "b_0.mcap", parameters=False)
    assert verb("replay", bag).code != 0
    found = verb("replay", bag, "--params-file", parameters_file, "--json")
    assert (found.code, found.json["commands"], found.json["different"]) == (0, CYCLES, 0)
    assert verb("replay", SAMPLE, "--params-file", parameters_file).code != 0


# Sizes that records declare


HUGE = 1 << 60
UNSIZED = zstandard.ZstdCompressor(write_content_size=False)
ZEROS = zstandard.compress(bytes(10_000))
SIZES = {
    "zstd of an impossible size": chunk_of(UNSIZED.compress(b"x"), b"zstd", HUGE),
    "frame of more than its chunk": chunk_of(ZEROS, b"zstd", 3),
    "lz4 of more than its chunk": chunk_of(lz4.frame.compress(bytes(10_000_000)), b"lz4", 3),
    "lz4 of an impossible size": chunk_of(lz4.frame.compress(b"x"), b"lz4", HUGE),
    "unknown compression": chunk_of(b"abc", b"xz", 3),
    "none of an impossible size": chunk_of(b"abc", b"", HUGE),
    "a chunk's data": (Opcode.CHUNK, struct.pack("<QQQIIQ", 0, 1, 3, 0, 0, HUGE) + b"abc"),
    "an attachment's data": (Opcode.ATTACHMENT, struct.pack("<QQIIQ", 0, 0, 0, 0, HUGE) + b"abc"),
    "a metadata's name": (Opcode.METADATA, struct.pack("<I", 0xFFFFFFFF) + b"abc"),
    "a channel's topic": (Opcode.CHANNEL, struct.pack("<HHI", 1, 0, 0xFFFFFFFF) + b"abc"),
    "a schema's text": (Opcode.SCHEMA, struct.pack("<HIII", 1, 0, 0, 0xFFFFFFFF) + b"abc"),
}


@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_a_chunk_without_a_byte_is_passed_over_whatever_its_compression(tmp_path, compression):
    path = tmp_path / "b.mcap"
    path.write_bytes(mcap_of(chunk_of(b"", compression)))
    with pytest.raises(BagError, match="has no messages"):
        read_streams(path, LAYOUTS)


@pytest.mark.parametrize("what", SIZES)
def test_a_declared_size_that_cannot_be_is_a_sentence(tmp_path, what, verb):
    path = tmp_path / "b.mcap"
    path.write_bytes(mcap_of(SIZES[what]))
    assert verb("evaluate", path).code in (1, 2) and verb("recover", path).code == 1
    for read in (lambda: read_streams(path, LAYOUTS), lambda: read_attachments(path), lambda: read_metadata(path)):
        try:
            read()
        except BagError as error:
            assert str(path) in str(error)

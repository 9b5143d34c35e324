"""The small parts of a bag's reading and writing, each by itself: what they let through, refuse and count."""

import json
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml
from places import REPOSITORY
from recording import described, record, sqlite_bag

from straightcomp_ros.bags import BagError, mcap_input
from straightcomp_ros.bags.folder import SqliteInput, found_beside, found_files, opened
from straightcomp_ros.bags.mcap_input import message_places
from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.bags.recorded_nodes import (
    attach_parameters,
    note_changes,
    noted_changes,
    recorded_parameters,
    replayed_map,
)
from straightcomp_ros.bags.topics import Topic, TopicQos, definition, resolved, topics_of_stage
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER, STREAMS

MESSAGE, OTHER = 5, 4


def message(channel, size):
    return record(MESSAGE, struct.pack("<HIQQ", channel, 0, 0, 0) + bytes(size))


def index(channel, *offsets):
    return struct.pack(f"<HI{2 * len(offsets)}Q", channel, 16 * len(offsets), *(v for o in offsets for v in (0, o)))


def found(data, *indexes):
    return {channel: places.tolist() for channel, places in message_places(data, indexes).items()}


@pytest.mark.parametrize("size", [0, 1, 2, 3, 12, 13])
def test_records_of_other_kinds_are_stepped_over_wherever_they_stand(size):
    other, first, second = record(OTHER, bytes(size)), message(1, 0), message(7, 5)
    at = len(other)
    assert found(other + first + other + second + other) == {1: [at], 7: [2 * at + len(first)]}
    assert found(other) == {} and found(b"") == {} and found(first + other) == {1: [0]}
    # An index that leaves nothing out behind records of other kinds is believed, or what it says is found again.
    assert found(other + first + second, index(1, at), index(7, at + len(first))) == {1: [at], 7: [at + len(first)]}


def test_a_record_beyond_its_chunk_or_a_message_without_its_fields_is_damage_and_one_without_content_is_not():
    data = message(1, 10)
    # The last ones are too short for a length, and nothing is read beyond the end.
    for wrong in (data[:-1], data + record(OTHER, bytes(5))[:-1], data + b"\0", data + record(OTHER, b"")[:-1]):
        with pytest.raises(ValueError, match="longer than its place"):
            message_places(wrong, [])
    assert found(record(MESSAGE, bytes(22))) == {0: [0]}
    with pytest.raises(ValueError, match="too short"):
        message_places(record(MESSAGE, bytes(21)), [])


def test_indexes_are_believed_only_where_they_fill_the_chunk(monkeypatch):
    data = b"".join(message(*one) for one in ((1, 10), (2, 0), (1, 30), (2, 7)))
    truth = {1: [0, 72], 2: [41, 133]}
    first, second = index(1, 0, 72), index(2, 41, 133)
    # The order in an index does not matter, and an index may list a channel without messages.
    for indexes in ([first, second], [second, index(1, 72, 0)], [first, second, index(3)]):
        assert {channel: places for channel, places in found(data, *indexes).items() if places} == truth
    halves = [[], [first], [second], [first, index(2, 41)], [first, first], [first[:-3], second], [b""]]
    moved = [[index(1, 0, at), second] for at in (73, 2**63)] + [[index(1, 0, 72, 72), second]]
    for wrong in (*halves, *moved, [index(2, 0, 72), index(1, 41, 133)]):
        assert found(data, *wrong) == truth
    # Where they are, no record is looked at by itself: that would take a hundred times as long.
    monkeypatch.setattr(mcap_input, "walked", None)
    assert found(data, first, second) == found(data, second, first) == truth


def touched(folder: Path, *names: str, listed: Sequence[str] = (), key: str = "relative_file_paths") -> Path:
    """A folder with these files, and a metadata.yaml that lists ``listed``."""
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"x")
    if listed:
        entries = [{"path": name} for name in listed] if key == "files" else list(listed)
        described(folder, **{key: entries})
    return folder


ROLLING = [f"{number}_run_2025_12_17-10_{number:02}_00.mcap" for number in range(12)]


@pytest.mark.parametrize("key", ["relative_file_paths", "files"])
@pytest.mark.parametrize(
    ("there", "listed", "order", "missing"),
    [
        (["run_10.mcap", "run_9.mcap"], [], ["run_9.mcap", "run_10.mcap"], []),
        (["run_0.db3", "run_1.db3", "run_4.db3"], [], ..., ["run_2.db3", "run_3.db3"]),
        (["run_0.db3", "run_2.db3"], [f"run_{n}.db3" for n in range(4)], ..., ["run_1.db3", "run_3.db3"]),
        (["run_1.mcap", "run_2.mcap"], [f"run_{n}.mcap" for n in range(3)], ..., ["run_0.mcap"]),
        (["run_3.mcap", "run_4.mcap"], [], ..., []),  # a bag begins where its first number is
        (["z.mcap", "a.mcap", "m.mcap"], ["z.mcap", "a.mcap", "m.mcap", "a.mcap"], ..., []),
        (ROLLING, [], ..., []),
        (ROLLING, ROLLING, ..., []),
        (["3_run_2025_12_17-10_00_00.mcap", "5_run_2025_12_17-10_00_00.mcap"], [], ..., ["4_run_*.mcap"]),
        (["new_0.mcap", "new_1.mcap"], ["run_0.mcap", "run_1.mcap"], ..., []),  # renamed
        (["new_0.mcap", "new_1.mcap"], ["a.mcap", "b.mcap", "c.mcap"], ..., ["a.mcap", "b.mcap", "c.mcap"]),
        (["run_0.mcap", "run_1.mcap"], ["run_0.mcap.zstd", "run_1.mcap.zstd"], ..., []),  # unpacked
        (["alone.mcap"], ["run_0.mcap"], ..., []),
    ],
)
def test_files_are_in_the_order_of_the_list_or_else_of_their_numbers_and_missing_ones_are_named(
    tmp_path, there, listed, order, missing, key
):
    files, absent = found_files(touched(tmp_path / "bag", *there, listed=listed, key=key))
    assert [file.name for file in files] == (there if order is ... else order) and absent == missing
    assert found_files(files[0]) == ([files[0]], [])


@pytest.mark.parametrize(
    "names",
    [
        ["a_run.mcap", "z_run.mcap"],
        ["a_0.mcap", "a_1.mcap", "z_0.mcap"],
        ["run_0.mcap", "run_0.db3"],
        ["run_0.mcap", "run0.mcap"],
        ["run.mcap", "run_1.mcap"],
        ["run1.mcap", "run2.mcap"],
        ["2024-06-03.mcap", "2024-06-04.mcap"],
        ["0_run_2025_12_17-10_00_00.mcap", "0_run_2025_12_18-10_00_00.mcap"],
    ],
)
def test_several_recordings_in_a_folder_are_refused_by_their_names(tmp_path, names):
    with pytest.raises(BagError) as refused:
        found_files(touched(tmp_path / "bag", *names))
    assert all(name in str(refused.value) for name in names)
    with pytest.warns(UserWarning, match=names[1]):
        files, _ = found_files(touched(tmp_path / "bag", listed=names[:1]))
    assert [file.name for file in files] == names[:1]


def test_beside_the_files_of_a_bag_are_its_own_metadata_and_the_logs_of_sqlite_that_are_there(tmp_path):
    names = ["run_0.db3", "run_1.db3"]
    folder = touched(tmp_path / "bag", *names, "run_1.db3-wal", "other.db3-wal")
    files, log = [folder / name for name in names], folder / "run_1.db3-wal"
    assert found_beside(folder, files) == found_beside(files[1], files[1:]) == [log]
    metadata = described(folder, relative_file_paths=names) / "metadata.yaml"
    assert found_beside(folder, files) == [metadata, log] and found_beside(files[1], files[1:]) == [log]
    described(folder, relative_file_paths=names[:1])
    assert found_beside(files[0], files[:1]) == [metadata]


@pytest.mark.parametrize(("suffix", "advised"), [("mcap", True), ("db3", False)])
def test_what_is_left_of_a_bag_without_one_of_its_files_can_be_recovered_if_it_is_mcap(tmp_path, suffix, advised):
    folder = touched(tmp_path / "bag", f"run_0.{suffix}", listed=[f"run_0.{suffix}", f"run_1.{suffix}"])
    with pytest.raises(BagError, match=rf"lacks run_1\.{suffix}") as refused, opened(folder):
        pass
    assert ("straightcomp recover" in str(refused.value)) is advised


def test_a_link_that_leads_nowhere_is_a_file_of_its_bag(tmp_path):
    folder = touched(tmp_path / "bag", "run_0.mcap")
    (folder / "run_1.mcap").symlink_to("gone")
    assert [file.name for file in found_files(folder)[0]] == ["run_0.mcap", "run_1.mcap"]


@pytest.mark.parametrize("name", ["b_0.mcap.zstd", "b_0.db3.zstd", "b_0.mcap.lz4", "b_1.db3.zst"])
@pytest.mark.parametrize("others", [(), ("b_7.mcap",)])
def test_files_that_are_compressed_as_a_whole_are_named_with_what_unpacks_them(tmp_path, name, others):
    folder = touched(tmp_path / "bag", name, *others)
    for bag in (folder, folder / name):
        with pytest.raises(BagError, match="unlz4" if name.endswith("lz4") else "unzstd"):
            found_files(bag)


def test_parameters_of_ros_itself_are_not_those_of_a_node():
    text = b"/cell/driver:\n  ros__parameters:\n    rate: 2000\n    use_sim_time: true\n    a: {b: 1}\n"
    assert recorded_parameters("bag", {"parameters.yaml": text}) == {"driver": {"rate": 2000, "a.b": 1}}
    assert recorded_parameters("bag", {}) == {}
    for wrong in (b"[1]", b"a: 1", b"a: {b: 1}", b"a: {ros__parameters: 1}", b"["):
        with pytest.raises(BagError, match="record the bag again"):
            recorded_parameters("bag", {"parameters.yaml": wrong})


ONE, TWO, BOTH = {"a": 1}, {"b": 2}, {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("nodes", "encoders", "found"),
    [
        ("/one/driver /two/driver", "/two/encoder", TWO),
        ("/one/driver /two/driver", "/one/encoder /two/encoder", ONE),  # the first of them is asked for
        ("/one/driver /two/driver", "/encoder", None),
        ("/one/driver /two/driver", "", None),
        ("driver /two/driver", "/encoder", ONE),
        ("driver /two/driver", "/one/encoder", ONE),  # that of the logger's own namespace
        ("driver /driver", "", BOTH),
        ("/**/driver driver", "", BOTH),
        ("/**/driver /two/driver", "/two/encoder", BOTH),
    ],
)
def test_the_nodes_of_two_machines_in_a_bag_are_not_taken_for_those_of_one(tmp_path, nodes, encoders, found):
    with BagWriter(tmp_path / "bag") as bag:
        for name in encoders.split():
            bag.add(Topic(name, ENCODER.layout.type_name))
    text = "{}: {{ros__parameters: {{a: 1}}}}\n{}: {{ros__parameters: {{b: 2}}}}\n".format(*nodes.split())
    given = tmp_path / "bag", {"parameters.yaml": text.encode()}, {"encoder": encoders.split()[0]} if encoders else {}
    if found:
        assert recorded_parameters(*given) == {"driver": found}
    else:
        with pytest.raises(BagError, match="'/one/driver' and '/two/driver'"):
            recorded_parameters(*given)


SURVEYS = [str(REPOSITORY / "config" / f"{name}_synthetic.csv") for name in ("survey", "guide")]


FILE = "stage.guide.file"


@pytest.mark.parametrize(
    ("nodes", "survey", "reason"),
    [
        ({"feedforward": {FILE: SURVEYS[1]}}, SURVEYS[1], ""),
        ({"/a/driver": {}, "/a/feedforward": {FILE: SURVEYS[1]}}, SURVEYS[1], ""),
        ({"feedforward": {}}, SURVEYS[0], ""),
        ({"feedforward": {}, "/a/feedforward": {}}, None, "several feedforwards"),
        ({"driver": {FILE: SURVEYS[1]}}, None, "no feedforward"),
        ({}, None, "no feedforward"),
        ({"feedforward": {FILE: "nowhere.csv"}}, None, "the map is not"),
        ({"feedforward": {FILE: SURVEYS[0], "stage.guide.smoothing": -1.0}}, SURVEYS[0], "band is not"),
    ],
)
def test_the_map_of_a_bag_is_that_of_its_feedforward_or_a_reason_why_it_or_its_band_is_not_there(
    tmp_path, nodes, survey, reason
):
    with BagWriter(tmp_path / "bag") as bag:
        found = attach_parameters(bag, nodes)
    attached = read_attachments(tmp_path / "bag")
    assert attached.get("map.csv") == (survey and Path(survey).read_bytes())
    assert reason in found and bool(reason) == bool(found) == ("map_band.csv" not in attached)


def test_a_run_is_computed_again_with_its_own_map_or_with_what_its_feedforward_names(tmp_path):
    given = {"map.csv": b"1,2\n"}, {}
    path = replayed_map("bag", *given, tmp_path)
    assert path.parent == tmp_path and path.read_bytes() == b"1,2\n"
    assert replayed_map("bag", {}, {"feedforward": {}}, tmp_path) is None
    with pytest.raises(BagError, match="neither the run's map nor parameters of its feedforward"):
        replayed_map("bag", {}, {"controller": {}}, tmp_path)


@pytest.mark.parametrize("node", ["controller", "/a/controller"])
def test_what_changes_on_a_node_is_noted_under_its_name_without_the_namespace(tmp_path, node):
    with BagWriter(tmp_path / "bag") as bag:
        note_changes(bag, 5, {node: {"x.y": 1, "z": 1}}, {node: {"x.y": 2, "z": 1}})
    with opened(tmp_path / "bag") as files:
        assert noted_changes(files) == [(5, {"controller.x.y": "2"})]


@pytest.mark.parametrize(("written", "seconds"), [("12", 0.006), ("0.006", 0.006), ("0", 0.0)])
def test_a_time_that_an_early_bag_has_in_samples_is_read_in_seconds(written, seconds):
    text = f"controller: {{ros__parameters: {{stage.rate: 2000, reference_lead: {written}}}}}".encode()
    assert recorded_parameters("bag", {"parameters.yaml": text})["controller"]["reference_lead"] == seconds


def test_a_qos_profile_is_read_as_rosbag2_writes_it_and_in_the_numbers_of_older_bags():
    text = TopicQos("best_effort", "transient_local", "keep_all", 0).as_yaml()
    written = {"history": "keep_all", "depth": 0, "reliability": "best_effort", "durability": "transient_local"}
    assert text.startswith("- history: ") and yaml.safe_load(text)[0].items() > written.items()
    assert TopicQos.from_yaml(text) == TopicQos("best_effort", "transient_local", "keep_all", 0)
    older = "- {history: 2, depth: 7, reliability: 2, durability: 1}"
    assert TopicQos.from_yaml(older) == TopicQos("best_effort", "transient_local", "keep_all", 7)
    assert TopicQos.from_yaml(f"{older}\n- {{depth: 9}}").depth == 7  # of several publishers the first one's
    assert TopicQos.from_yaml("- {history: 99}") == TopicQos.from_yaml("]") == TopicQos.from_yaml("") == TopicQos()
    for wrong in ({"depth": -1}, {"reliability": "sure"}, {"history": ""}):
        with pytest.raises(BagError, match="allowed"):
            TopicQos(**wrong)


def test_a_relative_name_is_found_below_the_root_or_in_the_only_namespace():
    topics = ["/a/x", "/b/x", "/y", "/c/y", "/c/z", "/cz"]
    assert resolved("y", topics, "bag") == "/y" and resolved("z", topics, "bag") == "/c/z"
    assert resolved("/c/y", topics, "bag") == "/c/y" and resolved("/z", topics, "bag") is None
    assert resolved("q", topics, "bag") is None
    # Some writers leave out a name's first slash.
    assert resolved("x", ["x"], "bag") == resolved("/x", ["x"], "bag") == "x"
    with pytest.raises(BagError, match="/a/x and /b/x"):
        resolved("x", topics, "bag")


@pytest.mark.parametrize(
    ("topics", "remap", "found"),
    [
        ("/encoder /command /other", {}, {"encoder": "/encoder", "command": "/command"}),
        # Another stage's streams are not those of this one; without another encoder any namespace is.
        ("/a/encoder /a/command /b/encoder /b/reference", {"encoder": "/a/encoder"}, {"command": "/a/command"}),
        ("/a/encoder /a/command /b/reference", {}, {"command": "/a/command", "reference": "/b/reference"}),
        # A filter's encoder is of no stage in particular.
        ("/filter/encoder /b/encoder /b/command", {"encoder": "/filter/encoder"}, {"command": "/b/command"}),
        ("/a/encoder /a/command", {"command": "/b/command"}, {}),
        ("/a/command", {}, {"command": "/a/command"}),
    ],
)
def test_streams_are_looked_for_where_the_stage_of_the_encoder_is(topics, remap, found):
    names = topics.split()
    encoder = {"encoder": next(one for one in names if one.endswith("encoder"))} if "encoder" in topics else {}
    wanted = ["encoder", "command", "reference"]
    assert topics_of_stage(wanted, names, "bag", remap or None) == encoder | remap | found


@pytest.mark.parametrize("bad", [(1, None), (1, "text"), (None, b"x"), (-1, b"x"), ("later", b"x")])
def test_sqlite_messages_come_as_they_were_recorded_and_one_without_data_or_time_is_damage(tmp_path, bad):
    # By the order of recording: the recorder's clock may have been set back.
    rows = [("one", 5, b"five"), ("two", *bad), ("one", 0, b"")]
    file = SqliteInput(sqlite_bag(tmp_path / "bag.db3", {"one": "", "two": ""}, rows))
    ((data, places),) = file.blocks(["one"])
    assert places["one"].tolist() == [0, 35] and data[31:35] == b"five" and len(data) == 35 + 31
    with pytest.raises(BagError, match="no data, or no time"):
        list(file.blocks(["two"]))
    assert list(file.blocks(["three"])) == []


@pytest.mark.parametrize("value", [None, 5, b"\xff"])
@pytest.mark.parametrize("column", ["name", "type", "serialization_format"])
def test_an_sqlite_topic_without_a_name_type_or_encoding_is_damage(tmp_path, column, value):
    path = sqlite_bag(tmp_path / "bag.db3", {"one": "kind"}, [])
    with sqlite3.connect(path) as connection:
        connection.execute(f"UPDATE topics SET {column} = ?", (value,))
    connection.close()
    with pytest.raises(BagError, match="no name, type or encoding"):
        _ = SqliteInput(path).topics


@pytest.mark.parametrize(("text", "known"), [("int8 x", True), (b"int8 x", True), (5, False), (None, False)])
def test_an_sqlite_definition_that_is_no_text_is_none(tmp_path, text, known):
    path = sqlite_bag(tmp_path / "bag.db3", {"one": "kind"}, [], [("kind", "ros2msg", text)])
    assert [bool(topic.described) for topic in SqliteInput(path).topics.values()] == [known]


@pytest.mark.parametrize("left", [True, False])
def test_an_sqlite_file_that_was_written_with_a_log_is_read_whole_and_without_a_file_beside_it(tmp_path, left):
    source, path = tmp_path / "source.db3", tmp_path / "bag" / "bag.db3"
    path.parent.mkdir()
    writer = sqlite3.connect(source)
    writer.execute("PRAGMA journal_mode=WAL")
    writer.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)")
    writer.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    writer.execute("INSERT INTO topics VALUES (1, 'one', '', '')")
    writer.commit()
    if left:  # as a recorder that was killed leaves it
        path.with_name("bag.db3-wal").write_bytes(source.with_name("source.db3-wal").read_bytes())
    else:
        writer.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    path.write_bytes(source.read_bytes())
    writer.close()
    assert [topic.name for topic in SqliteInput(path).topics.values()] == ["one"]
    assert left or list(path.parent.iterdir()) == [path]


TYPES = sorted({stream.layout.type_name for stream in STREAMS} | {"diagnostic_msgs/msg/DiagnosticArray"})


@pytest.mark.parametrize("type_name", TYPES)
def test_the_type_hash_is_the_one_that_ros_computes(type_name):
    package, _, name = type_name.split("/")
    module = pytest.importorskip(package, reason="the message packages of ROS 2 are not installed")
    installed = Path(module.__file__).parents
    found = [path for folder in list(installed)[:5] for path in folder.glob(f"share/{package}/msg/{name}.json")]
    if not found:
        pytest.skip("the installed message package has no type descriptions")
    hashes = {entry["type_name"]: entry["hash_string"] for entry in json.loads(found[0].read_text())["type_hashes"]}
    assert definition(type_name).type_hash == hashes[type_name]


def test_an_unknown_type_is_refused_by_name():
    with pytest.raises(BagError, match=r"'sensor_msgs/JointState' is unknown: allowed .*sensor_msgs/msg/JointState"):
        definition("sensor_msgs/JointState")

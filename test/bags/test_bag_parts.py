"""The small parts of a bag's reading and writing, each by itself: what they let through, refuse and count."""

import json
import shutil
import sqlite3
import struct
import types
from collections.abc import Sequence
from pathlib import Path

import pytest

from straightcomp_ros.bags import BagError, recorder
from straightcomp_ros.bags.folder import SqliteInput, bag_files, found_files, split_number
from straightcomp_ros.bags.mcap_input import frames, message_places
from straightcomp_ros.bags.recorded_nodes import recorded_parameters, unpacked_map
from straightcomp_ros.bags.recorder import BREAK, DiskGuard, Intake, Losses
from straightcomp_ros.bags.topics import TopicQos, chosen_topics, resolved
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.parameter_sets import ControllerNodeParameters

MESSAGE, OTHER = 5, 4


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


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


def test_a_record_that_ends_beyond_its_chunk_is_damage():
    data = message(1, 10)
    # The last ones are too short for a length, and nothing is read beyond the end.
    for wrong in (data[:-1], data + record(OTHER, bytes(5))[:-1], data + b"\0", data + record(OTHER, b"")[:-1]):
        with pytest.raises(ValueError, match="longer than its place"):
            message_places(wrong, [])


def test_a_message_without_its_fields_is_too_short_and_one_without_content_is_not():
    assert found(record(MESSAGE, bytes(22))) == {0: [0]}
    with pytest.raises(ValueError, match="too short"):
        message_places(record(MESSAGE, bytes(21)), [])


def test_indexes_are_believed_only_where_they_fill_the_chunk():
    first, second = message(1, 10), message(2, 0)
    data, at = first + second, len(message(1, 10))
    truth = {1: [0], 2: [at]}
    for indexes in ([index(2, at), index(1, 0)], [index(1, 0)], [index(2, at)], [index(1, at), index(2, 0)]):
        assert found(data, *indexes) == truth
    # The order in an index does not matter.
    assert found(first + first, index(1, len(first), 0)) == {1: [0, len(first)]}
    # An index may list a channel without messages.
    assert {k: v for k, v in found(data, index(1, 0), index(2, at), index(3)).items() if v} == truth


def test_records_in_a_summary_are_given_by_kind_and_a_cut_is_told():
    data = record(1, b"a") + record(2, b"") + record(1, b"bc")
    assert list(frames(data, (1,))) == [(1, b"a"), (1, b"bc")]
    assert list(frames(data, (2,))) == [(2, b"")]
    for cut in (1, 3, len(record(1, b"bc")) - 1):
        with pytest.raises(ValueError):
            list(frames(data[:-cut], ()))


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
    losses.add("/a", [*packed(102, 101), b"short", bytes(11), *packed(103)])
    assert losses.by_topic() == {"/a": 3}
    losses.add("/b", [])
    losses.add("/c", packed(1))
    assert losses.by_topic() == {"/a": 3, "/c": 0}
    # Seconds count as well as nanoseconds.
    losses.add("/d", packed(0, 1000, 3000))
    assert losses.by_topic()["/d"] == 1


def test_a_snapshot_takes_the_newest_where_the_queue_has_room_for_some():
    intake = Intake(limit=5, snapshot_s=1.0)
    for number in range(8):
        intake.add("/a", bytes([number]), number, 0)
    assert intake.snapshot() == 5
    assert [data for _, data, *_ in intake.queue] == [b"", *(bytes([number]) for number in range(3, 8))]
    assert (intake.received, intake.dropped) == (8, 3)
    intake.add("/a", b"x", 9, 0)
    intake.add("/a", b"y", 9, 0)
    # The queue is full: all is dropped, and counted.
    assert intake.snapshot() == 0 and intake.dropped == 5


def test_each_pause_makes_one_break():
    intake = Intake(limit=10)
    assert intake.paused is False
    for value in (True, True, False, False, True):
        intake.paused = value
    assert list(intake.queue) == [BREAK, BREAK] and intake.paused is True


def test_the_free_space_is_looked_at_twice_a_second(monkeypatch, tmp_path):
    clock, looks = [100.0], []
    usage = types.SimpleNamespace(free=300)
    monkeypatch.setattr(recorder, "time", types.SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: looks.append(path) or usage)
    guard = DiskGuard(tmp_path, 300)
    for _ in range(100):
        guard.check()
        clock[0] += 0.01
    assert looks == [tmp_path] * 2
    usage.free = 200
    clock[0] += 0.5
    with pytest.raises(BagError, match="200 bytes are free on its disk; allowed: >= 300"):
        guard.check()


def touched(folder: Path, *names: str, listed: Sequence[str] = (), key: str = "relative_file_paths") -> Path:
    """A folder with these files, and a metadata.yaml that lists ``listed``."""
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"x")
    if listed:
        entries = [{"path": name} for name in listed] if key == "files" else list(listed)
        (folder / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": {key: entries}}))
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
        (["z.mcap", "a.mcap", "m.mcap"], ["z.mcap", "a.mcap", "m.mcap"], ..., []),
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


def test_split_number_gives_recording_and_number():
    assert split_number(Path("a_b_12.mcap")) == ("a_b", 12, "a_b_12.mcap")
    assert split_number(Path("a.mcap")) == ("a", -1, "a.mcap")
    assert split_number(Path(ROLLING[11])) == ("run", 11, ROLLING[11])
    assert split_number(Path("rosbag2_2025_12_17-10_00_00_3.db3"))[:2] == ("rosbag2_2025_12_17-10_00_00", 3)


@pytest.mark.parametrize("name", ["b_0.mcap.zstd", "b_0.db3.zstd", "b_0.mcap.lz4", "b_1.db3.zst"])
@pytest.mark.parametrize("others", [(), ("b_7.mcap",)])
def test_files_that_are_compressed_as_a_whole_are_named_with_what_unpacks_them(tmp_path, name, others):
    folder = touched(tmp_path / "bag", name, *others)
    for bag in (folder, folder / name):
        with pytest.raises(BagError, match="unlz4" if name.endswith("lz4") else "unzstd"):
            found_files(bag)


def test_an_empty_last_file_of_several_is_no_part_of_the_bag(tmp_path):
    for name, content in (("run_0.mcap", b"x"), ("run_1.mcap", b""), ("run_2.mcap", b"")):
        (tmp_path / name).write_bytes(content)
    assert [file.name for file in bag_files(tmp_path)] == ["run_0.mcap", "run_1.mcap"]
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "run_0.mcap").write_bytes(b"")
    assert [file.name for file in bag_files(alone)] == ["run_0.mcap"]


def test_a_bag_from_before_the_groups_of_laws_had_their_names_is_read_by_the_names_of_today():
    names = {
        "control.law": "control.law",
        "control.velocity_bandwidth": "control.smc.velocity_bandwidth",
        "control.smc_feedforward": "control.smc.feedforward",
        "control.design.rho": "control.smc.rho",
        "control.observer.amplifier_bandwidth": "stage.drive.bandwidth",
        "control.observer.delay": "control.smc_observer.delay",
    }
    lines = "".join(f"    {name}: {number}\n" for number, name in enumerate(names))
    text = f"/controller:\n  ros__parameters:\n{lines}".encode()
    found = recorded_parameters("bag", {"parameters.yaml": text})["controller"]
    assert found == {name: number for number, name in enumerate(names.values())}
    known = {declaration.name for declaration in declarations(ControllerNodeParameters)}
    assert set(found) <= known


def test_the_attached_map_is_unpacked_where_there_is_one(tmp_path):
    assert unpacked_map({}, tmp_path) is None and not list(tmp_path.iterdir())
    file = unpacked_map({"map.csv": b"x_mm", "parameters.yaml": b""}, tmp_path)
    assert list(tmp_path.iterdir()) == [file] and file.read_bytes() == b"x_mm"


def test_parameters_of_ros_itself_are_not_those_of_a_node():
    text = b"/cell/driver:\n  ros__parameters:\n    rate: 2000\n    use_sim_time: true\n    a: {b: 1}\n"
    assert recorded_parameters("bag", {"parameters.yaml": text}) == {"driver": {"rate": 2000, "a.b": 1}}
    assert recorded_parameters("bag", {}) == {}
    for wrong in (b"[1]", b"a: 1", b"a: {b: 1}", b"a: {ros__parameters: 1}", b"["):
        with pytest.raises(BagError, match="record the bag again"):
            recorded_parameters("bag", {"parameters.yaml": wrong})


def test_a_qos_profile_reads_as_rosbag2_writes_it():
    text = TopicQos("best_effort", "transient_local", "keep_all", 0).as_yaml()
    assert text.startswith(
        "- history: keep_all\n  depth: 0\n  reliability: best_effort\n  durability: transient_local\n"
    )
    assert text.endswith("avoid_ros_namespace_conventions: false")
    assert TopicQos.from_yaml(text) == TopicQos("best_effort", "transient_local", "keep_all", 0)
    for wrong in ({"depth": -1}, {"reliability": "sure"}, {"history": ""}):
        with pytest.raises(BagError, match="allowed"):
            TopicQos(**wrong)


def test_a_relative_name_is_found_below_the_root_or_in_the_only_namespace():
    topics = ["/a/x", "/b/x", "/y", "/c/y", "/c/z", "/cz"]
    assert resolved("y", topics, "bag") == "/y" and resolved("z", topics, "bag") == "/c/z"
    assert resolved("/c/y", topics, "bag") == "/c/y" and resolved("/z", topics, "bag") is None
    assert resolved("q", topics, "bag") is None
    with pytest.raises(BagError, match="/a/x and /b/x"):
        resolved("x", topics, "bag")
    assert chosen_topics(["y", "q"], topics, "bag", {}) == {"/y": "y"}
    assert chosen_topics(["y", "x"], topics, "bag", {"x": "/b/x"}) == {"/y": "y", "/b/x": "x"}
    with pytest.raises(BagError, match="has no topic 'w' for 'q'"):
        chosen_topics(["q"], topics, "bag", {"q": "w"})


@pytest.mark.parametrize("bad", [(1, None), (1, "text"), (None, b"x"), (-1, b"x"), ("later", b"x")])
def test_an_sqlite_message_without_data_or_time_is_damage(tmp_path, bad):
    path = tmp_path / "bag.db3"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        connection.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)")
        connection.execute("INSERT INTO topics VALUES (1, 'one', '', ''), (2, 'two', '', '')")
        connection.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 0, ?)", (b"zero",))
        connection.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (2, ?, ?)", bad)
        connection.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 5, ?)", (b"",))
    connection.close()
    file = SqliteInput(path)
    ((data, places),) = file.blocks(["one"])
    assert places["one"].tolist() == [0, 35] and data[31:35] == b"zero" and len(data) == 35 + 31
    with pytest.raises(BagError, match="no data, or no time"):
        list(file.blocks(["two"]))
    assert list(file.blocks(["three"])) == []


def test_the_folders_above_a_new_bag_are_made(tmp_path):
    with BagWriter(tmp_path / "year" / "day" / "run") as bag:
        bag.add_topic("/encoder", ENCODER.layout.type_name)
    assert bag_files(tmp_path / "year" / "day" / "run")

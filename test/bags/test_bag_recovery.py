"""A recovered bag holds what was sound in the original, to the byte, and nothing else."""

import os
import resource
import shutil
import time
from functools import cache, partial
from pathlib import Path

import pytest
from bag_of_rows import Message, bag_of, messages_of
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer
from places import SMC
from recording import MAGIC, START_NS, add_streams, described, mcap_of, recorded, records
from rosbags.rosbag2 import Reader
from tiers import nightly

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_metadata
from straightcomp_ros.bags.recovery import RECOVERY_METADATA, recover
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.cli import Terminated
from straightcomp_ros.contract import ENCODER


def contents(bag: Path) -> list[tuple[str, int, bytes]]:
    """All messages of a finished bag, as rosbags reads them."""
    return sorted((topic, time_ns, data) for topic, _, data, time_ns, _ in messages_of(bag))


def written(bag) -> list[tuple[str, int, bytes]]:
    return sorted((message.topic, message.log_time, message.data) for message in bag.messages)


def attached(folder):
    """The attachments of a bag of one file, with the times at which they were made."""
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as file:
        yield from make_reader(file).iter_attachments()


def test_an_attachment_without_a_time_of_creation_is_as_old_as_its_record(tmp_path):
    with (tmp_path / "one.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.add_attachment(0, START_NS, "notes.txt", "text/plain", b"")
        writer.finish()
    recover(tmp_path / "one.mcap", tmp_path / "new")
    assert [(one.create_time, one.log_time) for one in attached(tmp_path / "new")] == [(START_NS, START_NS)]


def test_a_sound_bag_comes_back_whole_with_attachments_and_metadata_and_is_not_changed(tmp_path):
    bag = recorded(tmp_path / "run")
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in bag.directory.iterdir()}
    result = recover(bag.directory, tmp_path / "new")
    with pytest.raises(BagError, match="not empty"):
        recover(bag.directory, bag.directory)
    assert before == {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in bag.directory.iterdir()}
    assert result.whole and sum(result.lost.values()) == 0
    assert contents(tmp_path / "new") == written(bag)
    assert list(attached(tmp_path / "new")) == list(attached(bag.directory)) != []
    found = read_metadata(tmp_path / "new")
    assert found["survey"] == {"guide": "synthetic", "points": "177"}
    assert found[RECOVERY_METADATA]["lost_messages"] == "0"
    with Reader(bag.directory) as old, Reader(tmp_path / "new") as new:
        for before, after in zip(old.connections, new.connections, strict=True):
            assert (before.topic, before.msgtype, before.digest) == (after.topic, after.msgtype, after.digest)
            assert before.ext.offered_qos_profiles == after.ext.offered_qos_profiles


def test_a_damaged_chunk_costs_its_own_messages_only_and_they_are_counted(tmp_path):
    bag = recorded(tmp_path / "run", 60, chunk_size=6000)
    content = bytearray(bag.file.read_bytes())
    offsets = records(content, Opcode.CHUNK)
    # Data of the first chunk, and the length of the fourth: behind that nothing is where it is expected.
    content[offsets[0] + 200] ^= 0xFF
    content[offsets[3] + 2] ^= 0xFF
    bag.file.write_bytes(content)
    result = recover(bag.file, tmp_path / "new")
    saved = contents(tmp_path / "new")
    assert set(saved) < set(written(bag))
    assert sum(result.lost.values()) == len(bag.messages) - len(saved)
    assert len(result.gaps) == 2
    assert 0 < len(bag.messages) - len(saved) < 2.2 * len(bag.messages) / len(offsets)


def test_a_topic_whose_messages_are_all_lost_is_still_announced(tmp_path):
    one = ENCODER.layout.type_name, ENCODER.layout.pack(0, 0.0, 0.0, 0.0, 0.0), 0, 0
    bag_of(tmp_path / "bag", ((topic, *one) for topic in ("/once", "/often", "/often")), chunk_size=1)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    content = bytearray(file.read_bytes())
    content[records(content, Opcode.CHUNK)[0] + 60] ^= 0xFF
    file.write_bytes(content)
    result = recover(file, tmp_path / "new")
    assert result.lost["/once"] == 1 and not result.lost["/often"]
    with Reader(tmp_path / "new") as reader:
        assert {name: topic.msgcount for name, topic in reader.topics.items()} == {"/once": 0, "/often": 2}


sound_messages = cache(partial(messages_of, SMC))


def split_run(folder: Path, parts: int, found: list[Message]) -> list[Path]:
    """These messages in order in several files."""
    folder.mkdir()
    size, files = -(-len(found) // parts), [folder / f"run_{number}.mcap" for number in range(parts)]
    for number, file in enumerate(files):
        (part,) = bag_of(folder.with_name(f"part_{number}"), found[number * size : (number + 1) * size]).glob("*.mcap")
        part.rename(file)
    return files


@pytest.mark.parametrize(
    ("lost", "content"),
    [(0, b""), (3, b""), (1, b"no magic"), (0, None), (3, None), *nightly([(1, None), (1, "gone")])],
)
def test_a_file_that_cannot_be_read_costs_its_own_messages_and_the_copy_is_no_whole_run(tmp_path, lost, content, verb):
    files = split_run(tmp_path / "run", 4, sound_messages())
    described(tmp_path / "run", relative_file_paths=[file.name for file in files])
    if isinstance(content, bytes):
        files[lost].write_bytes(content)
    else:
        files[lost].unlink()
        if content:
            files[lost].symlink_to(content)
    result = recover(tmp_path / "run", tmp_path / "new")
    assert (result.lost, result.lost_files, result.whole) == (None, [files[lost].name], False)
    assert (content is None) == ((files[lost].name, 0, 0, "the file is missing") in result.gaps)
    assert result.saved.total() >= 0.7 * len(contents(SMC))
    assert verb("evaluate", tmp_path / "new", "--json").json["verdict"] == "interrupted"


def test_a_copy_without_a_file_that_metadata_yaml_does_not_list_is_not_all_of_the_folder(tmp_path):
    files = split_run(tmp_path / "run", 2, sound_messages()[:600])
    described(tmp_path / "run", relative_file_paths=[files[0].name])
    result = recover(tmp_path / "run", tmp_path / "new")
    assert not result.whole and f"does not list {files[1].name}" in result.gaps[0][3]


def test_a_bag_may_have_more_files_than_a_process_may_open(tmp_path):
    found = sound_messages()[:600]
    split_run(tmp_path / "run", 60, found)
    limits, opened = resource.getrlimit(resource.RLIMIT_NOFILE), len(os.listdir("/proc/self/fd"))
    resource.setrlimit(resource.RLIMIT_NOFILE, (opened + 20, limits[1]))
    try:
        result = recover(tmp_path / "run", tmp_path / "new")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert result.lost_files == [] and contents(tmp_path / "new") == sorted(
        (topic, time_ns, data) for topic, _, data, time_ns, _ in found
    )


@pytest.mark.parametrize("stop", [KeyboardInterrupt, Terminated, OSError, ZeroDivisionError])
@pytest.mark.parametrize("there", [[], ["new"], ["of_the_user", "new"]])
def test_whatever_ends_the_copying_leaves_no_half_copy_and_the_original(tmp_path, stop, there):
    """The folder that is named may be there already, or be a link to one."""
    for number, name in enumerate(there):
        (tmp_path / name).symlink_to(there[0]) if number else (tmp_path / name).mkdir()
    bag, before = recorded(tmp_path / "run"), {path.name for path in tmp_path.iterdir()}

    def edit(name, data):
        raise stop

    with pytest.raises(stop):
        recover(bag.directory, tmp_path / "new", edit=edit)
    assert {path.name for path in tmp_path.iterdir()} == before and bag.file.exists()
    assert not there or not any((tmp_path / "new").iterdir())


def test_a_folder_that_cannot_be_is_refused_as_a_bag_that_cannot_be_made(tmp_path):
    with pytest.raises(BagError, match="cannot be made: File name too long"):
        recover(recorded(tmp_path / "run").directory, tmp_path / ("x" * 300))
    with pytest.raises(BagError, match="cannot be made: File name too long"):
        SimulatedRun(tmp_path / ("x" * 300), {}, 1.0)


def test_an_open_chunk_is_written_when_it_is_old_enough(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        add_streams(bag)
        sizes = []
        for age in (0.0, 3600.0, 0.005):
            bag.flush_older(age)
            sizes.append(bag.path.stat().st_size)
            bag.write("/encoder", ENCODER.layout.pack(5, 1, 2, 3, 4), START_NS, 5)
            time.sleep(0.01)
    assert sizes[0] == sizes[1] < sizes[2]


def test_a_bag_whose_name_is_no_utf8_is_recovered_and_packed(tmp_path, verb):
    shutil.copytree(SMC, bag := tmp_path / os.fsdecode(b"b\xfc"))
    assert verb("recover", bag, "-o", tmp_path / "new").code == 0 and contents(tmp_path / "new") == contents(SMC)
    assert verb("incident", bag, "--last", "0.3", "-o", tmp_path / "i.zip").code == 0
    assert verb("incident", "open", tmp_path / "i.zip", "--json").json["as_packed"]["bag"] == bag.name


def test_the_command_prints_what_was_saved_and_lost(tmp_path, verb):
    bag = recorded(tmp_path / "run")
    figures = verb("recover", bag.directory, "--json").json
    assert figures["saved_messages"] == len(bag.messages) and figures["lost_messages"] == 0
    assert figures["output"] == str(bag.directory.with_name("run_recovered"))
    found = verb("recover", bag.directory)
    assert found.code == 1 and figures["output"] in found.err and "-o" in found.err


@pytest.mark.parametrize(("content", "code"), [(b"SQLite format 3\0", 2), (MAGIC, 1), (mcap_of(), 1)])
def test_what_holds_nothing_to_save_fails_with_the_reason(tmp_path, content, code, verb):
    (tmp_path / "run.mcap").write_bytes(content)
    found = verb("recover", tmp_path / "run.mcap", "-o", tmp_path / "new")
    assert found.code == code and ("is not an MCAP file" if code == 2 else "no message could be") in found.err
    assert "nothing was wrong" not in found.err

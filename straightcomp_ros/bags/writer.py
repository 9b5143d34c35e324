"""Writes a bag: a folder with MCAP files and metadata.yaml, as `ros2 bag`, Foxglove and PlotJuggler open it.

:mod:`straightcomp_ros.bags.mcap_output` says why the files are not written by mcap's own ``Writer``.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from straightcomp_ros.bags import BagError, NoBag
from straightcomp_ros.bags.information import ROOT_KEY, BagFile, as_yaml, bag_information
from straightcomp_ros.bags.mcap_output import McapOutput
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.parameters.output_files import sync_names, utf8, write_whole

Message = tuple[str, bytes, int, int]
"""Topic, serialised message, time of reception and of its source in ns since the epoch."""
CHUNK_SIZE = 512 * 1024
"""Bytes of messages in a chunk: about a fifth of a second of all streams at 2 kHz."""
FLUSH_AGE = 0.15
"""Age in s at which a recording writes its open chunk, full or not. With the delays of fetching and writing on a busy
machine, a SIGKILL takes less than half a second."""


class BagWriter:
    """A new bag. Not for several threads at once.

    As a context manager it finishes the bag whatever ends the block, Ctrl-C too. Without the finish all chunks but the
    open one stay readable after a SIGKILL, and all up to the last :meth:`sync_older` after a power cut.

    Args:
        directory: the bag's folder; made if absent, must be empty.
        compression: ``zstd``, ``lz4`` or ``none``.
        chunk_size: bytes of messages that are compressed and written together.
        max_size: size in bytes from which the bag continues in another file, 0 for no limit. A file is larger by the
            chunk that crossed the limit, and by its index.
        max_duration: time in s from a file's first message after which the bag continues in another, 0 for no limit.

    Attributes:
        path: the file that is being written.
        topics: those that were added, by full name.
        finished_files: what is in each of the bag's files but the open one.

    Raises:
        BagError: the folder holds files or cannot be made; from the methods, that the bag is closed, the topic is
            unknown or the disk refuses.
    """

    def __init__(
        self,
        directory: Path,
        *,
        compression: str = "zstd",
        chunk_size: int = CHUNK_SIZE,
        max_size: int = 0,
        max_duration: float = 0.0,
    ) -> None:
        self.directory = Path(directory)
        self._make_output = partial(McapOutput, compression=compression, chunk_size=chunk_size)
        self._max_size, self._max_duration_ns = max_size, round(max_duration * 1e9)
        self.finished_files: list[BagFile] = []
        self._file_began_ns: int | None = None
        self.topics: dict[str, Topic] = {}
        self._channel_ids: dict[str, int] = {}
        self._custom_data: dict[str, str] = {}
        self._closed, self._synced, self._named = False, 0.0, set[Path]()
        with self._disk(f"bag {directory} cannot be made", NoBag):
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise NoBag(f"bag {directory}: the folder is not empty; name a new one, bags are never overwritten")
            self._open_file()

    def add(self, topic: Topic) -> None:
        """Announce a topic; without messages it is listed with a count of 0.

        A definition of its own is of a type that ROS 2's own packages do not have, or of another bag, whose topic may
        lack the first slash and whose messages may have any encoding.
        """
        if topic.described is None and not topic.name.startswith("/"):
            raise BagError(f"bag {self.directory}: topic '{topic.name}' is not a full name; it starts with '/'")
        if topic.name in self.topics:
            raise BagError(f"bag {self.directory}: topic '{topic.name}' is already in the bag; add it once")
        with self._disk(f"bag {self.path}: topic '{topic.name}' cannot be added"):
            self._add_channel(topic)
        self.topics[topic.name] = topic

    def _add_channel(self, topic: Topic) -> None:
        metadata = {"offered_qos_profiles": topic.qos.as_yaml(), "topic_type_hash": topic.definition.type_hash}
        self._channel_ids[topic.name] = self._output.add_channel(topic, metadata)

    def _open_file(self) -> None:
        path = self.directory / f"{self.directory.absolute().name}_{len(self.finished_files)}.mcap"
        try:
            self._output: McapOutput = self._make_output(path)
        except FileExistsError:
            raise
        except OSError:
            path.unlink(missing_ok=True)  # rosbag2 would refuse a bag with a file that has no header
            raise
        self.path, self._file_began_ns, self._file_finished = path, None, False
        for topic in self.topics.values():
            self._add_channel(topic)

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add a serialised message (CDR) to the open chunk, with the times at which it was received and at which its
        source made it, in ns since the epoch. MCAP has no negative times: a publish time before the epoch is stored as
        0; the message itself is not touched."""
        self._check_open()
        if topic not in self._channel_ids:
            raise BagError(f"bag {self.directory}: topic '{topic}' was not added; known are {', '.join(self.topics)}")
        if log_time_ns < 0:
            raise BagError(f"bag {self.directory}: topic '{topic}': log time is {log_time_ns} ns; allowed is 0 or more")
        try:
            if self._file_finished or self._is_full(log_time_ns):
                self._split()
            if self._file_began_ns is None:
                self._file_began_ns = log_time_ns
            self._output.add_messages([(self._channel_ids[topic], log_time_ns, max(publish_time_ns, 0), data)])
        except OSError as error:
            raise self._refused(error) from error

    def write_all(self, messages: Sequence[Message]) -> None:
        """Add messages in this order, as :meth:`write` adds one: faster when all of them go into the open file. Where
        the clock was set back, they begin another file once all of them are of after that."""
        ids, times = self._channel_ids, [log_time_ns for _, _, log_time_ns, _ in messages]
        began_ns = self._file_began_ns
        if began_ns is not None and times and 0 < self._max_duration_ns <= began_ns - max(times):
            # Else the file would last until that time comes again. Around a step of the clock topics alternate.
            self.split()
        sound = times and min(times) >= 0 and ids.keys() >= {topic for topic, *_ in messages}
        began = self._file_began_ns is not None and not self._file_finished and not self._closed
        if not sound or not began or self._is_full(max(times)):
            for message in messages:
                self.write(*message)
            return
        try:
            self._output.add_messages([(ids[topic], log, max(sent, 0), data) for topic, data, log, sent in messages])
        except OSError as error:
            raise self._refused(error) from error

    def _refused(self, error: OSError) -> BagError:
        return BagError(f"bag {self.path} cannot be written: {error.strerror}; free space on the disk")

    def _is_full(self, log_time_ns: int) -> bool:
        if self._file_began_ns is None:
            return False
        too_large = 0 < self._max_size <= self._output.size
        return too_large or 0 < self._max_duration_ns <= log_time_ns - self._file_began_ns

    def split(self) -> None:
        """Finish the file, and continue in a new one; a file without messages is kept."""
        with self._disk(f"bag {self.path} cannot be finished"):
            if self._file_began_ns is not None:
                self._split()

    def _split(self) -> None:
        if not self._file_finished:
            self._output.flush()
            self._finish_file()
        self._open_file()

    def attach(self, name: str, media_type: str, data: bytes, made_ns: int | None = None) -> None:
        """Store a file in the bag, e.g. the parameters as ``application/yaml``; it was made now, unless it is a copy of
        one of ``made_ns`` since the epoch."""
        with self._disk(f"bag {self.path}: '{name}' cannot be attached"):
            self._output.add_attachment(name, media_type, data, made_ns)

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Store texts by name: as a record of the MCAP file, and as ``name.key`` in the bag's custom data."""
        metadata = {key: utf8(value).decode() for key, value in metadata.items()}  # the name of a file may be no UTF-8
        with self._disk(f"bag {self.path}: metadata '{name}' cannot be written"):
            self._output.add_metadata(name, metadata)
        self._custom_data.update({f"{name}.{key}": value for key, value in metadata.items()})

    def flush_older(self, age: float) -> None:
        """Write the open chunk when its first message is ``age`` seconds old, so that killing this process no longer
        loses it; call it often. Small chunks compress badly."""
        if self._output.chunk_age >= age:
            with self._disk(f"bag {self.path} cannot be written"):
                self._output.flush()

    def sync_older(self, age: float) -> None:
        """Bring what is written to the disk when the last sync began ``age`` seconds ago, never for 0; call it often,
        from a thread that may wait for the disk."""
        if not age or self._file_finished or time.monotonic() - self._synced < age:
            return
        self._synced = time.monotonic()
        with self._disk(f"bag {self.path} cannot be written"):
            self._output.sync()
            if self.path not in self._named:
                # A file without a name is lost, and so is one in a folder without.
                sync_names(self.directory)
                sync_names(self.directory.absolute().parent)
                self._named.add(self.path)

    def close(self) -> None:
        """Finish the bag; a second call does nothing. When the disk is full, the bag is finished without its last chunk
        if possible, and BagError says how many messages are lost."""
        if self._closed:
            return
        lost = 0
        try:
            with self._disk(f"bag {self.path} cannot be finished"):
                if not self._file_finished:
                    try:
                        self._output.flush()
                    except OSError:
                        lost = self._output.discard_open_chunk()
                    self._finish_file()
                self._finish_bag()
        finally:
            self._output.close()
            self._closed = True
        if lost:
            raise BagError(f"bag {self.path}: the disk took no more, the last {lost} messages are lost; free space")

    def _finish_file(self) -> None:
        counts = self._output.message_counts
        by_topic = {name: counts[channel_id] for name, channel_id in self._channel_ids.items()}
        file = BagFile(self.path.name, self._output.time_range, by_topic)
        # rosbag2 looks here when it is given the file alone.
        information = bag_information([file], self.topics.values(), self._custom_data)
        self._output.add_metadata("rosbag2", {"serialized_metadata": as_yaml(information)})
        if not self._output.attachment_count:
            # Every file has a metadata record and an attachment, so that its summary has all the groups that a reader
            # may expect. A file that lost its folder carries its metadata.yaml.
            text = as_yaml({ROOT_KEY: information})
            self._output.add_attachment("metadata.yaml", "application/yaml", text.encode())
        self._output.finish()
        # No call between these two: Python handles an interrupt at calls only.
        self.finished_files += [file]
        self._file_finished = True  # and stays so when the next one cannot be opened
        self._output.close()

    def _finish_bag(self) -> None:
        # A folder with metadata.yaml is a finished bag: all else must be on the disk before.
        for file in self.finished_files:
            with open(self.directory / file.name, "rb") as written:
                os.fsync(written.fileno())
        sync_names(self.directory)
        information = bag_information(self.finished_files, self.topics.values(), self._custom_data)
        write_whole(self.directory / "metadata.yaml", as_yaml({ROOT_KEY: information}))

    def _check_open(self) -> None:
        if self._closed:
            raise BagError(f"bag {self.directory} is closed; write before close()")

    @contextmanager
    def _disk(self, failure: str, kind: type[BagError] = BagError) -> Iterator[None]:
        self._check_open()
        try:
            yield
        except OSError as error:
            raise kind(f"{failure}: {error.strerror}; check path, permissions and free space") from error

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

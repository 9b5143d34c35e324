"""Reads a bag: streams as columns, messages of any type as they are, attachments, metadata."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import BagInput, SqliteInput, compressed_messages, opened, topic_names
from straightcomp_ros.bags.mcap_input import FRAME, HEAD, rows
from straightcomp_ros.bags.topics import Definition, Topic, resolved, topics_of_stage, typestore
from straightcomp_ros.contract import ENCODER, Stream
from straightcomp_ros.messages.cdr import ENCAPSULATION, NANOSECONDS, Layout, LayoutMismatch, read_by_names

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

COMPRESSIONS = {b"\x28\xb5\x2f\xfd": "zstd", b"\x04\x22\x4d\x18": "lz4"}
"""Compressions by the first bytes of what they make; no message in CDR begins so."""


@dataclass
class Messages:
    """Messages of one topic in the order in which they were recorded.

    Attributes:
        topic, type_name, described: name, full type and definition, as in :class:`straightcomp_ros.bags.topics.Topic`.
        log_time, publish_time: when each was received, and made by its source, ns since the epoch.
        data: each as CDR.
    """

    topic: str
    type_name: str = ""
    described: Definition | None = None
    log_time: list[int] = field(default_factory=list)
    publish_time: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)

    def describe(self, path: Path, topic: Topic) -> None:
        """Take type and definition of the first entry in the bag's files that has them."""
        self.type_name = self.type_name or topic.full_type
        if topic.described and topic.described.text and not self.described:
            self.described = topic.described

    def add(self, block: bytes, starts: NDArray[np.int64]) -> None:
        """Take the message records at ``starts`` (n,) in ``block``."""
        heads = rows(block, starts, HEAD)
        self.log_time += heads["log_time"].tolist()
        self.publish_time += heads["publish_time"].tolist()
        ends = starts + FRAME.size + heads["length"].astype(np.int64)
        data = zip((starts + HEAD.itemsize).tolist(), ends.tolist(), strict=True)
        self.data += [block[first:end] for first, end in data]


def read_messages(bag: Path, topic: str) -> Messages:
    """All messages of ``topic``, named as :func:`straightcomp_ros.bags.topics.resolved` takes it.

    Raises BagError when the bag cannot be read, is damaged, lacks the topic, or has no messages on it. Warns
    (UserWarning) when the bag was not finished.
    """
    with opened(bag) as files:
        names = topic_names(files)
        full = resolved(topic, names, str(bag))
        if full is None:
            raise BagError(f"bag {bag}: has no topic '{topic}'; it has {', '.join(sorted(names))}")
        found = messages_on(full, files)
    if not found.data:
        raise BagError(f"bag {bag}: topic '{full}' has no messages; was its publisher running?")
    return found


def messages_on(topic: str, files: Sequence[BagInput]) -> Messages:
    """All messages of the topic with this full name. Raises BagError when the bag is damaged."""
    found = Messages(topic)
    having = [file for file in files if any(one.name == topic for one in file.topics.values())]
    kinds = sorted({one.full_type for file in having for one in file.topics.values() if one.name == topic})
    if len(kinds) > 1:
        words = "' and '".join(kinds)
        raise BagError(f"bag {having[0].path}: topic '{topic}' has messages of types '{words}'; allowed is one type")
    _gather(having, {topic: found})
    return found


def decoded(where: str, data: bytes, type_name: str, types: Typestore | None = None) -> Any:
    """The message in ``data``, decoded by rosbags with these ``types`` or else ROS 2's own. Raises BagError when the
    bytes are no such message; the text begins with ``where``."""
    if compression := COMPRESSIONS.get(data[:4]):
        raise BagError(f"{where}: {compressed_messages(compression)}")
    try:
        return (types or typestore()).deserialize_cdr(data, type_name)
    except Exception as error:  # The decoder raises errors of many kinds on malformed bytes.
        raise BagError(f"{where} does not decode ({error}); allowed is a {type_name}") from error


@dataclass(frozen=True)
class StreamColumns:
    """Messages of one topic, in the order in which they were recorded.

    Attributes:
        log_time, stamp: (n,) int64, when each was received, and the stamp of its header, ns since the epoch.
        columns: (n,) float64 for each column of the layout, in the units of the stream.
    """

    log_time: NDArray[np.int64]
    stamp: NDArray[np.int64]
    columns: dict[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.stamp)

    def by_stamp(self) -> StreamColumns:
        """In the order of the stamps, the first message of each: lockstep repeats a sample that got no answer."""
        _, rows = np.unique(self.stamp, return_index=True)
        return self.taken(rows)

    def taken(self, rows: NDArray[np.intp]) -> StreamColumns:
        """The messages at these places, in this order."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return StreamColumns(self.log_time[rows], self.stamp[rows], columns)


class StreamDecoder:
    """Gathers the messages of one topic, which should have ``layout``; ``topic`` names it, and the bag, in errors."""

    def __init__(self, topic: str, layout: Layout) -> None:
        self._topic, self._layout, self._dtype = topic, layout, layout.dtype
        self._template = np.frombuffer(layout.pack(0, *(0.0 for _ in layout.columns)), np.uint8)
        self._batches: list[tuple[NDArray[Any], ...]] = []

    def describe(self, path: Path, topic: Topic) -> None:
        """Raise BagError when the topic in the file ``path`` has messages of another type."""
        allowed = self._layout.type_name
        if topic.full_type != allowed or topic.encoding != "cdr":
            raise BagError(
                f"bag {path}: topic '{topic.name}' has messages of type '{topic.type_name}' in encoding "
                f"'{topic.encoding}'; allowed is {allowed} in encoding 'cdr'"
            )

    def add(self, data: bytes, places: NDArray[np.int64]) -> None:
        """Decode the message records at ``places`` in ``data``. Raises BagError when a message is neither of the layout
        nor decodes to its joints and arrays."""
        heads, starts = rows(data, places, HEAD), places + HEAD.itemsize
        ends = places + FRAME.size + heads["length"].astype(np.int64)
        long = ends - starts >= self._layout.size
        messages = rows(data, starts[long], self._dtype)
        if not long.all():
            of_layout, messages = messages, np.zeros(len(places), self._dtype)
            messages[long] = of_layout
        others = ~self._same_constants(messages) | (messages["nanosec"] >= NANOSECONDS)
        for odd in np.flatnonzero(others).tolist():
            stamp, numbers = self._by_names(data[starts[odd] : ends[odd]], odd)
            messages[odd] = np.frombuffer(self._layout.pack(stamp, *numbers), self._dtype)[0]
        stamp = messages["sec"].astype(np.int64) * NANOSECONDS + messages["nanosec"]
        numbers = (messages[name].copy() for name in self._layout.columns)
        self._batches.append((heads["log_time"].astype(np.int64), stamp, *numbers))

    def finished(self) -> StreamColumns | None:
        """All messages so far; None when there was none."""
        if not self._batches:
            return None
        log_time, stamp, *numbers = map(np.concatenate, zip(*self._batches, strict=True))
        return StreamColumns(log_time, stamp, dict(zip(self._layout.columns, numbers, strict=True)))

    def _same_constants(self, messages: NDArray[np.void]) -> NDArray[np.bool_]:
        content = messages.view(np.uint8).reshape(len(messages), self._layout.size)
        mask = meaningful(self._layout)
        return np.asarray((content[:, mask] == self._template[mask]).all(axis=1), np.bool_)

    def _by_names(self, message: bytes, place: int) -> tuple[int, list[float]]:
        number, type_name = sum(len(stamp) for _, stamp, *_ in self._batches) + place, self._layout.type_name
        where = f"{self._topic}: message {number}"
        try:
            return read_by_names(self._layout, decoded(where, message, type_name))
        except LayoutMismatch as error:
            allowed = f"allowed is a {type_name} with {', '.join(self._layout.columns)}"
            raise BagError(f"{where} lacks {error}; {allowed}") from error


@cache
def meaningful(layout: Layout) -> NDArray[np.bool_]:
    """For each byte of a message, True where it is constant and no gap of CDR's alignment: in the encapsulation, and in
    the runs of constants between stamp and numbers."""
    mask, place = np.ones(layout.size, np.bool_), len(ENCAPSULATION) + 8
    mask[len(ENCAPSULATION) : place] = False
    for constant, run in zip(layout.constants, layout.runs, strict=True):
        numbers = place + len(constant)
        place = numbers + 8 * run
        mask[numbers:place] = False
    mask[len(ENCAPSULATION) + np.array(layout.gaps, np.intp)] = False
    return mask


def read_streams(
    bag: Path,
    layouts: Mapping[str, Layout],
    remap: Mapping[str, str] | None = None,
) -> dict[str, StreamColumns]:
    """Read streams as columns, fast where the messages have the layout, otherwise by the names in them.

    Args:
        bag: rosbag2 folder, or one MCAP file.
        layouts: by topic, relative (``encoder``: ``/encoder``, or else the only ``/…/encoder``) or full.
        remap: for topics of ``layouts`` that are named otherwise in the bag, their names there.

    Returns:
        By the same topic names; a topic that the bag lacks, or that has no messages, is left out.

    Raises:
        BagError: the bag is absent, empty, damaged, without any message, or its messages are of another kind; a
            relative name fits several topics, or ``remap`` names a topic that the bag lacks.

    Warns:
        UserWarning: the bag was not finished; what is whole is read.
    """
    with opened(bag) as files:
        return streams_of(bag, files, layouts, remap)


def streams_of(
    bag: Path,
    files: Sequence[BagInput],
    layouts: Mapping[str, Layout],
    remap: Mapping[str, str] | None,
    whole: Sequence[Messages] = (),
) -> dict[str, StreamColumns]:
    """As :func:`read_streams`, from the open files of a bag; each of ``whole`` gets the messages of its topic as they
    are, if the bag has that topic."""
    names, remap, wanted = topic_names(files), remap or {}, dict[str, str]()
    for key in layouts:
        if full := resolved(remap.get(key, key), names, str(bag)):
            wanted[full] = key
        elif key in remap:
            raise BagError(f"bag {bag}: has no topic '{remap[key]}' for '{key}'; it has {', '.join(sorted(names))}")
    decoders = {full: StreamDecoder(f"bag {bag}: topic '{full}'", layouts[key]) for full, key in wanted.items()}
    found = {full: one for one in whole if (full := resolved(one.topic, names, str(bag)))}
    count = _gather(files, {**found, **decoders})
    finished = ((key, decoders[full].finished()) for full, key in wanted.items())
    streams = {key: columns for key, columns in finished if columns is not None}
    if not streams and any(isinstance(file, SqliteInput) for file in files):
        raise BagError(f"bag {bag} has no messages on {', '.join(layouts)}; its topics are {', '.join(sorted(names))}")
    if not count:
        raise BagError(f"bag {bag} has no messages; record again, and check that the topics are published")
    return streams


def streams_of_stage(
    bag: Path,
    files: Sequence[BagInput],
    streams: Sequence[Stream],
    remap: Mapping[str, str] | None,
    whole: Sequence[Messages] = (),
) -> dict[str, StreamColumns]:
    """As :func:`streams_of`, of several stages in the bag those of the one that has the encoder."""
    theirs = topics_of_stage([one.topic for one in streams], topic_names(files), str(bag), remap)
    layouts = {one.topic: one.layout for one in streams if one is ENCODER or one.topic in theirs}
    return streams_of(bag, files, layouts, theirs, whole) if layouts else {}


def _gather(files: Iterable[BagInput], takers: Mapping[str, Messages | StreamDecoder]) -> int:
    """Hand each of the takers the messages of the topic with its full name; returns the number of all messages."""
    count = 0
    for file in files:
        for topic in file.topics.values():
            if topic.name in takers:
                takers[topic.name].describe(file.path, topic)
        for data, places in file.blocks(takers):
            for name, starts in places.items():
                count += len(starts)
                if name in takers:
                    takers[name].add(data, starts)
    return count


def read_attachments(bag: Path) -> dict[str, bytes]:
    """The files attached to a bag, by name; of two with one name the later. A SQLite bag has none. Raises BagError when
    the bag is absent or damaged."""
    with opened(bag) as files:
        return attachments_of(files)


def attachments_of(files: Sequence[BagInput]) -> dict[str, bytes]:
    """As :func:`read_attachments`, from the open files of a bag."""
    return {name: data for file in files for name, data in file.attachments().items()}


def read_metadata(bag: Path) -> dict[str, dict[str, str]]:
    """The texts of a bag's metadata records, by name of the record and key. A SQLite bag has none. Raises BagError when
    the bag is absent or damaged."""
    found: dict[str, dict[str, str]] = {}
    with opened(bag) as files:
        for record in (record for file in files for record in file.metadata()):
            found.setdefault(record.name, {}).update(record.metadata)
    return found


_SET_BACK_NS = 20_000_000
"""A stamp that is so far below an earlier one has no delay on its way: `evaluate` notices as much."""


def set_back(stamps: NDArray[np.int64]) -> float:
    """Time in s by which ``stamps`` (n,) in ns, in the order of recording, go back; 0 where that may be a delay."""
    back = int(np.max(np.maximum.accumulate(stamps) - stamps))
    return back * 1e-9 if back > _SET_BACK_NS else 0.0


def values_at(stream: StreamColumns | None, name: str, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Column ``name`` of ``stream`` at ``stamps`` (n,) in ns, (n,); NaN where it has none, or is not there. Of messages
    with the same stamp the first counts."""
    if stream is None or not len(stream):
        return np.full(len(stamps), np.nan)
    own = stream.by_stamp()
    places = np.minimum(np.searchsorted(own.stamp, stamps), len(own) - 1)
    return np.where(own.stamp[places] == stamps, own.columns[name][places], np.nan)

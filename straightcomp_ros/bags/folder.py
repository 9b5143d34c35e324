"""The files of a bag: those that are there, those that should be, and all of them open, MCAP or SQLite.

Messages of SQLite are given in MCAP's own framing, so that one decoder serves both. Source: rosbag2_storage_sqlite3,
tables `topics` (id, name, type, serialization_format, …) and `messages` (topic_id, timestamp in ns, data). It stores
the time of reception only, which stands for the publish time too.
"""

import re
import sqlite3
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Metadata

from straightcomp_ros.bags import BagError, NoBag
from straightcomp_ros.bags.information import ROOT_KEY
from straightcomp_ros.bags.mcap_input import MESSAGE, MESSAGE_FIELDS, Block, McapInput
from straightcomp_ros.bags.topics import Definition, Topic
from straightcomp_ros.parameters.yaml_text import load_yaml

_AT_ONCE = 5000


class SqliteInput:
    """A SQLite file of a bag, read as :class:`straightcomp_ros.bags.mcap_input.McapInput` reads MCAP. Every method
    raises BagError when the file is no bag, or is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def finished(self) -> bool:
        """Whether the recorder came to its end: it writes metadata.yaml last. The file itself looks whole always, since
        SQLite finishes each transaction."""
        return self.path.with_name("metadata.yaml").exists()

    @property
    def count(self) -> int:
        """Number of its messages."""
        ((count,),) = self._query("SELECT count(*) FROM messages")
        return int(count)

    @cached_property
    def topics(self) -> dict[int, Topic]:
        """Topics by id; their definitions where the file has them, which is since ROS 2 Iron."""
        found = list(self._query("SELECT id, name, type, serialization_format FROM topics"))
        if not all(isinstance(text, str) for _, *texts in found for text in texts):
            raise self.refused("a topic has no name, type or encoding")
        definitions = {}
        if any(self._query("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'")):
            described = self._query("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
            definitions = {
                type_name: Definition(text, "", encoding)
                for type_name, text, encoding in described
                if text and isinstance(text, str | bytes)
            }
        return {
            topic_id: Topic(name, type_name, described=definitions.get(type_name), encoding=encoding)
            for topic_id, name, type_name, encoding in found
        }

    def blocks(self, wanted: Collection[str]) -> Iterator[Block]:
        """Messages of the topics with these names, topic by topic in the order in which they were recorded."""
        for name in wanted:
            ids = [topic_id for topic_id, topic in self.topics.items() if topic.name == name]
            places = ", ".join("?" * len(ids))
            # Not by time: the recorder's clock may have been set, and MCAP is read in the order of recording too.
            statement = f"SELECT timestamp, data FROM messages WHERE topic_id IN ({places}) ORDER BY id"
            found = self._query(statement, *ids)
            while records := [self._record(*row) for row in islice(found, _AT_ONCE)]:
                sizes = np.array([len(record) for record in records], np.int64)
                yield b"".join(records), {name: np.cumsum(sizes) - sizes}

    def attachments(self) -> dict[str, bytes]:
        """None: SQLite bags have no attachments."""
        return {}

    def metadata(self) -> Iterator[Metadata]:
        """None: SQLite bags have no metadata records."""
        return iter(())

    def _record(self, time_ns: object, data: object) -> bytes:
        if not isinstance(data, bytes) or not isinstance(time_ns, int) or time_ns < 0:
            raise self.refused("a message has no data, or no time")
        return MESSAGE.pack(Opcode.MESSAGE, MESSAGE_FIELDS + len(data), 0, 0, time_ns, time_ns) + data

    def _query(self, statement: str, *values: int) -> Iterator[tuple[Any, ...]]:
        try:
            # Read only: SQLite must not create files next to the bag.
            mode = "mode=ro&immutable=1" if self._log_is_empty else "mode=ro"
            with closing(sqlite3.connect(f"{self.path.absolute().as_uri()}?{mode}", uri=True)) as connection:
                yield from connection.execute(statement, values)
        except (sqlite3.Error, OSError) as error:
            raise self.refused(str(error)) from error

    @property
    def _log_is_empty(self) -> bool:
        """Whether the file was written with a log beside it (WAL) of which nothing is left: SQLite would make a new one
        to read it. Source: SQLite's file format, 1.3.3."""
        with self.path.open("rb") as file:
            written_with_log = file.read(20)[18:] == b"\2\2"
        log = _log(self.path)
        return written_with_log and not (log.exists() and log.stat().st_size)

    def refused(self, reason: str) -> BagError:
        """The error with this reason."""
        advice = "copy it again from its source"
        return BagError(f"bag {self.path} is no SQLite bag of rosbag2, or is damaged: {reason}; {advice}")


BagInput = McapInput | SqliteInput
_LARGEST_METADATA = 32 << 20
STORED = re.compile(r".*\.(mcap|db3)(?P<compressed>\.zstd?|\.lz4)?")
"""Name of a file with messages: MCAP or SQLite, perhaps compressed as a whole."""
_CLASSIC = re.compile(r"(.*?)_(\d+)")
_ROLLING = re.compile(r"(\d+)_(.*)_\d{4}(?:_\d\d){2}-\d\d(?:_\d\d){2}")


def found_files(bag: Path) -> tuple[list[Path], list[str]]:
    """The files of a bag, a rosbag2 folder or one file, in the order of recording, and the names of those that it
    lacks.

    The order is that of the list in metadata.yaml; without a list, or with one of other names, that of the numbers in
    the names. Raises BagError when there is no file, the files or messages are compressed by rosbag2, or files are of
    several recordings. Warns (UserWarning) of files that the list does not have, which are left out.
    """
    bag = Path(bag)
    if not bag.exists():
        raise NoBag(f"bag {bag} does not exist; give a bag folder or a file that ends with .mcap")
    stored = sorted(file for file in bag.iterdir() if STORED.fullmatch(file.name)) if bag.is_dir() else [bag]
    # To open a pipe waits for its other end.
    if odd := [file for file in stored if file.exists() and not file.is_file()]:
        raise NoBag(f"bag {odd[0]} is no file; give a bag folder or a file that ends with .mcap")
    compressed = [file for file in stored if file.suffix not in (".mcap", ".db3") and STORED.fullmatch(file.name)]
    files = {file.name: file for file in stored if file not in compressed}
    packed = [file for file in compressed if file.stem not in files]
    if packed:
        program = "unlz4 -m" if packed[0].suffix == ".lz4" else "unzstd"
        pattern = packed[0].name if bag.is_file() else f"*{''.join(packed[0].suffixes[-2:])}"
        raise BagError(f"bag {bag}: its files are compressed as a whole; unpack them with `{program} {pattern}`")
    if not files:
        raise NoBag(f"bag {bag}: the folder holds no .mcap and no .db3 file; give the folder of the recording")
    if bag.is_file():
        return [bag], []
    information = _information(bag)
    if str(information.get("compression_mode")).upper() == "MESSAGE":
        raise BagError(f"bag {bag}: {compressed_messages(str(information.get('compression_format')))}")
    listed = _listed(information)
    if not files.keys().isdisjoint(listed):
        if others := ", ".join(sorted(files.keys() - set(listed))):
            warnings.warn(f"bag {bag}: metadata.yaml does not list {others}: not read", stacklevel=3)
        return [files[name] for name in listed if name in files], [name for name in listed if name not in files]
    found = sorted(files.values(), key=split_number)
    if not _is_one_recording(files):
        raise BagError(f"bag {bag}: the folder holds several recordings ({', '.join(sorted(files))}); give one file")
    # A recording that was killed between making its next file and writing to it leaves an empty one.
    if len(found) > 1 and found[-1].exists() and not found[-1].stat().st_size:
        found.pop()
    if len(found) > 1 and split_number(found[0])[1] > 0:
        warnings.warn(f"bag {bag} begins with {found[0].name}: what was recorded before is not there", stacklevel=3)
    # A bag with as many files as its list has them under other names.
    return found, list(listed) if len(listed) > len(found) else _gaps(found)


def found_beside(bag: Path, paths: Sequence[Path]) -> list[Path]:
    """What belongs to a bag next to its files ``paths`` with messages: metadata.yaml, unless it is of other files too,
    and the logs of SQLite, in which messages may be that are not yet in its file."""
    folder = bag if bag.is_dir() else bag.parent
    own = [folder / "metadata.yaml"] if folder == bag or _listed(_information(folder)) == [bag.name] else []
    return [one for one in (*own, *map(_log, paths)) if one.is_file()]


def _log(file: Path) -> Path:
    return file.with_name(f"{file.name}-wal")


def compressed_messages(compression: str) -> str:
    """What is wrong with a bag of `ros2 bag record --compression-mode message`, and what helps."""
    return f"each of its messages is compressed ({compression}); unpack them with `ros2 bag convert`"


def split_number(file: Path) -> tuple[str, int, str]:
    """Recording, number and name of a file of a bag, as it is sorted. rosbag2 numbers the files of a split bag: name_0,
    name_1, … name_10; since 2025 0_name_2025_12_17-10_00_00, 1_name_…. Without a number it is -1."""
    if match := _ROLLING.fullmatch(file.stem):
        return match[2], int(match[1]), file.name
    match = _CLASSIC.fullmatch(file.stem)
    return (match[1], int(match[2]), file.name) if match else (file.stem, -1, file.name)


def _is_one_recording(names: Iterable[str]) -> bool:
    """Whether files with these names are a single one, or all numbered under one name."""
    parts = [(*split_number(Path(name)), Path(name).suffix) for name in names]
    recordings, numbers = {(name, suffix) for name, _, _, suffix in parts}, {number for _, number, _, _ in parts}
    return len(parts) == 1 or (len(recordings) == 1 and len(numbers) == len(parts) and min(numbers) >= 0)


def _information(bag: Path) -> Mapping[str, Any]:
    try:
        found = load_yaml(bag / "metadata.yaml", _LARGEST_METADATA, _LARGEST_METADATA // 32)[ROOT_KEY]
    except (OSError, ValueError, LookupError, TypeError):
        return {}  # a bag whose metadata cannot be read still has its messages
    return found if isinstance(found, Mapping) else {}


def _listed(information: Mapping[str, Any]) -> list[str]:
    """Names of the files in metadata.yaml; those that were compressed when it was written are unpacked now."""
    try:
        paths = information.get("relative_file_paths") or [file["path"] for file in information["files"]]
        names = [Path(str(path)).name for path in paths]
    except (LookupError, TypeError):
        return []
    unpacked = (name.removesuffix(((match := STORED.fullmatch(name)) and match["compressed"]) or "") for name in names)
    return list(dict.fromkeys(unpacked))  # a file that is listed twice is one


def _check_count(files: Sequence[BagInput]) -> None:
    """Raise BagError where metadata.yaml, which lists these files, says another number of messages than SQLite ones
    hold; MCAP files have their own statistics."""
    stored = [file for file in files if isinstance(file, SqliteInput)]
    if not stored:
        return
    information = _information(files[0].path.parent)
    expected = information.get("message_count")
    if isinstance(expected, int) and _listed(information) == [file.path.name for file in stored]:
        count = sum(file.count for file in stored)
        if count != expected:
            advice = "`ros2 bag reindex` counts anew if nothing was lost in copying"
            raise stored[0].refused(f"{count} messages are there, and metadata.yaml says {expected} ({advice})")


def _gaps(files: Sequence[Path]) -> list[str]:
    """Names of the files that are missing between the first and the last number: rosbag2 can drop the oldest files."""
    numbers = [split_number(file)[1] for file in files]
    absent = sorted(set(range(min(numbers), max(numbers))) - set(numbers))
    name, suffix = split_number(files[0])[0], files[0].suffix
    rolling = _ROLLING.fullmatch(files[0].stem)
    return [f"{number}_{name}_*{suffix}" if rolling else f"{name}_{number}{suffix}" for number in absent]


@contextmanager
def opened(bag: Path) -> Iterator[Sequence[BagInput]]:
    """The files of a bag, open. Raises BagError when there is none, one of several is missing, or one is no MCAP file;
    warns (UserWarning) when the bag was not finished, or as :func:`found_files`."""
    paths, missing = found_files(bag)
    if missing:
        rest = ", or save what is there with `straightcomp recover`" if paths[0].suffix == ".mcap" else ""
        raise BagError(f"bag {bag} lacks {', '.join(missing)}; copy the whole folder again{rest}")
    with ExitStack() as stack:
        files: list[BagInput] = [
            SqliteInput(path) if path.suffix == ".db3" else stack.enter_context(McapInput(path)) for path in paths
        ]
        for file in files:
            if not file.finished:
                text = f"bag {file.path} was not finished, or its end is damaged: what comes before is read"
                warnings.warn(text, stacklevel=4)
        _check_count(files)
        yield files


def topic_names(files: Iterable[BagInput]) -> set[str]:
    """Full names of the topics in these files."""
    return {topic.name for file in files for topic in file.topics.values()}

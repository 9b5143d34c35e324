"""Records one bag after the other. A thread writes each, so that the disk never holds up receiving."""

import shutil
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from itertools import groupby, islice
from pathlib import Path

import numpy as np

from straightcomp_ros.bags import BagError, RecorderParameters
from straightcomp_ros.bags.information import ORIGIN_METADATA, origin
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import FLUSH_AGE, BagWriter, Message
from straightcomp_ros.messages.cdr import NANOSECONDS

BREAK: Message = ("", b"", 0, 0)
"""Marks between two messages that those between them were left out on purpose: they do not count as lost."""


class Intake:
    """Messages on their way to the bag. One thread adds, another takes from ``queue``.

    Args:
        limit: messages that may wait for the disk; beyond it they are dropped and counted. A snapshot drops none: its
            messages are in memory already.
        snapshot_s: 0 records all; otherwise the messages of the last ``snapshot_s`` seconds stay in memory, and only
            :meth:`snapshot` sends them to the disk.

    Attributes:
        queue: messages for the disk, oldest first.
        paused: while true, messages are ignored.
        received, dropped: messages that came, and those that had no room in the queue.
    """

    def __init__(self, limit: int, snapshot_s: float = 0.0) -> None:
        self.queue: deque[Message] = deque()
        self.received = self.dropped = 0
        self.paused = False
        self._limit, self._keep_ns = limit, round(snapshot_s * 1e9)
        self._memory: deque[Message] = deque()

    def add(self, topic: str, data: bytes, received_ns: int, source_ns: int) -> None:
        """A message came."""
        self.received += 1
        if self.paused:
            return
        if self._keep_ns:
            memory = self._memory
            memory.append((topic, data, received_ns, source_ns))
            # After a step of the clock neither those from before it, nor those of its future, are the last seconds.
            while abs(received_ns - memory[0][2]) > self._keep_ns:
                memory.popleft()
        elif len(self.queue) < self._limit:
            self.queue.append((topic, data, received_ns, source_ns))
        else:
            self.dropped += 1

    def snapshot(self) -> int:
        """Send what is in memory to the disk; returns how many messages that is."""
        memory, self._memory = self._memory, deque()
        self.queue.append(BREAK)
        self.queue += memory
        return len(memory) - memory.count(BREAK)

    def interrupt(self) -> None:
        """Do not count what is missing before the next message as lost."""
        (self._memory if self._keep_ns else self.queue).append(BREAK)

    def pause(self) -> None:
        """Ignore messages from now on, and count none of them as lost."""
        self.interrupt()
        self.paused = True


_STAMP = slice(4, 12)
"""A header's stamp follows the four bytes of the CDR encapsulation."""
_STAMP_TYPE = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])


class Losses:
    """Gaps in streams whose stamps lie on a grid: every stream of the loop carries its sample's stamp. The sampling
    period is the smallest step between two stamps of the same topic."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._steps: dict[str, Counter[int]] = {}

    def add(self, topic: str, messages: Iterable[bytes]) -> None:
        """Serialised messages of one topic, in their order; each begins with a header."""
        stamps = np.frombuffer(b"".join([data[_STAMP] for data in messages if len(data) >= _STAMP.stop]), _STAMP_TYPE)
        if not len(stamps):
            return
        times = stamps["sec"].astype(np.int64) * NANOSECONDS + stamps["nanosec"]
        # A stamp that is repeated or overtaken stands still here, and makes no step.
        newest = np.maximum.accumulate(np.append(self._last.get(topic, times[0]), times))
        steps = np.diff(newest)
        self._steps.setdefault(topic, Counter()).update(steps[steps > 0].tolist())
        self._last[topic] = int(newest[-1])

    def interrupt(self) -> None:
        """Do not count the gap before the next message: those in it were left out on purpose."""
        self._last.clear()

    def by_topic(self) -> Mapping[str, int]:
        """Messages missing between the first and the last, by topic."""
        return {
            topic: sum((round(step / min(steps)) - 1) * count for step, count in steps.items()) if steps else 0
            for topic, steps in self._steps.items()
        }


_WRITE_INTERVAL_S = 0.05
_BATCH = 500
"""Messages that are written in one call: a small share of a chunk."""


def check_disk(folder: Path, min_free: int) -> None:
    """Raise BagError when fewer than ``min_free`` bytes are free on the disk of ``folder``."""
    free = shutil.disk_usage(folder).free
    if free < min_free:
        allowed = f"allowed: >= {min_free} (min_free_bytes)"
        raise BagError(f"bag {folder}: {free} bytes are free on its disk; {allowed}; all that came before is saved")


def _new_folder(name: str) -> Path:
    """Make the first of ``name``, ``name_2`` … that is not there; where none can be made, the bag's writer says why."""
    folder, number = Path(name), 1
    with suppress(OSError):
        while True:
            try:
                folder.mkdir()
                break
            except FileExistsError:
                number += 1
                folder = Path(f"{name}_{number}")
    return folder


class Recorder:
    """Call it from one thread; it has its own for writing.

    Args:
        options: see there; a bag without ``output`` is named after the time of its start; later ones get ``_2`` …
        stamped: full names of the topics that have a header with their sample's stamp; their losses are counted.
        describe: called with the bag now and then, on the writing thread, and when the bag ends, with a second argument
            that is true then. It adds what describes the recording, e.g. the nodes' parameters.

    Attributes:
        intake: takes the messages; before :meth:`start` it ignores them.
        folder: of the bag that is being written, or was last.
        failure: why the recording stopped by itself; :meth:`stop` saves what came before, and raises it.
        written: messages in the present bag.
    """

    def __init__(
        self, options: RecorderParameters, stamped: Collection[str], describe: Callable[[BagWriter, bool], None]
    ) -> None:
        self._options, self._stamped, self._describe = options, frozenset(stamped), describe
        self._min_free = options.min_free_bytes
        self._topics: list[Topic] = []
        self._expected: list[Topic] = []
        self._count = self.written = 0
        self._stopping, self._splitting = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self.failure: Exception | None = None
        self.folder = Path(options.output)
        self.intake = self._closed_intake()

    @property
    def recording(self) -> bool:
        """Whether a bag is open."""
        return self._thread is not None

    def announce(self, topic: Topic) -> None:
        """Add a topic, to the present bag too. Its first message may follow at once."""
        self._topics.append(topic)

    def expect(self, topic: Topic) -> None:
        """Name a topic that will be announced when its publishers' quality of service is known. A bag that ends before
        that lists it as it is given here, without messages."""
        self._expected.append(topic)

    def start(self) -> Path:
        """Begin a bag; returns its folder. Raises BagError when a bag is open already, or the folder is not empty or
        cannot be made."""
        if self.recording:
            raise BagError(f"bag {self.folder} is being recorded already")
        folder, options = self._next_folder(), self._options
        bag = BagWriter(
            folder,
            compression=options.compression,
            max_size=options.max_file_bytes,
            max_duration=options.max_file_duration,
        )
        self._count += 1
        self.folder, self.failure, self.written = folder, None, 0
        self._losses, self._bag = Losses(), bag
        self.intake = Intake(options.queue_limit, options.snapshot)
        self._stopping.clear()
        self._splitting.clear()
        self._thread = threading.Thread(target=self._write_until_stopped, name="bag writer")
        self._thread.start()
        return folder

    def keep_free(self, min_free: int) -> None:
        """Keep ``min_free`` bytes of the disk free from now on, for this bag too."""
        self._min_free = min_free

    def split(self) -> None:
        """Have the writing thread continue the bag in a new file."""
        self._splitting.set()

    def stop(self) -> None:
        """Write what has come and finish the bag; without one, nothing. Raises BagError or OSError when that fails, or
        the recording had stopped by itself."""
        if self._thread is None:
            return
        intake, self.intake = self.intake, self._closed_intake()
        self._stopping.set()
        self._thread.join()
        self._thread = None
        try:
            with self._bag as bag:  # finishes the bag even where the disk is too full for these
                self._describe(bag, True)
                counts = {"received": intake.received, "written": self.written, "dropped": intake.dropped}
                for name, numbers in (("logger", counts), ("losses", self._losses.by_topic())):
                    bag.add_metadata(name, {key: str(number) for key, number in numbers.items()})
                self._add_topics(self._expected)
        except Exception as error:
            raise self._in_words(error) from None
        if self.failure is not None:
            raise self.failure

    def _in_words(self, error: Exception) -> Exception:
        # Memory may be short, and what describes the recording may fail in ways of its own.
        known = isinstance(error, OSError | BagError)
        return error if known else BagError(f"bag {self.folder} cannot be written: {error!r}")

    def _add_topics(self, topics: Iterable[Topic]) -> None:
        for topic in topics:
            if topic.name not in self._bag.topics:
                self._bag.add(topic)

    def _closed_intake(self) -> Intake:
        intake = Intake(self._options.queue_limit)
        intake.paused = True
        return intake

    def _next_folder(self) -> Path:
        if not self._options.output:
            return _new_folder(datetime.now().strftime("straightcomp_%Y_%m_%d-%H_%M_%S"))
        first = Path(self._options.output)
        return first if not self._count else first.with_name(f"{first.absolute().name}_{self._count + 1}")

    def _write_until_stopped(self) -> None:
        intake = self.intake
        try:
            self._bag.add_metadata(ORIGIN_METADATA, origin())
            while not self._stopping.wait(_WRITE_INTERVAL_S):
                self._write(intake)
                check_disk(self.folder, self._min_free)
                # Now, not at the end: a bag whose recording is killed needs its description too.
                self._describe(self._bag, False)
                if self._splitting.is_set():
                    self._splitting.clear()
                    self._bag.split()
                self._bag.flush_older(FLUSH_AGE)
                self._bag.sync_older(self._options.sync_interval)
            while intake.queue:
                self._write(intake)
                check_disk(self.folder, self._min_free)
        except Exception as error:  # A thread that ends without a word would leave a bag that looks whole.
            self.failure = self._in_words(error)

    def _write(self, intake: Intake) -> None:
        # Not all of a long snapshot at once: the disk is looked at in between.
        waiting = (intake.queue.popleft() for _ in range(min(len(intake.queue), self._options.queue_limit)))
        # After counting those that wait: the topic of each of them was announced before it came.
        self._add_topics(self._topics)
        for interruption, messages in groupby(waiting, lambda message: message is BREAK):
            if interruption:
                self._losses.interrupt()
                continue
            while batch := list(islice(messages, _BATCH)):
                self._write_batch(batch)

    def _write_batch(self, messages: list[Message]) -> None:
        self._bag.write_all(messages)
        self.written += len(messages)
        stamped: dict[str, list[bytes]] = {}
        for topic, data, _, _ in messages:
            if topic in self._stamped:
                stamped.setdefault(topic, []).append(data)
        for topic, of_topic in stamped.items():
            self._losses.add(topic, of_topic)

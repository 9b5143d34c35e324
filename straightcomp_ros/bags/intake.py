"""What becomes of each message that a recording gets: it waits for the disk, stays in memory, or is ignored."""

from collections import deque

Message = tuple[str, bytes, int, int]
"""Topic, serialised message, time of reception and of its source in ns since the epoch."""
BREAK: Message = ("", b"", 0, 0)
"""Marks in the queue where messages were left out on purpose: they do not count as lost."""


class Intake:
    """Messages on their way to the bag. One thread adds, another takes from ``queue``.

    Args:
        limit: messages that may wait for the disk; beyond it they are dropped and counted.
        snapshot_s: 0 records all; otherwise the messages of the last ``snapshot_s`` seconds stay in memory, and only
            :meth:`snapshot` sends them to the disk.

    Attributes:
        queue: messages for the disk, oldest first.
        received, dropped, passed_over: messages that came, had no room in the queue, came while paused.
    """

    def __init__(self, limit: int, snapshot_s: float = 0.0) -> None:
        self.queue: deque[Message] = deque()
        self.received = self.dropped = self.passed_over = 0
        self._paused = False
        self._limit, self._keep_ns = limit, round(snapshot_s * 1e9)
        self._memory: deque[Message] = deque()

    def add(self, topic: str, data: bytes, received_ns: int, source_ns: int) -> None:
        """A message came."""
        self.received += 1
        if self._paused:
            self.passed_over += 1
        elif self._keep_ns:
            memory = self._memory
            memory.append((topic, data, received_ns, source_ns))
            while received_ns - memory[0][2] > self._keep_ns:
                memory.popleft()
        elif len(self.queue) < self._limit:
            self.queue.append((topic, data, received_ns, source_ns))
        else:
            self.dropped += 1

    def snapshot(self) -> int:
        """Send what is in memory to the disk; returns how many messages that is."""
        room = max(self._limit - len(self.queue), 0)
        kept = list(self._memory)[-room:] if room else []
        self.dropped += len(self._memory) - len(kept)
        self._memory.clear()
        self.queue += [BREAK, *kept]
        return len(kept)

    @property
    def paused(self) -> bool:
        """While true, messages are ignored and counted."""
        return self._paused

    @paused.setter
    def paused(self, value: bool) -> None:
        if value and not self._paused:
            self.queue.append(BREAK)
        self._paused = value

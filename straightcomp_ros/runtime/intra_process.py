"""Streams between the nodes of one process: handed over in memory; everyone else gets them as messages, as before.

Nodes in one process share one loop, the driver's: each time it has samples it lets the others do their cycles. What
others get is sent by a thread, since the middleware takes 100 µs for a batch, nearly a period at 8 kHz.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from straightcomp_ros.contract import Stream
from straightcomp_ros.runtime.loops import WorkerThread

if TYPE_CHECKING:
    from straightcomp_ros.runtime.streams import Streams

_DEPTH = 1000
"""Messages that wait for a node that is not active: those of half a second, as in a subscription's queue."""
_LOCKSTEP_S = 0.0002
"""Pause after each sample in lockstep, which else would come faster than the recorder can write."""
_PAUSE_S = 0.001
"""Between two looks for a message that none of the nodes has sent."""


class IntraProcess:
    """What nodes of this process share: the ``streams`` that one publishes for the others, and their cycles.

    Attributes:
        queues: by topic, those that get a stream's messages.
        ends: those of each node, in the order in which the nodes do their cycles.
        sender: the thread that sends what others get.
    """

    def __init__(self, streams: Iterable[Stream]) -> None:
        self.queues: dict[str, list[MemoryQueue]] = {stream.topic: [] for stream in streams}
        self.ends: list[Streams] = []
        self.sender = WorkerThread(lambda reason: print(reason, file=sys.stderr))
        self.sender.start()

    def deliver(self) -> None:
        """Let each node do its cycle with what was handed over to it."""
        for end in self.ends:
            end.cycle()

    def publish_records(self) -> None:
        """Publish what the nodes have made since the last call."""
        for end in self.ends:
            for publisher in end.records.values():
                publisher.publish_new()


class MemoryQueue:
    """What one node has not fetched yet of one stream; used like a `SubscriptionQueue`."""

    def __init__(self, shared: IntraProcess) -> None:
        self._shared = shared
        self._messages: deque[tuple[int, Sequence[float], int]] = deque(maxlen=_DEPTH)
        self.sent_ns: list[int] = []

    def put(self, stamp_ns: int, numbers: Sequence[float], made_ns: int) -> None:
        """Hand a message over that was made at ``made_ns`` since the epoch."""
        self._messages.append((stamp_ns, numbers, made_ns))

    def fetch(self) -> list[tuple[int, Sequence[float], int]]:
        """Messages since the last call: (stamp in ns, numbers, when it was handed over in ns since the epoch)."""
        messages = list(self._messages)
        self._messages.clear()
        self.sent_ns = [message[2] for message in messages]
        return messages

    def wait(self, timeout_ns: int) -> None:
        """Let the other nodes do their cycles, and pause if none of them sends a message. Only a driver in lockstep
        waits for another node of its process."""
        self._shared.deliver()
        self._shared.publish_records()
        time.sleep(_LOCKSTEP_S if self._messages else _PAUSE_S)

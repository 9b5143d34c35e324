"""Streams between the nodes of one process: handed over in memory; everyone else gets them as messages, as before.

Nodes in one process share one loop, the driver's: each time it has samples it lets the others do their cycles. What
others get is sent by a thread, since the middleware takes 100 µs for a batch, nearly a period at 8 kHz.
"""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence

from straightcomp_ros.contract import Stream
from straightcomp_ros.runtime.loops import WorkerThread

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
        publishers: those of these nodes: place of the node, topic, and what publishes the new messages for others.
        sender: the thread that sends what others get.
    """

    def __init__(self, streams: Iterable[Stream]) -> None:
        self.queues: dict[str, list[MemoryQueue]] = {stream.topic: [] for stream in streams}
        self.publishers: list[tuple[int, str, Callable[[], object]]] = []
        self._cycles: dict[int, Callable[[], object]] = {}
        self.sender = WorkerThread(lambda reason: print(reason, file=sys.stderr))
        self.sender.start()

    def follow(self, place: int, cycle: Callable[[], object]) -> None:
        """Call ``cycle`` in each :meth:`deliver`, after those of the nodes with a lower ``place``."""
        self._cycles = dict(sorted({**self._cycles, place: cycle}.items()))

    def leave(self, place: int, queues: Iterable["MemoryQueue"]) -> None:
        """Forget the cycle, the queues and the publishers of the node at this place; all it published has been sent."""
        self._cycles.pop(place, None)
        self.publishers = [publisher for publisher in self.publishers if publisher[0] != place]
        gone = set(map(id, queues))
        for waiting in self.queues.values():
            waiting[:] = [queue for queue in waiting if id(queue) not in gone]
        self.sender.wait()

    def publish(self, place: int, topic: str, publish_new: Callable[[], object]) -> None:
        """Add a publisher of the node at this place."""
        self.publishers.append((place, topic, publish_new))

    def deliver(self) -> None:
        """Let each node do its cycle with what was handed over to it."""
        for cycle in self._cycles.values():
            cycle()

    def publish_records(self) -> None:
        """Publish what the nodes have made since the last call."""
        for _, _, publish_new in self.publishers:
            publish_new()


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

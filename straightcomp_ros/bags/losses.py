"""Counts the messages that a recording lacks, by the gaps between the stamps of those that it has."""

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from straightcomp_ros.messages.cdr import NANOSECONDS

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
